"""Changes over time in a fleet: every axle of every machine, tested together.

The test of one series is that of `agent history` (`agent.runs.Trend`): the logarithm of friction with the warm-up that
all axles share taken out; for a validation or diagnosis, the logarithm of the error. The levels of an axle are one
finding, corrected for their number (Bonferroni). A fixed level per series would raise false alarms in proportion to
their number, so the false discovery rate is controlled over all axles (Benjamini and Hochberg 1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.special import stdtrit
from scipy.stats import false_discovery_control

from agent.core import InputError, swept_folder
from agent.fleet.families import RATE, Family, find_families, read_columns
from agent.fleet.machines import FleetMachine, read_machines
from agent.fleet.result_file import KINDS, META, ROWS, is_result, open_rows
from agent.fleet.store import SCRATCH, Store
from agent.runs import FEWEST, Trend

SCHEMA_NAME = "fleet-trends/1"


@dataclass(eq=False)
class FleetTrends:
    """All machines of a result with the `source` of its runs, the families among them, and added columns by robot."""

    kind: str
    result: str
    source: str
    machines: list[FleetMachine]
    families: list[Family] = field(default_factory=list)
    tables: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def axles(self) -> list[Trend]:
        """The trend of every axle."""
        return [trend for machine in self.machines for trend in machine.trends]

    @property
    def short(self) -> int:
        """Number of machines with too few runs for a trend."""
        return sum(not machine.trends for machine in self.machines)

    @property
    def alarms(self) -> list[Trend]:
        """The surest first."""
        return sorted((trend for trend in self.axles if trend.alarm), key=lambda trend: trend.probability)

    def to_dict(self) -> dict[str, Any]:
        """Plain data; axles without an alarm only by their number."""
        return {
            "schema": SCHEMA_NAME,
            "result": self.result,
            "machines": len(self.machines),
            "too_few_runs": self.short,
            "series": len(self.axles),
            "false_discovery_rate": RATE,
            "alarms": [_plain(trend) for trend in self.alarms],
            "families": [{**trend.__dict__, "robots": list(trend.robots)} for trend in self.families],
        }

    def text(self) -> str:
        """For people."""
        axles, alarms = self.axles, self.alarms
        lines = [
            f"{len(self.machines)} machines, {len(axles)} axles with at least {FEWEST} runs; {len(alarms)} alarms, "
            f"of which {100 * RATE:g} % are expected to be chance"
        ]
        lines += [f"{trend.runs.machine}: {change_text(trend)}" for trend in alarms[:50]]
        if len(alarms) > 50:
            lines.append(f"… and {len(alarms) - 50} more: --json, or `agent fleet report`")
        lines += [f"family: {trend.text()}" for trend in self.families]
        return "\n".join(lines)


def change_of(trend: Trend) -> tuple[float, float, float]:
    """Relative change of an axle over its runs, significant or not, and its 95 % interval."""
    size, half = trend.found.size, float(stdtrit(len(trend.values) - 3, 0.975)) * trend.found.deviation
    change, low, high = np.expm1(np.clip([size, size - half, size + half], -20, 20)).tolist()
    return change, low, high


def change_text(trend: Trend) -> str:
    """The change of an axle, in one sentence."""
    change, low, high = change_of(trend)
    over = f"{100 * change:+.1f} % ({100 * low:+.1f} to {100 * high:+.1f})"
    what = f"{trend.joint}: {trend.quantity}{trend.at}"
    if trend.kind == "step":
        date = trend.runs.dates[trend.found.place - 1]
        return f"{what} stepped by {over} after {trend.since if date is None else date.date()}"
    return f"{what} drifts, {over} over {trend.runs.days[-1] - trend.runs.days[0]:.0f} days"


def fleet_trends(result: str, tables: Sequence[Path] = ()) -> FleetTrends:
    """Trends of a result.

    Raises:
        InputError: no result, or a table that cannot be used.
    """
    columns = read_columns(tables)
    with swept_folder(SCRATCH) as folder:
        rows = open_rows(result, folder)
        if rows.kind not in KINDS:
            raise InputError(
                f"{result}: holds {rows.kind}; name the result of an estimate, a validation or a diagnosis"
            )
        trends = FleetTrends(rows.kind, result, rows.source, list(read_machines(rows.kind, rows.file)), tables=columns)
    axles = trends.axles
    levels = false_discovery_control([trend.probability for trend in axles]).tolist() if axles else []
    for trend, level in zip(axles, levels, strict=True):
        trend.level, trend.significant = level, level <= RATE
    trends.families = find_families(columns, axles)
    return trends


def write_trends(trends: FleetTrends, out: str) -> None:
    """Write all axles as Parquet, one row each, with the columns of the tables.

    Raises:
        InputError: a folder with a result in it.
        AgentError: it cannot be written.
    """
    rows = []
    for trend in trends.axles:
        row = _plain(trend)
        row["low"], row["high"] = row.pop("interval")
        rows.append(row | {name: values.get(trend.runs.machine) for name, values in trends.tables.items()})
    with swept_folder(SCRATCH) as folder:
        if is_result(out) and open_rows(out, folder).kind != "trends":
            raise InputError(f"{out}: holds a result of another kind; name another folder with -o")
        table = pa.Table.from_pylist(rows).replace_schema_metadata({META: b"trends"})
        path = folder / "trends.parquet"
        pq.write_table(table, path, compression="zstd")
        Store(out).put(ROWS, path)


def _plain(trend: Trend) -> dict[str, Any]:
    """An axle as plain data, without its course."""
    change, *interval = change_of(trend)
    return {
        "robot": trend.runs.machine,
        "joint": trend.joint,
        "quantity": f"{trend.quantity}{trend.at}",
        "runs": len(trend.values),
        "kind": trend.kind,
        "change": change,
        "interval": interval,
        "since": trend.since or None,
        "probability_by_chance": trend.probability,
        "false_discovery_level": trend.level,
        "alarm": trend.alarm,
    }
