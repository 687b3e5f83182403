"""A result, read machine by machine, so that memory does not grow with the fleet."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np

from agent.runs import days_since_first

#: Number of latest runs of a machine that are used: more than a year of weeks.
LATEST = 60
#: Rows that are read at once.
_BATCH = 256
#: Comes before every run whose time is known.
_UNKNOWN = datetime.min.replace(tzinfo=UTC)


class MachineRuns:
    """The latest runs of one machine, oldest first.

    `rows` are those of R runs. Of the latest run with figures: `joints` (n), and of an estimate `nominal` (n,) [N·m].
    """

    def __init__(self, kind: str, rows: list[dict[str, Any]]):
        self.rows = sorted(rows, key=lambda row: (row["started"] or _UNKNOWN, row["run"]))[-LATEST:]
        self.robot: str = rows[0]["robot"]
        self.runs: list[str] = [row["run"] for row in self.rows]
        self.with_figures = [number for number, row in enumerate(self.rows) if row["status"] == "ok"]
        self._errors = "gap_before" if kind == "diagnose" else "normalised_rmse"
        latest = self.rows[self.with_figures[-1]] if self.with_figures else {}
        self.joints: tuple[str, ...] = tuple(latest.get("joints", ()))
        estimated = kind == "estimate" and bool(latest)
        self.nominal = np.array(latest["nominal_torque"] if estimated else [np.nan] * len(self.joints), dtype=float)

    def alike(self, name: str) -> list[int]:
        """Numbers of the runs with as many figures in a column as the latest."""
        lengths = [len(self.rows[k][name] or ()) for k in self.with_figures]
        return [k for k, length in zip(self.with_figures, lengths, strict=True) if length == lengths[-1]]

    @cached_property
    def errors(self) -> tuple[list[int], np.ndarray]:
        """Numbers of the runs with as many errors as the latest, and these errors (R, n), share of nominal torque."""
        runs = self.alike(self._errors)
        values = [self.rows[k][self._errors] or () for k in runs]
        return runs, np.array(values, dtype=float).reshape(len(runs), len(values[0]) if values else 0)

    def days(self, runs: list[int]) -> np.ndarray:
        """(R,) days since the first of some runs; their numbers where not all have a time of their own."""
        return days_since_first([self.rows[k]["started"] for k in runs])

    def date(self, run: int) -> str:
        """Day of a run, ISO 8601; "" where it is not known."""
        started = self.rows[run]["started"]
        return "" if started is None else f"{started:%Y-%m-%d}"


def read_machines(kind: str, file: Any) -> Iterator[MachineRuns]:
    """Machines of a result's Parquet file, in the order of its rows."""
    columns = ["robot", "run", "started", "status", "reason", "page", "joints"]
    columns += {
        "estimate": ["normalised_rmse", "friction", "warm_up", "nominal_torque"],
        "validate": ["normalised_rmse"],
        "diagnose": ["gap_before", "verdict", "causes"],
    }[kind]
    rows = (row for batch in file.iter_batches(_BATCH, columns=columns) for row in batch.to_pylist())
    yield from (MachineRuns(kind, list(of_one)) for _, of_one in groupby(rows, key=lambda row: row["robot"]))
