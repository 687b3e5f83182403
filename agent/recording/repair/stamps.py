"""Order, sampling rate and gaps of a log, from its stamps. What is wrong is repaired and named, or refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.core import InputError
from agent.recording.log import Repair
from agent.recording.repair.grid import grid_rate, line, sample_numbers

_NANO = 1_000_000_000
#: A stretch without samples of at most this [s], or of two samples, can be interpolated; a longer one is a gap.
BRIDGED = 0.010
#: Intervals that are off by more than this part of the period are counted as jitter.
_JITTER = 0.2
#: With more than this part of the intervals so, the stamps jitter around a grid, or the sampling is irregular.
_JITTERING = 0.05
#: Repairs of a kind that are listed one by one; more are summed up.
_LISTED = 10
#: Samples, and seconds, by which two stretches in order must overlap to be two recordings in one file.
_OVERLAP_SAMPLES, _OVERLAP_TIME = 50, 0.5
#: Rows by which jitter of the stamps can change the order.
_SWAPPED = 20
#: A stamp further from the middle of the log than this [s] and this many times its length belongs to another clock.
_FAR_OFF, _LENGTHS = 10.0, 2.0


@dataclass(frozen=True, eq=False)
class Order:
    """Samples in order of time: `rows` (S,) of the input to take, their stamps (S,) [ns], strictly increasing."""

    rows: np.ndarray
    stamp: np.ndarray
    repairs: tuple[Repair, ...]


@dataclass(frozen=True, eq=False)
class Spacing:
    """Sampling rate [Hz], the [start, stop) ranges of samples without a gap, and whether samples were taken on an even
    grid."""

    rate: float
    segments: tuple[tuple[int, int], ...]
    repairs: tuple[Repair, ...]
    even: bool = True


def put_in_order(stamp: np.ndarray, values: Sequence[np.ndarray], name: str) -> Order:
    """Sort samples by their stamps; drop repetitions; spread samples that share a stamp too coarse for their rate.

    Args:
        stamp: (S,) [ns] in the order of the file.
        values: arrays (S, n) that tell a repeated sample from another one with the same stamp.
        name: of the file, for messages.

    Raises:
        InputError: a single sample, or stamps that stand still, or that go back and cover the same time twice.
    """
    if len(stamp) < 2:
        raise InputError(f"{name}: 1 sample at {stamp[0] / _NANO:.6f} s; a motion has more")
    far = far_off(stamp)
    rows = np.flatnonzero(~far)
    first = int(stamp[rows].min())
    repairs = []
    if far.any():
        away = (int(stamp[far][0]) - first) / _NANO
        repairs.append(Repair("samples with stamps far off, dropped", away, int(far.sum())))
    back = np.flatnonzero(np.diff(stamp[rows]) < 0)
    if len(back) and len(values) and (kept := _in_file_order(stamp[rows], values[0][rows])) is not None:
        where = (int(stamp[rows[back[0] + 1]]) - first) / _NANO
        repairs.append(Repair("stamps out of order where positions are in order, only stamps sorted", where, len(back)))
        if len(kept) < len(rows):
            repairs.append(Repair("samples with stamps of another time, dropped", where, len(rows) - len(kept)))
        rows = rows[kept]
        stamp = stamp.copy()
        stamp[rows] = np.sort(stamp[rows])
        back = back[:0]
    if len(back):
        where = (int(stamp[rows[back[0] + 1]]) - first) / _NANO
        repairs.append(Repair("stamps out of order, sorted", where, len(back)))
        rows = rows[np.argsort(stamp[rows], kind="stable")]
    ordered = stamp[rows]
    same_stamp = np.diff(ordered) == 0
    if stand_still(ordered):
        raise InputError(
            f"{name}: the stamps stand still at {ordered[0] / _NANO:.6f} s ({len(stamp)} samples): without "
            "header.stamp nothing can be differentiated; record again with controller time in it"
        )
    equal = same_stamp.copy()
    for array in values:
        equal[equal] = np.all(array[rows[:-1][equal]] == array[rows[1:][equal]], axis=1)
    other = same_stamp & ~equal
    coarse = other.sum() > max(0.05 * same_stamp.sum(), 0.01 * len(rows))
    if len(back):
        _refuse_two_recordings(stamp, np.sort(rows[~np.append(False, equal)]), name)
    if not coarse:
        times = (ordered[1:] - first) / _NANO
        repairs += _summed("repeated samples, dropped", times, equal)
        repairs += _summed("another sample with the same stamp, dropped", times, other)
        keep = ~np.append(False, same_stamp)
        rows, ordered = rows[keep], ordered[keep]
    else:
        repairs += _summed("samples share a stamp, spread evenly", (ordered[1:] - first) / _NANO, same_stamp)
        ordered = _spread(ordered)
    return Order(rows, ordered, tuple(repairs))


def stand_still(stamp: np.ndarray) -> bool:
    """Whether sorted stamps (S,) are all but the same."""
    return bool(1 + np.count_nonzero(np.diff(stamp)) < max(2, 0.01 * len(stamp)))


def spacing_of(stamp: np.ndarray, nominal_rate: float | None = None) -> Spacing:
    """Rate, gaps and jitter of strictly increasing stamps (S,) [ns]; `nominal_rate` [Hz] is what the log says.

    The rate is that of intervals which hold no missing sample. A nominal rate that agrees with it is taken instead,
    for it has no rounding of stamps in it.
    """
    interval = np.diff(stamp) / _NANO
    time = (stamp - stamp[0]) / _NANO
    # three quarters of the intervals hold no missing sample, or the sampling is irregular and the mean is all there is
    usual = float(np.quantile(interval, 0.75))
    hole = interval > 1.6 * usual
    period = float(np.mean(interval[~hole]))
    missing = np.maximum(np.rint(interval / period) - 1, 1).astype(int)
    jitter = ~hole & (np.abs(interval - period) > _JITTER * period)
    even = True
    if np.count_nonzero(jitter) > _JITTERING * len(interval):
        grid = grid_rate(time, 1 / period)
        even = grid is not None
        if grid is not None:
            number = sample_numbers(time, grid)
            period, _ = line(number, time)
            missing = np.diff(number).astype(int) - 1
            hole = missing > 0
        else:  # the intervals vary as they like, so none but a gap says that a sample is missing
            period = float(np.median(interval))
            hole = _gaps(interval, period, usual)
        jitter = ~hole & (np.abs(interval - period) > _JITTER * period)
    rate, repairs = 1.0 / period, []
    if nominal_rate is not None:
        if abs(rate / nominal_rate - 1.0) < 1e-3:
            rate = nominal_rate
        else:
            repairs.append(
                Repair(f"stamps say {rate:.6g} Hz, the log says {nominal_rate:.6g} Hz; samples", 0.0, len(stamp))
            )
    gap = hole & _gaps(interval, period, usual)
    repairs += _listed("gap, missing samples", time[:-1][gap], missing[gap])
    repairs += _listed("missing samples, short enough to interpolate", time[:-1][hole & ~gap], missing[hole & ~gap])
    repairs += _summed("uneven intervals, kept", time[:-1], jitter)
    cuts = np.flatnonzero(gap) + 1
    edges = [0, *cuts.tolist(), len(stamp)]
    return Spacing(rate, tuple(pairwise(edges)), tuple(repairs), even)


def _gaps(interval: np.ndarray, period: float, usual: float) -> np.ndarray:
    """Which intervals [s] are too long to be interpolated."""
    return interval > max(BRIDGED * (1 + 1e-9), 3.5 * period, 2.5 * usual)


def match(stamp: np.ndarray, others: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """For each of the stamps (S,) [ns] the nearest of the sorted `others`: index (S,), and (S,) whether it is within
    `tolerance` [s]."""
    place = np.interp(stamp - others[0], others - others[0], np.arange(len(others)))
    nearest = np.rint(place).astype(int)
    return nearest, np.abs(others[nearest] - stamp) <= tolerance * _NANO


def far_off(stamp: np.ndarray) -> np.ndarray:
    """(S,) which of the stamps (S,) [ns] are far from nearly all others: a clock that was not set yet, a torn row."""
    early, late = np.quantile(stamp, [0.05, 0.95], method="nearest")
    middle, length = early + (late - early) // 2, (late - early) / 0.9
    far = np.abs(stamp - middle) > _FAR_OFF * _NANO + _LENGTHS * length
    return far if np.count_nonzero(far) <= max(1.0, 0.01 * len(stamp)) else np.zeros(len(stamp), bool)


def _in_file_order(stamp: np.ndarray, position: np.ndarray) -> np.ndarray | None:
    """Which rows (S,) to take as they stand in the file, if positions (S, n) are in order there and in that of the
    stamps are not: stamps that jitter by more than a period, and a few that are of another time."""
    order = np.argsort(stamp, kind="stable")
    away = np.empty(len(stamp), int)
    away[order] = np.arange(len(stamp))
    near = np.abs(away - np.arange(len(stamp))) <= _SWAPPED
    moved = np.flatnonzero(order != np.arange(len(stamp)))
    about = np.unique(np.clip(moved[:, None] + np.arange(-2, 3), 1, len(stamp) - 2))
    if np.count_nonzero(~near) > 0.01 * len(stamp) or len(stamp) < 3:
        return None
    in_file, by_stamp = (
        np.sum((rows[about + 1] - 2 * rows[about] + rows[about - 1]) ** 2, axis=0)
        for rows in (position, position[order])
    )
    in_order = np.all(in_file <= 1.5 * by_stamp) and np.any(in_file < 0.5 * by_stamp)  # noise has no order
    return np.flatnonzero(near) if in_order else None


def _refuse_two_recordings(stamp: np.ndarray, rows: np.ndarray, name: str) -> None:
    """A clock that was set back, or two recordings in one file, cannot be sorted out; late samples can."""
    in_file = stamp[rows]
    edges = [0, *(np.flatnonzero(np.diff(in_file) < 0) + 1).tolist(), len(in_file)]
    stretches = [(int(in_file[a]), int(in_file[b - 1]), a, b) for a, b in pairwise(edges) if b - a >= _OVERLAP_SAMPLES]
    stretches.sort()
    for (start, end, a, b), (start_2, end_2, place, _) in pairwise(stretches):
        overlap = (min(end, end_2) - start_2) / _NANO
        covered = np.searchsorted(in_file[a:b], [start_2, min(end, end_2)])
        if overlap > _OVERLAP_TIME and covered[1] - covered[0] >= _OVERLAP_SAMPLES:
            raise InputError(
                f"{name}: the controller's clock was set back, or two recordings are in one file: {overlap:.3f} s from "
                f"{(start_2 - start) / _NANO:.3f} s on are there twice, with other values (sample {place} on); split it"
            )


def _spread(stamp: np.ndarray) -> np.ndarray:
    """Sorted stamps (S,) of which several are equal, spread evenly up to the next one."""
    distinct, start, count = np.unique(stamp, return_index=True, return_counts=True)
    end = distinct[-1] + (distinct[-1] - distinct[-2]) * count[-1] // count[-2]
    known = np.append(distinct, end) - distinct[0]
    return distinct[0] + np.interp(np.arange(len(stamp)), np.append(start, len(stamp)), known).astype(np.int64)


def _summed(kind: str, times: np.ndarray, which: np.ndarray) -> list[Repair]:
    return [Repair(kind, float(times[which][0]), int(which.sum()))] if which.any() else []


def _listed(kind: str, times: np.ndarray, counts: np.ndarray) -> list[Repair]:
    if len(times) <= _LISTED:
        return [Repair(kind, float(time), int(count)) for time, count in zip(times, counts, strict=True)]
    return [Repair(f"{kind}, in {len(times)} places, the first", float(times[0]), int(counts.sum()))]
