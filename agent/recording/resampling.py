"""An unevenly sampled log on an even grid."""

from __future__ import annotations

import numpy as np

from agent.core import InputError
from agent.recording.log import Log, Repair

_Grids = list[tuple[int, int, np.ndarray]]  # first and stop of a segment, and the times [s] on the new grid


def resampled(log: Log, rate: float | None = None) -> Log:
    """The log on an even grid of `rate` [Hz] (its own rate if None), segment by segment; gaps stay gaps.

    Position, velocity and set-points by cubic splines (not-a-knot), which differentiate smoothly; effort by a monotone
    cubic (Fritsch and Carlson, SIAM J. Numer. Anal. 17, 1980), which does not overshoot where friction steps. There is
    no filter in it: before a rate is lowered, what it cannot carry has to be filtered out.

    Raises:
        InputError: no segment holds two samples of the new grid.
    """
    rate = log.sample_rate if rate is None else rate
    grids, segments, start = [], [], 0
    for first, stop in log.segments:
        begin, end = log.t[first], log.t[stop - 1]
        count = int(np.floor((end - begin) * rate * (1 + 1e-9))) + 1
        if stop - first >= 2 and count >= 2:
            grids.append((first, stop, np.minimum(begin + np.arange(count) / rate, end)))
            segments.append((start, start + count))
            start += count
    if not grids:
        raise InputError(f"{log.path}: {log.t[-1]:.3f} s in {len(log.segments)} parts: too short for {rate:g} Hz")
    t = np.concatenate([grid for _, _, grid in grids])
    return log.with_arrays(
        lambda values: _on(log.t, values, grids),
        effort=None if log.effort is None else _on(log.t, log.effort, grids, monotone=True),
        t=t - t[0],
        sample_rate=rate,
        even=True,
        stamp=log.stamp + t[0],
        segments=tuple(segments),
        breaks=tuple(time - t[0] for time in log.breaks),
        cycle_starts=tuple(cycle - t[0] for cycle in log.cycle_starts if t[0] <= cycle <= t[-1]),
        repairs=(*log.repairs, Repair(f"interpolated to {rate:g} Hz, samples", 0.0, len(t))),
    )


def _on(time: np.ndarray, values: np.ndarray, grids: _Grids, monotone: bool = False) -> np.ndarray:
    """(S', n) on the grids from (S, n) at times (S,); not a number wherever a neighbour is not."""
    from scipy.interpolate import CubicSpline, PchipInterpolator

    parts = []
    for first, stop, grid in grids:
        t, known = time[first:stop], values[first:stop]
        finite = np.all(np.isfinite(known), axis=1)
        part = np.full((len(grid), values.shape[1]), np.nan)
        # set-points are known in stretches: each is interpolated on its own
        edges = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]])))
        for a, b in edges.reshape(-1, 2):
            inside = (grid >= t[a]) & (grid <= t[b - 1])
            if b - a >= 2:
                curve = (PchipInterpolator if monotone else CubicSpline)(t[a:b], known[a:b], axis=0)
                part[inside] = curve(grid[inside])
            else:
                part[inside] = known[a]
        parts.append(part)
    return np.concatenate(parts)
