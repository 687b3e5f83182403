"""Changes over time in a fleet: every axle of every machine, tested together.

The test of one series is that of `agent history` (`agent.runs.Trend`): the logarithm of friction with the warm-up that
all axles share taken out; for a validation or diagnosis, the logarithm of the error. The levels of an axle are one
finding, corrected for their number (Bonferroni). A fixed level per series would raise false alarms in proportion to
their number, so the false discovery rate is controlled over all axles (Benjamini and Hochberg 1995).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, swept_folder
from agent.fleet.families import RATE, Family, find_families, read_columns
from agent.fleet.machines import MachineRuns, read_machines
from agent.fleet.result import META, ROWS, SOURCE, open_rows
from agent.fleet.store import SCRATCH, Store
from agent.fleet.tasks import KINDS
from agent.runs import FEWEST, PRACTICAL, Background, Trend, friction_trends

#: Relative change of a prediction error that matters.
PRACTICAL_ERROR = 0.25
SCHEMA_NAME = "fleet-trends/1"


@dataclass(eq=False)
class AxleTrend:
    """The trend of one axle of one machine among those of the fleet.

    Relative `change` over the course with its 95 % interval `low` to `high`; `dates` of the runs, ISO 8601; `p_value`,
    corrected for the axle's series; `level`: smallest false discovery rate at which it is a finding.
    """

    robot: str
    trend: Trend
    dates: tuple[str, ...]
    p_value: float
    change: float
    low: float
    high: float
    level: float = 1.0

    @property
    def quantity(self) -> str:
        """What is looked at."""
        return f"{self.trend.quantity}{self.trend.at}"

    @property
    def since_day(self) -> str:
        """Day of the run after which a step came; "" without a step, or where it is unknown."""
        return self.dates[self.trend.found.place - 1] if self.trend.since else ""

    def text(self) -> str:
        """One sentence."""
        trend, over = self.trend, f"{100 * self.change:+.1f} % ({100 * self.low:+.1f} to {100 * self.high:+.1f})"
        if trend.kind == "step":
            return f"{trend.joint}: {self.quantity} stepped by {over} after {self.since_day or trend.since}"
        return f"{trend.joint}: {self.quantity} drifts, {over} over {trend.times[-1] - trend.times[0]:.0f} days"

    def to_dict(self) -> dict[str, Any]:
        """Plain data, without the course."""
        return {
            "robot": self.robot,
            "joint": self.trend.joint,
            "quantity": self.quantity,
            "runs": len(self.trend.runs),
            "kind": self.trend.kind,
            "change": self.change,
            "interval": [self.low, self.high],
            "since": self.trend.since or None,
            "probability_by_chance": self.p_value,
            "false_discovery_level": self.level,
            "alarm": self.trend.alarm,
        }


@dataclass(eq=False)
class FleetTrends:
    """All axles of a result, and the families among them. `short`: machines with too few runs for a trend."""

    kind: str
    result: str
    axles: list[AxleTrend]
    families: list[Family]
    short: int
    machines: int
    tables: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def alarms(self) -> list[AxleTrend]:
        """The surest first."""
        return sorted((one for one in self.axles if one.trend.alarm), key=lambda one: one.p_value)

    def to_dict(self) -> dict[str, Any]:
        """Plain data; axles without an alarm only by their number."""
        return {
            "schema": SCHEMA_NAME,
            "result": self.result,
            "machines": self.machines,
            "too_few_runs": self.short,
            "series": len(self.axles),
            "false_discovery_rate": RATE,
            "alarms": [one.to_dict() for one in self.alarms],
            "families": [{**one.__dict__, "robots": list(one.robots)} for one in self.families],
        }

    def text(self) -> str:
        """For people."""
        alarms = self.alarms
        lines = [
            f"{self.machines} machines, {len(self.axles)} axles with at least {FEWEST} runs; {len(alarms)} alarms, "
            f"of which {100 * RATE:g} % are expected to be chance"
        ]
        lines += [f"{one.robot}: {one.text()}" for one in alarms[:50]]
        if len(alarms) > 50:
            lines.append(f"… and {len(alarms) - 50} more: --json, or `agent fleet report`")
        lines += [f"family: {one.text()}" for one in self.families]
        return "\n".join(lines)


def fleet_trends(
    result: str,
    tables: Sequence[Path] = (),
    on_machine: Callable[[MachineRuns, list[AxleTrend]], None] = lambda machine, found: None,
) -> FleetTrends:
    """Trends of a result; `on_machine` is called with every machine before findings are decided.

    Raises:
        InputError: no result, or a table that cannot be used.
    """
    columns = read_columns(tables)
    axles: list[AxleTrend] = []
    machines = short = 0
    with swept_folder(SCRATCH) as folder:
        kind, rows = open_rows(result, folder)
        if kind not in KINDS:
            raise InputError(f"{result}: holds {kind}; name the result of an estimate, a validation or a diagnosis")
        for machine in read_machines(kind, rows):
            machines += 1
            found = list(_friction_of(machine) if kind == "estimate" else _errors_of(machine))
            short += not found
            axles += found
            on_machine(machine, found)
    _decide(axles)
    families = find_families(
        columns,
        [one.robot for one in axles],
        [one.trend.joint for one in axles],
        np.array([one.trend.found.drift for one in axles]),
        np.array([one.trend.found.drift_deviation for one in axles]),
        np.array([one.trend.alarm for one in axles], dtype=bool),
    )
    return FleetTrends(kind, result, axles, families, short, machines, columns)


def is_result(url: str) -> bool:
    """Whether a folder or URL holds the rows of a fleet."""
    try:
        Store(url).find(ROWS)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def source_of(url: str) -> str:
    """Where the runs of a result are; "" where it is unknown.

    Raises:
        InputError: no result.
    """
    with swept_folder(SCRATCH) as folder:
        return (open_rows(url, folder)[1].schema_arrow.metadata or {}).get(SOURCE, b"").decode()


def write_trends(found: FleetTrends, out: str) -> None:
    """Write all axles as Parquet, one row each, with the columns of the tables.

    Raises:
        InputError: a folder with a result in it.
        AgentError: it cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = []
    for one in found.axles:
        row = one.to_dict()
        row["low"], row["high"] = row.pop("interval")
        rows.append(row | {name: values.get(one.robot) for name, values in found.tables.items()})
    with swept_folder(SCRATCH) as folder:
        if is_result(out) and open_rows(out, folder)[0] != "trends":
            raise InputError(f"{out}: holds a result of another kind; name another folder with -o")
        table = pa.Table.from_pylist(rows).replace_schema_metadata({META: b"trends"})
        path = folder / "trends.parquet"
        pq.write_table(table, path, compression="zstd")
        Store(out).put(ROWS, path)


def _decide(axles: Sequence[AxleTrend]) -> None:
    from scipy.stats import false_discovery_control

    if axles:
        levels = false_discovery_control([one.p_value for one in axles])
        for one, level in zip(axles, levels.tolist(), strict=True):
            one.level, one.trend.significant = level, level <= RATE


def _friction_of(machine: MachineRuns) -> Iterator[AxleTrend]:
    """For every axle, the one of its series (one per level) with the likeliest change."""
    rows = machine.alike("friction")
    if len(rows) < FEWEST or not machine.rows[rows[-1]]["friction"]:
        return
    names, friction = tuple(machine.runs[row] for row in rows), [machine.rows[row]["friction"] for row in rows]
    rates = ("rate_per_s", "standard_deviation")
    warm_up = [{key: [one[key] for one in machine.rows[row]["warm_up"] or ()] for key in rates} for row in rows]
    by_joint: dict[str, list[Trend]] = {}
    for trend in friction_trends(names, machine.days(rows), machine.joints, friction, warm_up):
        by_joint.setdefault(trend.joint, []).append(trend)
    for trends in by_joint.values():
        best = min(trends, key=lambda trend: trend.probability)
        best.practical = float(np.log1p(PRACTICAL))
        yield _axle(machine, rows, best, len(trends))


def _errors_of(machine: MachineRuns) -> Iterator[AxleTrend]:
    rows, values = machine.errors
    if len(rows) < FEWEST:
        return
    names, days, nothing = tuple(machine.runs[row] for row in rows), machine.days(rows), np.zeros(len(rows))
    for axle, joint in enumerate(machine.joints):
        if np.all(values[:, axle] > 0):  # and no number is missing
            trend = Trend("prediction error", joint, "", names, days, values[:, axle], nothing, Background(nothing))
            trend.practical = float(np.log1p(PRACTICAL_ERROR))
            yield _axle(machine, rows, trend, 1)


def _axle(machine: MachineRuns, rows: list[int], trend: Trend, series: int) -> AxleTrend:
    from scipy.special import stdtrit

    found = trend.found
    half = float(stdtrit(len(rows) - 3, 0.975)) * found.deviation
    change, low, high = np.expm1(np.clip([found.size, found.size - half, found.size + half], -20, 20)).tolist()
    dates, p_value = tuple(machine.date(row) for row in rows), min(1.0, series * found.probability)
    return AxleTrend(machine.robot, trend, dates, p_value, change, low, high)
