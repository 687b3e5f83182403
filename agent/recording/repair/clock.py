"""Clocks that wrap around, pass midnight or are set back, stamps of arrival, and rows that were lost without stamps."""

from __future__ import annotations

import numpy as np

from agent.core import counted
from agent.recording.log import NANO, Repair
from agent.recording.repair.grid import line

#: Full ranges of clocks [s]: counters of 16, 31 and 32 bit in usual units, and the time of day, of half a day, an hour.
_RANGES = np.array([2.0**bits * unit for bits in (16, 31, 32) for unit in (1, 1e-3, 1e-6, 1e-7, 1e-9)])
_RANGES = np.append(_RANGES, [86_400.0, 43_200.0, 3_600.0])
#: Periods that may be missing where a clock wraps.
_NEAR = 10.0
#: Rows for which a clock that was set back stays behind: fewer are late samples. The stretch is cut out by this [s].
_BEHIND, _CUT = 20, 1.0
#: Of arrival: samples of a burst at least, part of the bursts with nearly as many (in `with_lost_rows`, of long steps
#: that are whole), pause over spacing within, part of the time in pauses, scatter of the pauses; and how much further
#: positions may go over a pause than within.
_FEWEST, _ALIKE, _PAUSE, _WAITING, _REGULAR, _FURTHER = 3, 0.9, 5.0, 0.8, 0.25, 3.0
#: Of a lost row: steps by their velocity, at least this part of the largest; and how near the way is to whole steps.
_CLEAR, _WHOLE = 0.2, 0.25
#: Of many lost rows: how far a step goes beyond its velocity, in large steps; rows in which a spike is over.
_JUMP, _SPIKE = 2.0, 5
#: Without a velocity: steps on either side that say how far one goes. With 2 or 6, three of eight logs with lost rows
#: are repaired otherwise, and none of 34 whole ones.
_AROUND = 3
_COUNT = 1e-12  # numerical: least step of an encoder


def unwrapped(stamp: np.ndarray) -> tuple[np.ndarray, list[Repair]]:
    """Stamps (S,) [ns] in the order of the file without steps back by the full range of a clock.

    A step is one only where the clock goes on by its usual period after it, so that blocks in wrong order are none.
    """
    step = np.diff(stamp)
    back = np.flatnonzero(step < 0)
    if not len(back) or len(back) > 0.1 * len(step):
        return stamp, []
    period = float(np.median(step[step > 0])) if np.any(step > 0) else 0.0
    ranges = np.rint(_RANGES * NANO).astype(np.int64)
    on = step[back][:, None] + ranges - period
    long = ranges > _NEAR**2 * period  # a shorter range is that of late samples
    whole = np.where(long & (np.abs(on) <= _NEAR * period), ranges, 0).max(axis=1)
    if not whole.all():
        return stamp, []
    added = np.zeros(len(stamp), np.int64)
    added[back + 1] = whole
    kind = f"stamps that start again after {whole[0] / NANO:.9g} s, continued"
    return stamp + np.cumsum(added), Repair.of(kind, (stamp[back] - stamp[0]) / NANO)


def set_back(stamp: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, list[Repair]]:
    """Stamps (S,) [ns] in the order of the file; where a clock was set back once while positions (S, n) went on, what
    follows comes a second later, as a segment of its own."""
    back = np.flatnonzero(np.diff(stamp) < 0)
    if len(back) != 1 or min(back[0] + 1, len(stamp) - back[0] - 1) < _BEHIND:
        return stamp, []
    first = int(back[0]) + 1
    travel = np.abs(np.diff(position[first - _BEHIND : first + _BEHIND], axis=0)).sum(axis=1)
    is_jump = travel[_BEHIND - 1] > _FURTHER * np.median(travel)
    if np.count_nonzero(stamp[first:] < stamp[first - 1]) < _BEHIND or is_jump:
        return stamp, []
    lag = int(stamp[first - 1] - stamp[first])
    moved = stamp.copy()
    moved[first:] += lag + int(_CUT * NANO)
    kind = f"the clock was set back by {lag / NANO:.6g} s, cut there"
    return moved, [Repair(kind, float(stamp[first - 1] - stamp[0]) / NANO, 1)]


def evened_bursts(stamp: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, list[Repair]]:
    """Stamps (S,) [ns] of samples that arrive in bursts, in the order of the file, on the grid they were taken on.

    Positions (S, n) go as far from row to row over a pause as within a burst: the arm moved on, the stamps did not.
    Then the arrivals give the rate. Where rows are missing they do not lie on a line, and the stamps stay.
    """
    step = np.diff(stamp)
    usual = float(np.median(np.abs(step)))
    pause = step > _PAUSE * usual
    starts = np.append(0, np.flatnonzero(pause) + 1)
    size = np.diff(starts)
    if usual == 0 or len(size) < _FEWEST or np.median(size) < _FEWEST:
        return stamp, []
    apart = np.diff(stamp[starts])
    alike = np.mean(np.abs(size - np.median(size)) <= 1)
    waiting = step[pause].sum() > _WAITING * step.sum() and step.min() > -0.5 * step[pause].min()
    if alike < _ALIKE or not waiting or np.std(apart) > _REGULAR * np.mean(apart):
        return stamp, []
    travel = np.abs(np.diff(position, axis=0)).sum(axis=1)
    if not travel.any() or np.mean(travel[pause]) > _FURTHER * np.mean(travel[~pause]):
        return stamp, []
    # the last sample of a burst is taken as it arrives; the first and the last burst may be cut short
    last, arrival = starts[1:].astype(float) - 1, (stamp[starts[:-1]] - stamp[0]).astype(float)
    slope, intercept = line(last, arrival)
    if np.abs(arrival - intercept - slope * last).max() > 0.5 * np.mean(apart):
        return stamp, []
    even = stamp[0] + np.rint(intercept + slope * np.arange(len(stamp))).astype(np.int64)
    kind = f"stamps of arrival, {np.median(size):.0f} at a time every {np.mean(apart) / NANO:.3g} s, spread evenly"
    return even, [Repair(f"{kind} at {NANO / slope:.6g} Hz; samples", 0.0, len(stamp))]


def with_lost_rows(
    stamp: np.ndarray, position: np.ndarray, velocity: np.ndarray | None = None
) -> tuple[np.ndarray, list[Repair]]:
    """Stamps (S,) [ns] of rows that are counted and not stamped, with the time of those that are missing.

    Between two rows joints go by their velocity (S, n) for one period, or for two where a row was lost: the way over
    that by velocity is then 2, for all joints alike. Slow steps do not show it. Where positions jump and stay, an
    unknown number of rows was lost: what follows comes a second later, as a segment of its own. Without a velocity, the
    steps around a row say how far one goes, if long steps are whole ones.
    """
    step, change = np.diff(stamp), np.diff(position, axis=0)
    if velocity is None:
        by_velocity, whose = _usual_steps(change), "their neighbours say, which slow steps do not show"
    else:
        ends = velocity[:-1] * step[:, None] / NANO, velocity[1:] * step[:, None] / NANO
        by_velocity, whose = _steady(*ends, change), "the velocity says"
    square = np.sum(by_velocity**2, axis=1)
    large, longest = (np.quantile(each, 0.95) for each in (square, np.sum(change**2, axis=1)))
    clear = square > _CLEAR**2 * large
    times = np.sum(change * by_velocity, axis=1) / np.where(square > 0, square, 1.0)
    error = np.sum((change - times[:, None] * by_velocity) ** 2, axis=1)
    periods = np.rint(times)
    # a velocity that is not the derivative of its position says nothing, nor do a few steps of a stationary arm
    agrees = large > 0 and np.median(np.abs(times[clear] - 1)) < _WHOLE / 2
    lost = clear & (periods >= 2) & (np.abs(times - periods) < _WHOLE) & (error < _WHOLE**2 * np.sum(change**2, axis=1))
    further = clear & (times > 1 + _WHOLE)
    if not agrees or (velocity is None and np.count_nonzero(lost) < _ALIKE * np.count_nonzero(further)):
        return stamp, []
    beyond = np.pad(np.cumsum(change - by_velocity, axis=0), ((_SPIKE + 1, _SPIKE), (0, 0)), mode="edge")
    jump, lasting_change = change - by_velocity, beyond[2 * _SPIKE + 1 :] - beyond[: -2 * _SPIKE - 1]
    cut = ~lost & (np.minimum(np.sum(jump**2, axis=1), np.sum(lasting_change**2, axis=1)) > _JUMP**2 * longest)
    missing = np.where(lost, periods - 1, 0).astype(np.int64)
    repairs = []
    for places, what in (
        (lost, f"move on by more than {whose}; their time is added"),
        (cut, "jump; cut there"),
    ):
        if places.any():
            first, count = int(np.argmax(places)), int(missing.sum() if places is lost else cut.sum())
            where = f"{counted(int(places.sum()), 'place')}, first after row {first + 1}"
            kind = f"rows are missing at {where}: positions {what}{'; rows' if places is lost else ''}"
            repairs.append(Repair(kind, float(stamp[first] - stamp[0]) / NANO, count))
    return stamp + np.append(0, np.cumsum(missing * step + cut * int(_CUT * NANO))), repairs


def _usual_steps(change: np.ndarray) -> np.ndarray:
    """(S, n) how far the steps around each of `change` (S, n) go, on which single lost rows have no influence."""
    padded = np.pad(change, ((_AROUND, _AROUND), (0, 0)), mode="edge")
    sides = [range(_AROUND), range(_AROUND + 1, 2 * _AROUND + 1)]
    before, after = (np.median([padded[k : k + len(change)] for k in side], axis=0) for side in sides)
    return _steady(before, after, change)


def _steady(before: np.ndarray, after: np.ndarray, change: np.ndarray) -> np.ndarray:
    """(S, n) the mean of two expected steps; zero where they differ, as where a motion starts, or are few counts of the
    encoder that made the steps `change` (S, n)."""
    usual, distance = 0.5 * (before + after), np.abs(change)
    alike = np.sum((after - before) ** 2, axis=1) < (2 * _WHOLE) ** 2 * np.sum(usual**2, axis=1)
    count = np.min(distance, axis=0, where=distance > _COUNT, initial=np.inf)  # of the encoder, or of the file
    return np.asarray(usual * (alike & np.any(np.abs(usual) > count / _WHOLE, axis=1))[:, None])
