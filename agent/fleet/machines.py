"""A result read machine by machine, as arrays: never more of it in memory than some groups of rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

#: Runs of a machine that are looked at, the latest: a year of weeks and more.
LATEST = 60
_NEVER = -(2**62)


@dataclass(eq=False)
class MachineRuns:
    """The runs of one machine, oldest first, R of them, of which the trends look at those with figures.

    runs, status, reason, page, verdict, causes of every run; started (R,) [µs since 1970], `_NEVER` where unknown.
    Of the runs with figures: errors (one array (n,) a run, share of nominal torque, NaN where unknown), and of an
    estimate friction and its deviation from run to run (K,) [N·m], rates and their deviations (n,) [1/s]. joints (n,),
    levels (K joint and speed) and nominal (n,) [N·m] are those of the latest run.
    """

    robot: str
    runs: list[str] = field(default_factory=list)
    started: list[int] = field(default_factory=list)
    status: list[str] = field(default_factory=list)
    reason: list[str] = field(default_factory=list)
    page: list[str | None] = field(default_factory=list)
    verdict: list[str | None] = field(default_factory=list)
    causes: list[str] = field(default_factory=list)
    figures: list[dict[str, np.ndarray] | None] = field(default_factory=list)
    joints: tuple[str, ...] = ()
    levels: tuple[tuple[str, float], ...] = ()
    nominal: np.ndarray = field(default_factory=lambda: np.empty(0))
    latest: tuple[Any, int] | None = None  # columns and row of the latest run with figures

    def put_in_order(self) -> None:
        """Oldest first, and no more than the latest; names are read from its last row alone."""
        if self.latest is not None:
            columns, row = self.latest
            self.joints = tuple(columns["joints"][row].as_py())
            self.nominal = np.full(len(self.joints), np.nan)
            if "friction" in columns:
                self.levels = tuple((level["joint"], level["speed"]) for level in columns["friction"][row].as_py())
                self.nominal = np.array(columns["nominal_torque"][row].as_py(), dtype=float)
            self.latest = None
        dated = [start for start in self.started if start != _NEVER]
        order = sorted(range(len(self.runs)), key=lambda k: (self.started[k] if dated else 0, self.runs[k]))[-LATEST:]
        for name in ("runs", "started", "status", "reason", "page", "verdict", "causes", "figures"):
            values = getattr(self, name)
            setattr(self, name, [values[k] for k in order])

    def with_figures(self, *names: str) -> list[int]:
        """Numbers of the runs that have these, as many of each as the latest run has."""
        found = [k for k, entry in enumerate(self.figures) if entry is not None and all(n in entry for n in names)]
        if not found:
            return []
        latest = self.figures[found[-1]] or {}
        return [k for k in found if all(len((self.figures[k] or {})[n]) == len(latest[n]) for n in names)]

    def column(self, name: str, numbers: list[int]) -> np.ndarray:
        """(R, …) of some runs."""
        return np.array([(self.figures[k] or {})[name] for k in numbers])

    def days(self, numbers: list[int]) -> np.ndarray:
        """(R,) days since the first of some runs; their numbers where not all have a time of their own."""
        stamps = np.array([self.started[k] for k in numbers], dtype=float)
        if _NEVER in stamps or np.ptp(stamps) <= 0:
            return np.arange(len(numbers), dtype=float)
        return (stamps - stamps[0]) / 86_400e6

    def date(self, number: int) -> str:
        """Day of a run, ISO 8601; "" where it is not known."""
        return "" if self.started[number] == _NEVER else str(np.datetime64(self.started[number], "us"))[:10]


def read_machines(kind: str, rows: Any) -> Iterator[MachineRuns]:
    """Machines of a result's Parquet file, in the order of its rows."""
    errors = "gap_before" if kind == "diagnose" else "normalised_rmse"
    columns = ["robot", "run", "started", "status", "reason", "page", "joints", errors]
    columns += {"estimate": ["friction", "warm_up", "nominal_torque"], "diagnose": ["verdict", "causes"]}.get(kind, [])
    machine: MachineRuns | None = None
    for group in range(rows.num_row_groups):
        batch = _Batch(rows.read_row_group(group, columns=columns).combine_chunks(), errors)
        for row, robot in enumerate(batch.robots):
            if machine is None or machine.robot != robot:
                if machine is not None:
                    machine.put_in_order()
                    yield machine
                machine = MachineRuns(robot)
            batch.add(row, machine)
    if machine is not None:
        machine.put_in_order()
        yield machine


class _Batch:
    """A group of rows with its nested columns as flat arrays and offsets."""

    def __init__(self, table: Any, errors: str):
        self._columns = {name: table[name].combine_chunks() for name in table.column_names}
        texts = ("robot", "run", "status", "reason", "page")
        plain = {name: self._columns[name].to_pylist() for name in texts}
        self.robots: list[str] = plain["robot"]
        self._plain = plain
        started = self._columns["started"].cast("int64").fill_null(_NEVER)
        self._started = started.to_numpy(zero_copy_only=False).tolist()
        self._verdicts = self._columns["verdict"].to_pylist() if "verdict" in self._columns else None
        self._causes = self._columns["causes"].to_pylist() if "causes" in self._columns else None
        self._errors = self._flat(errors)
        if "friction" in self._columns:
            self._values = self._flat("friction", "value")
            self._deviations = self._flat("friction", "from_run_to_run")
            self._rates = self._flat("warm_up", "rate_per_s")
            self._rate_stds = self._flat("warm_up", "standard_deviation")

    def add(self, row: int, machine: MachineRuns) -> None:
        """Take a row over into its machine."""
        for name in ("run", "status", "reason", "page"):
            getattr(machine, {"run": "runs"}.get(name, name)).append(self._plain[name][row])
        machine.started.append(self._started[row])
        machine.verdict.append(None if self._verdicts is None else self._verdicts[row])
        causes = () if self._causes is None else self._causes[row] or ()
        machine.causes.append(
            "; ".join(f"{cause['effect']} on {', '.join(cause['joints']) or 'the whole arm'}" for cause in causes)
        )
        if self._plain["status"][row] != "ok":
            machine.figures.append(None)
            return
        figures = {"errors": self._part(self._errors, row)}
        machine.latest = (self._columns, row)
        if "friction" in self._columns:
            figures |= {"friction": self._part(self._values, row), "deviation": self._part(self._deviations, row)}
            figures |= {"rate": self._part(self._rates, row), "rate_std": self._part(self._rate_stds, row)}
        machine.figures.append(figures)

    def _flat(self, name: str, field_name: str | None = None) -> tuple[np.ndarray, np.ndarray]:
        column = self._columns[name]
        values = column.values if field_name is None else column.values.field(field_name)
        return column.offsets.to_numpy(), values.to_numpy(zero_copy_only=False)

    @staticmethod
    def _part(flat: tuple[np.ndarray, np.ndarray], row: int) -> np.ndarray:
        offsets, values = flat
        return values[offsets[row] : offsets[row + 1]]
