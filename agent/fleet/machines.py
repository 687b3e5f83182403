"""A result, read machine by machine, so that memory does not grow with the fleet."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

#: Number of latest runs of a machine that are used: more than a year of weeks.
LATEST = 60
#: Rows that are read at once.
_BATCH = 256


class MachineRuns:
    """The latest runs of one machine, oldest first.

    `table` has the rows of R runs; `started` (R,) datetime64[us], NaT where unknown; `with_figures` (R,) bool. Of the
    latest run with figures: `joints` (n), and of an estimate `levels` (K joint and speed) and `nominal` (n,) [N·m].
    """

    def __init__(self, kind: str, table: Any):
        started = table["started"].to_numpy().astype("datetime64[us]")
        oldest_first = np.lexsort((table["run"].to_numpy(), started.astype(np.int64)))  # no time comes before any
        self.table = table = table.take(oldest_first[-LATEST:])
        self.robot: str = table["robot"][0].as_py()
        self.runs: list[str] = table["run"].to_pylist()
        self.started = table["started"].to_numpy()
        self.with_figures = table["status"].to_numpy() == "ok"
        self._errors = "gap_before" if kind == "diagnose" else "normalised_rmse"
        latest = np.flatnonzero(self.with_figures)[-1:]
        self.joints: tuple[str, ...] = ()
        self.levels: tuple[tuple[str, float], ...] = ()
        self.nominal = np.empty(0)
        for row in latest.tolist():
            self.joints = tuple(table["joints"][row].as_py())
            self.nominal = np.full(len(self.joints), np.nan)
            if kind == "estimate":
                self.levels = tuple((level["joint"], level["speed"]) for level in table["friction"][row].as_py())
                self.nominal = np.array(table["nominal_torque"][row].as_py(), dtype=float)

    def alike(self, name: str) -> np.ndarray:
        """Row numbers of the runs with as many figures in a column as the latest."""
        rows = np.flatnonzero(self.with_figures)
        lengths = self._lengths(name)[rows]
        return rows[lengths == lengths[-1:]]

    def figures(self, name: str, rows: np.ndarray, field: str = "") -> np.ndarray:
        """(R, …) of some runs that are alike in a column of lists, NaN where unknown."""
        values = self.table[name].combine_chunks().take(rows).flatten()
        values = (values.field(field) if field else values).to_numpy(zero_copy_only=False)
        return values.reshape(len(rows), len(values) // max(1, len(rows)))

    def rates(self, rows: np.ndarray, field: str) -> np.ndarray:
        """(R, n) of the warm-up of some runs, NaN where a run does not have it for every joint."""
        n = len(self.joints)
        found = np.full((len(self.runs), n), np.nan)
        known = np.flatnonzero(self.with_figures & (self._lengths("warm_up") == n))
        if len(known):
            found[known] = self.figures("warm_up", known, field)
        return found[rows]

    def _lengths(self, name: str) -> np.ndarray:
        import pyarrow.compute as pc

        return pc.list_value_length(self.table[name]).to_numpy()

    @cached_property
    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the runs with as many errors as the latest, and these errors (R, n), share of nominal torque."""
        rows = self.alike(self._errors)
        return rows, self.figures(self._errors, rows)

    def days(self, rows: np.ndarray) -> np.ndarray:
        """(R,) days since the first of some runs; their numbers where not all have a time of their own."""
        stamps = self.started[rows]
        if np.isnat(stamps).any() or not len(rows) or stamps[0] == stamps[-1]:
            return np.arange(len(rows), dtype=float)
        return (stamps - stamps[0]) / np.timedelta64(1, "D")

    def date(self, row: int) -> str:
        """Day of a run, ISO 8601; "" where it is not known."""
        return "" if np.isnat(self.started[row]) else str(self.started[row])[:10]


def read_machines(kind: str, rows: Any) -> Iterator[MachineRuns]:
    """Machines of a result's Parquet file, in the order of its rows."""
    import pyarrow as pa

    columns = ["robot", "run", "started", "status", "reason", "page", "joints"]
    columns += {
        "estimate": ["normalised_rmse", "friction", "warm_up", "nominal_torque"],
        "validate": ["normalised_rmse"],
        "diagnose": ["gap_before", "verdict", "causes"],
    }[kind]
    left: list[Any] = []
    for batch in rows.iter_batches(_BATCH, columns=columns):
        table = pa.concat_tables([*left, pa.Table.from_batches([batch])])
        robots = np.array(table["robot"].to_pylist(), dtype=object)
        *edges, last = [0, *(np.flatnonzero(robots[1:] != robots[:-1]) + 1).tolist()]
        for start, stop in pairwise([*edges, last]):
            yield MachineRuns(kind, table.slice(start, stop - start))
        left = [table.slice(last)]
    yield from (MachineRuns(kind, table) for table in left if len(table))
