"""What is held out from what: whole motions, parts of one, and every other segment."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from agent.core import InputError
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.candidate import Fold
from agent.recording import PARTS, Log


def folds_of(time: np.ndarray, log: np.ndarray, logs: Sequence[Log]) -> tuple[np.ndarray, list[Fold], list[Fold]]:
    """Cells of rows, folds that leave out a motion, and folds that leave out every other segment of a motion too."""
    parity = (time / LIMITS.row_correlation_time).astype(int) % 2
    group, names = _motions(time, log, logs) if len(logs) > 1 else _blocks(time, logs[0])
    cell = np.where(group >= 0, 2 * group + parity, -1)
    count = 2 * (int(group.max()) + 1)
    of_cell = np.arange(count) // 2
    folds, segment_folds = [], []
    for number, name in enumerate(names):
        test = of_cell == number
        folds.append(Fold(name, test, ~test))
        for side in (0, 1):
            half = test & (np.arange(count) % 2 == side)
            segment_folds.append(Fold(name, half, ~half))
    return cell, folds, segment_folds


def _motions(time: np.ndarray, log: np.ndarray, logs: Sequence[Log]) -> tuple[np.ndarray, list[str]]:
    """Every log for itself. One that was put together from pieces that differ is held out in its parts: what a short
    look shows of an effect says little of a wide motion, and would be all there is to predict it from. So is the only
    log in which some joint moves: no other could tell of what that joint has."""
    group = np.full(len(time), -1)
    names: list[str] = []
    only_movers = _only_movers(logs)
    for number, entry in enumerate(logs):
        here = log == number
        borders = part_borders(entry, 2 if number in only_movers else 1)
        since = time[here]
        guard = np.any(np.abs(since[:, None] - borders) < 2 * LIMITS.row_correlation_time, axis=1)
        group[here] = np.where(guard, -1, len(names) + np.searchsorted(borders, since))
        edges = [0.0, *borders, float(entry.t[-1])]
        names += [f"{entry.name} {a:.1f}-{b:.1f} s" for a, b in pairwise(edges)] if len(borders) else [entry.name]
    return group, names


def _only_movers(logs: Sequence[Log]) -> set[int]:
    """Logs, by number, that are the only ones in which some joint moves, of several."""
    travel = np.array([np.ptp(entry.position, axis=0) for entry in logs])  # (logs, n)
    moves = travel > LIMITS.negligible * travel.max(axis=0)
    return {int(np.flatnonzero(moves[:, joint])[0]) for joint in np.flatnonzero(moves.sum(axis=0) == 1)}


def part_borders(log: Log, least: int = 1) -> np.ndarray:
    """(parts - 1,) [s] between the parts of a log that says it has some, or the `least` that it is to have: all have
    the same time in motion."""
    stated_parts = log.metadata.get(PARTS, "1")
    parts = max(min(int(stated_parts), LIMITS.log_parts) if stated_parts.isdigit() else 1, least)
    if parts < 2:
        return np.empty(0)
    speed = np.abs(np.diff(log.position, axis=0))
    moves = np.any(speed > LIMITS.negligible * speed.max(axis=0), axis=1)
    moving_time = np.concatenate([[0.0], np.cumsum(moves * np.diff(log.t))])
    return np.interp(moving_time[-1] * np.arange(1, parts) / parts, moving_time, log.t)


def _blocks(time: np.ndarray, log: Log) -> tuple[np.ndarray, list[str]]:
    """One log: its cycles where it has three or more, else five blocks; rows near a border are in none."""
    starts = np.asarray(log.cycle_starts, dtype=float)
    first, last = float(time[0]), float(time[-1])
    if last - first < LIMITS.shortest:
        raise InputError(
            f"{log.path}: only {last - first:.1f} s remain after filtering; a single log needs "
            f"{LIMITS.shortest:g} s, as parts of it are held out: record longer, or give a second log"
        )
    inside = starts[(starts > first) & (starts < last)]
    if len(inside) >= 2:
        borders = inside[np.linspace(0, len(inside) - 1, min(len(inside), LIMITS.log_parts)).astype(int)]
    else:
        borders = np.linspace(first, last, LIMITS.log_parts + 1)[1:-1]
    group = np.searchsorted(borders, time)
    guard = np.min(np.abs(time[:, None] - borders[None, :]), axis=1) < 2 * LIMITS.row_correlation_time
    edges = [first, *borders, last]
    names = [f"{log.name} {a:.1f}-{b:.1f} s" for a, b in pairwise(edges)]
    return np.where(guard, -1, group), names


def segments_of(time: np.ndarray, log: np.ndarray, logs: Sequence[Log], lasting: float) -> np.ndarray:
    """(S',) segment of `lasting` seconds that a row lies in, counted over all logs, the same in every cycle of one."""
    segment_of = np.zeros(len(time), dtype=int)
    for number, entry in enumerate(logs):
        here = log == number
        starts = np.asarray(entry.cycle_starts, dtype=float)
        since = time[here]
        if len(starts) > 1:
            since = since - starts[np.maximum(np.searchsorted(starts, since, side="right") - 1, 0)]
        segment = np.maximum(since // lasting, -1).astype(int) + 1
        segment_of[here] = segment + (segment_of.max() + 1 if number else 0)
    return np.unique(segment_of, return_inverse=True)[1]
