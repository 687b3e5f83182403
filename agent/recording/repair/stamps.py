"""Order, sampling rate and gaps of a log, from its stamps. What is wrong is repaired and named, or refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.core import InputError
from agent.recording.log import NANO, Repair
from agent.recording.repair.clock import evened_bursts, set_back, unwrapped
from agent.recording.repair.grid import grid_rate, line, sample_numbers

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

    Parameters
    ----------
    stamp : (S,) [ns] in the order of the file
    values : arrays (S, n) that distinguish a repeated sample from another one with the same stamp; positions first
    name : of the file, for messages

    Raises
    ------
    InputError
        A single sample, or stamps that stand still, or that go back and cover the same time twice.
    """
    if len(stamp) < 2:
        raise InputError(f"{name}: 1 sample at {stamp[0] / NANO:.6f} s; a motion has more")
    stamp, repaired = unwrapped(stamp)
    if len(values):
        stamp, cut = set_back(stamp, values[0])
        stamp, spread = evened_bursts(stamp, values[0])
        repaired += cut + spread
    far = far_off(stamp)
    rows = np.flatnonzero(~far)
    first = int(stamp[rows].min())
    repairs = [*repaired, *Repair.of("samples with stamps far off, dropped", (stamp - first) / NANO, far)]
    back = np.append(False, np.diff(stamp[rows]) < 0)
    where = (stamp[rows] - first) / NANO
    if back.any() and len(values) and (in_order := _in_file_order(stamp[rows], values[0][rows])) is not None:
        repairs += Repair.of("stamps out of order where positions are in order, only stamps sorted", where, back)
        if len(in_order) < len(rows):
            when = float(where[back][0])
            repairs.append(Repair("samples with stamps of another time, dropped", when, len(rows) - len(in_order)))
        rows = rows[in_order]
        ordered = np.sort(stamp[rows])
        back[:] = False
    else:
        repairs += Repair.of("stamps out of order, sorted", where, back)
        rows = rows[np.argsort(stamp[rows], kind="stable")]
        ordered = stamp[rows]
    if stand_still(ordered):
        raise InputError(
            f"{name}: the stamps stand still at {ordered[0] / NANO:.6f} s ({len(stamp)} samples): without "
            "header.stamp nothing can be differentiated; record again with controller time in it"
        )
    same_stamp = np.append(False, np.diff(ordered) == 0)
    equal = same_stamp.copy()
    for array in values:
        again = np.flatnonzero(equal)
        equal[again] = np.all(array[rows[again - 1]] == array[rows[again]], axis=1)
    if back.any():
        _refuse_two_recordings(stamp, np.sort(rows[~equal]), name)
    other = same_stamp & ~equal
    times = (ordered - first) / NANO
    if other.sum() > max(0.05 * same_stamp.sum(), 0.01 * len(rows)):  # stamps are too coarse
        repairs += Repair.of("samples share a stamp, spread evenly", times, same_stamp)
        return Order(rows, _spread(ordered), tuple(repairs))
    repairs += Repair.of("repeated samples, dropped", times, equal)
    repairs += Repair.of("another sample with the same stamp, dropped", times, other)
    return Order(rows[~same_stamp], ordered[~same_stamp], tuple(repairs))


def stand_still(stamp: np.ndarray) -> bool:
    """Whether sorted stamps (S,) are all but the same."""
    return bool(1 + np.count_nonzero(np.diff(stamp)) < max(2, 0.01 * len(stamp)))


def spacing_of(stamp: np.ndarray, nominal_rate: float | None = None) -> Spacing:
    """Rate, gaps and jitter of strictly increasing stamps (S,) [ns]; `nominal_rate` [Hz] is what the log says.

    The rate is that of intervals which hold no missing sample. A nominal rate that agrees with it is taken instead,
    for it has no rounding of stamps in it.
    """
    interval = np.diff(stamp) / NANO
    time = (stamp - stamp[0]) / NANO
    # three quarters of the intervals hold no missing sample, or the sampling is irregular and the mean is all there is
    usual = float(np.quantile(interval, 0.75))
    hole = interval > 1.6 * usual
    period = float(np.mean(interval[~hole]))
    missing = np.maximum(np.rint(interval / period) - 1, 1).astype(int)

    def too_long() -> np.ndarray:
        """Which intervals are too long to be interpolated."""
        return interval > max(BRIDGED * (1 + 1e-9), 3.5 * period, 2.5 * usual)

    def uneven() -> np.ndarray:
        return ~hole & (np.abs(interval - period) > _JITTER * period)

    even = True
    if np.count_nonzero(uneven()) > _JITTERING * len(interval):
        grid = grid_rate(time, 1 / period)
        even = grid is not None
        if grid is not None:
            number = sample_numbers(time, grid)
            period, _ = line(number, time)
            missing = np.diff(number).astype(int) - 1
            hole = missing > 0
        else:  # the intervals vary as they like, so none but a gap says that a sample is missing
            period = float(np.median(interval))
            hole = too_long()
    rate, repairs = 1.0 / period, []
    if nominal_rate is not None and abs(rate / nominal_rate - 1.0) < 1e-3:
        rate = nominal_rate
    elif nominal_rate is not None:
        kind = f"stamps say {rate:.6g} Hz, the log says {nominal_rate:.6g} Hz; samples"
        repairs.append(Repair(kind, 0.0, len(stamp)))
    gap = hole & too_long()
    repairs += _repairs_of("gap, missing samples", time[:-1][gap], missing[gap])
    repairs += _repairs_of("missing samples, short enough to interpolate", time[:-1][hole & ~gap], missing[hole & ~gap])
    repairs += Repair.of("uneven intervals, kept", time[:-1], uneven())
    edges = [0, *(np.flatnonzero(gap) + 1).tolist(), len(stamp)]
    return Spacing(rate, tuple(pairwise(edges)), tuple(repairs), even)


def match(stamp: np.ndarray, others: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """For each of the stamps (S,) [ns] the nearest of the sorted `others`: index (S,), and (S,) whether it is within
    `tolerance` [s]."""
    index = np.interp(stamp - others[0], others - others[0], np.arange(len(others)))
    nearest = np.rint(index).astype(int)
    return nearest, np.abs(others[nearest] - stamp) <= tolerance * NANO


def far_off(stamp: np.ndarray) -> np.ndarray:
    """(S,) which of the stamps (S,) [ns] are far from nearly all others: a clock that was not set yet, a torn row."""
    early, late = np.quantile(stamp, [0.05, 0.95], method="nearest")
    middle, length = early + (late - early) // 2, (late - early) / 0.9
    far = np.abs(stamp - middle) > _FAR_OFF * NANO + _LENGTHS * length
    return far if np.count_nonzero(far) <= max(1.0, 0.01 * len(stamp)) else np.zeros(len(stamp), bool)


def _in_file_order(stamp: np.ndarray, position: np.ndarray) -> np.ndarray | None:
    """Rows to take as they stand in the file; None where they have to be sorted by their stamps (S,).

    Positions (S, n) decide: in order in the file and not by the stamps, the stamps jitter by more than a period.
    Rows whose stamps are of another time are left out.
    """
    order = np.argsort(stamp, kind="stable")
    in_place = np.arange(len(stamp))
    little_moved = np.abs(np.argsort(order) - in_place) <= _SWAPPED
    if np.count_nonzero(~little_moved) > 0.01 * len(stamp) or len(stamp) < 3:
        return None
    about = np.unique(np.clip(np.flatnonzero(order != in_place)[:, None] + np.arange(-2, 3), 1, len(stamp) - 2))
    in_file, by_stamp = (
        np.sum((rows[about + 1] - 2 * rows[about] + rows[about - 1]) ** 2, axis=0)
        for rows in (position, position[order])
    )
    in_order = np.all(in_file <= 1.5 * by_stamp) and np.any(in_file < 0.5 * by_stamp)  # noise has no order
    return np.flatnonzero(little_moved) if in_order else None


def _refuse_two_recordings(stamp: np.ndarray, rows: np.ndarray, name: str) -> None:
    """A clock that was set back, or two recordings in one file, cannot be sorted out; late samples can."""
    in_file = stamp[rows]
    edges = [0, *(np.flatnonzero(np.diff(in_file) < 0) + 1).tolist(), len(in_file)]
    stretches = [(int(in_file[a]), int(in_file[b - 1]), a, b) for a, b in pairwise(edges) if b - a >= _OVERLAP_SAMPLES]
    stretches.sort()
    for (start, end, a, b), (start_2, end_2, sample, _) in pairwise(stretches):
        overlap = (min(end, end_2) - start_2) / NANO
        covered = np.searchsorted(in_file[a:b], [start_2, min(end, end_2)])
        if overlap > _OVERLAP_TIME and covered[1] - covered[0] >= _OVERLAP_SAMPLES:
            raise InputError(
                f"{name}: the controller's clock was set back, or two recordings are in one file: {overlap:.3f} s from "
                f"{(start_2 - start) / NANO:.3f} s on are there twice, with other values (sample {sample} on); split it"
            )


def _spread(stamp: np.ndarray) -> np.ndarray:
    """Sorted stamps (S,) of which several are equal, spread evenly up to the next one."""
    distinct, start, count = np.unique(stamp, return_index=True, return_counts=True)
    end = distinct[-1] + (distinct[-1] - distinct[-2]) * count[-1] // count[-2]
    known = np.append(distinct, end) - distinct[0]
    return distinct[0] + np.interp(np.arange(len(stamp)), np.append(start, len(stamp)), known).astype(np.int64)


def _repairs_of(kind: str, times: np.ndarray, counts: np.ndarray) -> list[Repair]:
    if len(times) <= _LISTED:
        return [Repair(kind, float(time), int(count)) for time, count in zip(times, counts, strict=True)]
    return [Repair(f"{kind}, in {len(times)} places, the first", float(times[0]), int(counts.sum()))]
