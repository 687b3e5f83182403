"""What changes over time in a fleet: every axle of every machine, tested together.

The test of one series is that of `agent history` (`agent.runs.series`): friction as its logarithm beside the warm-up
that all axles share; the error of a validation or diagnosis as its logarithm alone. The levels of an axle count as one
finding, which has paid for their number, and the false discovery rate is controlled over all axles of the fleet.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, swept_folder
from agent.fleet.discoveries import RATE, Family, false_discovery_levels, find_families, read_columns
from agent.fleet.machines import MachineRuns, read_machines
from agent.fleet.result import META, ROWS, SOURCE, open_rows
from agent.fleet.store import SCRATCH, Store
from agent.fleet.tasks import KINDS
from agent.runs import FEWEST, PRACTICAL, Background, FrictionSeries, SeriesChange, find_change

#: Relative change of a prediction error that matters.
PRACTICAL_ERROR = 0.25
SCHEMA_NAME = "fleet-trends/1"


@dataclass(eq=False)
class Course:
    """One axle of one machine over its runs, R of them.

    `quantity` is what is looked at; days (R,) and values (R,) its course. `kind` (drift, step, or none where `level` is
    beyond `RATE`), relative `change` over the course with its 95 % interval (low, high), `since`: run and day before a
    step. `p_value`: probability by chance of as much; `level`: smallest rate of false discoveries at which it is a
    finding. `drift` is what is linear in time alone, with its deviation. An alarm is a finding of practical size.
    """

    robot: str
    joint: str
    quantity: str
    days: np.ndarray
    values: np.ndarray
    kind: str
    change: float
    low: float
    high: float
    since: str
    since_day: str
    p_value: float
    drift: float
    drift_deviation: float
    level: float = 1.0
    alarm: bool = False

    def text(self) -> str:
        """One sentence."""
        over = f"{100 * self.change:+.1f} % ({100 * self.low:+.1f} to {100 * self.high:+.1f})"
        if self.kind == "step":
            return f"{self.joint}: {self.quantity} stepped by {over} after {self.since_day or self.since}"
        return f"{self.joint}: {self.quantity} drifts, {over} over {self.days[-1] - self.days[0]:.0f} days"

    def to_dict(self) -> dict[str, Any]:
        """Plain data, without the course."""
        return {
            "robot": self.robot,
            "joint": self.joint,
            "quantity": self.quantity,
            "runs": len(self.days),
            "kind": self.kind,
            "change": self.change,
            "interval": [self.low, self.high],
            "since": self.since or None,
            "probability_by_chance": self.p_value,
            "false_discovery_level": self.level,
            "alarm": self.alarm,
        }


@dataclass(eq=False)
class FleetTrends:
    """All courses of a result, and the families among them. `short`: machines with too few runs for a trend."""

    kind: str
    result: str
    courses: list[Course]
    families: list[Family]
    short: int
    machines: int
    tables: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def alarms(self) -> list[Course]:
        """The surest first."""
        return sorted((one for one in self.courses if one.alarm), key=lambda one: one.p_value)

    def to_dict(self) -> dict[str, Any]:
        """Plain data; courses without an alarm only by their number."""
        return {
            "schema": SCHEMA_NAME,
            "result": self.result,
            "machines": self.machines,
            "too_few_runs": self.short,
            "series": len(self.courses),
            "false_discovery_rate": RATE,
            "alarms": [one.to_dict() for one in self.alarms],
            "families": [{**one.__dict__, "robots": list(one.robots)} for one in self.families],
        }

    def text(self) -> str:
        """For people."""
        alarms = self.alarms
        lines = [
            f"{self.machines} machines, {len(self.courses)} axles with at least {FEWEST} runs; {len(alarms)} alarms, "
            f"of which {100 * RATE:g} % are expected to be chance"
        ]
        lines += [f"{one.robot}: {one.text()}" for one in alarms[:50]]
        if len(alarms) > 50:
            lines.append(f"… and {len(alarms) - 50} more: --json, or `agent fleet report`")
        lines += [f"family: {one.text()}" for one in self.families]
        return "\n".join(lines)


def fleet_trends(result: str, tables: Sequence[Path] = (), on_machine: Any = None) -> FleetTrends:
    """Trends of a result; `on_machine` is shown every machine on the way.

    Raises:
        InputError: no result, or a table that cannot be used.
    """
    columns = read_columns(tables)
    courses: list[Course] = []
    machines = short = 0
    with swept_folder(SCRATCH) as folder:
        kind, rows = open_rows(result, folder)
        if kind not in KINDS:
            raise InputError(f"{result}: holds {kind}; name the result of an estimate, a validation or a diagnosis")
        for machine in read_machines(kind, rows):
            machines += 1
            found = list(machine_courses(kind, machine))
            short += not found
            courses += found
            if on_machine is not None:
                on_machine(machine, found)
    _decide(kind, courses)
    families = find_families(
        columns,
        [one.robot for one in courses],
        [one.joint for one in courses],
        np.array([one.drift for one in courses]),
        np.array([one.drift_deviation for one in courses]),
        np.array([one.alarm for one in courses], dtype=bool),
    )
    return FleetTrends(kind, result, courses, families, short, machines, columns)


def is_result(url: str) -> bool:
    """Whether a folder or URL holds the rows of a fleet."""
    try:
        Store(url).find(ROWS)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def source_of(url: str) -> str:
    """Where the runs of a result are; "" where nobody knows.

    Raises:
        InputError: no result.
    """
    with swept_folder(SCRATCH) as folder:
        return (open_rows(url, folder)[1].schema_arrow.metadata or {}).get(SOURCE, b"").decode()


def machine_courses(kind: str, machine: MachineRuns) -> Iterator[Course]:
    """The course of every axle of a machine that has enough runs; nothing is decided yet."""
    if kind == "estimate":
        yield from _friction_courses(machine)
    else:
        yield from _error_courses(machine)


def _decide(kind: str, courses: list[Course]) -> None:
    if not courses:
        return
    practical = np.log1p(PRACTICAL if kind == "estimate" else PRACTICAL_ERROR)
    levels = false_discovery_levels(np.array([one.p_value for one in courses]))
    for one, level in zip(courses, levels, strict=True):
        one.level = float(level)
        if level > RATE:
            one.kind, one.since, one.since_day = "none", "", ""
        one.alarm = bool(level <= RATE and abs(np.log1p(one.change)) >= practical)


def _friction_courses(machine: MachineRuns) -> Iterator[Course]:
    numbers = machine.with_figures("friction", "deviation")
    if len(numbers) < FEWEST or not machine.levels:
        return
    n = len(machine.joints)
    rates, rate_stds = np.full((2, len(numbers), n), np.nan)
    for row, k in enumerate(numbers):
        entry = machine.figures[k] or {}
        if len(entry["rate"]) == n:
            rates[row], rate_stds[row] = entry["rate"], entry["rate_std"]
    axles = tuple(machine.joints.index(joint) for joint, _ in machine.levels)
    days, values = machine.days(numbers), machine.column("friction", numbers)
    series = FrictionSeries(days, axles, values, machine.column("deviation", numbers), rates, rate_stds)
    best: dict[int, tuple[SeriesChange, int]] = {}
    counts: dict[int, int] = {}
    for k, background in series.backgrounds():
        found = find_change(np.log(values[:, k]), days, background)
        counts[axles[k]] = counts.get(axles[k], 0) + 1
        if axles[k] not in best or found.probability < best[axles[k]][0].probability:
            best[axles[k]] = found, k
    for axle, (found, k) in best.items():
        quantity = f"friction at {machine.levels[k][1]:.2g} rad/s"
        yield _course(machine, numbers, machine.joints[axle], quantity, values[:, k], days, found, counts[axle])


def _error_courses(machine: MachineRuns) -> Iterator[Course]:
    numbers = machine.with_figures("errors")
    if len(numbers) < FEWEST:
        return
    values, days = machine.column("errors", numbers), machine.days(numbers)
    nothing = Background(np.zeros(len(numbers)))
    for axle, joint in enumerate(machine.joints):
        if np.all(values[:, axle] > 0):  # and no number is missing
            found = find_change(np.log(values[:, axle]), days, nothing)
            yield _course(machine, numbers, joint, "prediction error", values[:, axle], days, found, 1)


def _course(
    machine: MachineRuns,
    numbers: list[int],
    joint: str,
    quantity: str,
    values: np.ndarray,
    days: np.ndarray,
    found: SeriesChange,
    paid: int,
) -> Course:
    from scipy.special import stdtrit

    half = float(stdtrit(len(values) - 3, 0.975)) * found.deviation
    change, low, high = np.expm1(np.clip([found.size, found.size - half, found.size + half], -20, 20))
    before = numbers[found.place - 1]
    step = found.kind == "step"
    return Course(
        machine.robot,
        joint,
        quantity,
        days,
        values,
        found.kind,
        float(change),
        float(low),
        float(high),
        machine.runs[before] if step else "",
        machine.date(before) if step else "",
        min(1.0, paid * found.probability),
        found.drift,
        found.drift_deviation,
    )


def write_trends(found: FleetTrends, out: str) -> None:
    """All courses as Parquet, a row each, with the columns that were brought.

    Raises:
        InputError: a folder with a result in it.
        AgentError: it cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    store = Store(out)
    rows = []
    for one in found.courses:
        row = one.to_dict()
        row["low"], row["high"] = row.pop("interval")
        rows.append(row | {name: values.get(one.robot) for name, values in found.tables.items()})
    with swept_folder(SCRATCH) as folder:
        if is_result(out) and open_rows(out, folder)[0] != "trends":
            raise InputError(f"{out}: holds a result of another kind; name another folder with -o")
        table = pa.Table.from_pylist(rows).replace_schema_metadata({META: b"trends"})
        path = folder / "trends.parquet"
        pq.write_table(table, path, compression="zstd")
        store.put(ROWS, path)
