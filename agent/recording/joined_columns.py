"""Columns with clocks of their own on one clock: files with their own stamps, rows of several topics in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Stamps are the same if they differ by at most this part of the period.
_SAME = 0.1
#: Samples further apart than this times the period are not interpolated between.
JOINED = 2.5
#: Part of the rows of the rarest column that hold all others, from where on they are rows of one table.
_TOGETHER = 0.5


@dataclass(frozen=True, eq=False)
class TimedColumn:
    """Values (S,) at times (S,) [s]; `numbers`: they may be interpolated, and are no marks."""

    time: np.ndarray
    values: np.ndarray
    numbers: bool = True

    @property
    def known(self) -> TimedColumn:
        """The rows with a time and a value, in order of time, each time once."""
        rows = np.flatnonzero(np.isfinite(self.time) & np.isfinite(self.values))
        time, first = np.unique(self.time[rows], return_index=True)
        return TimedColumn(time, self.values[rows][first], self.numbers)

    def at(self, time: np.ndarray) -> np.ndarray:
        """(T,) at other times, as a bag's joints are joined: linear between samples, NaN where they are far apart."""
        after = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        around = np.where(time == self.time[after], 0.0, self.time[after] - self.time[after - 1])
        covered = (time >= self.time[0]) & (time <= self.time[-1])
        covered &= around <= JOINED * float(np.median(np.diff(self.time)))
        if self.numbers:
            values = np.interp(time, self.time, self.values)
        else:
            before = time - self.time[after - 1] < self.time[after] - time
            values = self.values[np.where(before, after - 1, after)]
        return np.where(covered, values, np.nan)


def one_clock(columns: Sequence[TimedColumn]) -> bool:
    """Whether columns are rows of one table: the same stamps, and most rows hold all of them."""
    first = columns[0].time
    for time in {id(column.time): column.time for column in columns}.values():
        if len(time) != len(first):
            return False
        known = np.isfinite(first) & np.isfinite(time)
        period = float(np.median(np.abs(np.diff(first[known])))) if np.count_nonzero(known) > 1 else 0.0
        if np.abs(first - time)[known].max(initial=0.0) > _SAME * period:
            return False
    known = np.isfinite([column.values for column in columns])
    return bool(np.count_nonzero(known.all(axis=0)) >= _TOGETHER * known.sum(axis=1).min())


def join(columns: Sequence[TimedColumn]) -> tuple[np.ndarray, list[np.ndarray]] | None:
    """Time (S,) [s] of the slowest column where all others are known, and their values (S,) there; None where they
    have no time in common."""
    known = [column.known for column in columns]
    if min(len(column.time) for column in known) < 2:
        return None
    time = min(known, key=lambda column: len(column.time)).time
    inside = (time >= max(column.time[0] for column in known)) & (time <= min(column.time[-1] for column in known))
    if np.count_nonzero(inside) < 2:
        return None
    return time[inside], [column.at(time[inside]) for column in known]
