"""Set-points on the stamps of the samples: held from one to the next, or on the way between them."""

from __future__ import annotations

import numpy as np

from agent.recording.log import NANO

#: Set-points further apart than this times their period are not interpolated between.
_APART = 2.5


def held(stamp: np.ndarray, issued: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(S, n) the last of the commands (C, n) issued at sorted stamps (C,) [ns] before the sample that follows each of
    the samples at (S,) [ns]; NaN before the first command."""
    following = np.append(stamp[1:], 2 * stamp[-1] - stamp[-2])
    last = np.searchsorted(issued, following, side="left") - 1
    latest = values[np.maximum(last, 0)].astype(float)
    latest[last < 0] = np.nan
    return latest


def interpolated(stamp: np.ndarray, at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(S, n) set-points (C, n) at strictly increasing stamps (C,) [ns], interpolated to the samples at (S,) [ns]; NaN
    outside, and in gaps of theirs."""
    t, times = (stamp - at[0]) / NANO, (at - at[0]) / NANO
    set_points = np.column_stack([np.interp(t, times, column, np.nan, np.nan) for column in values.T])
    after = np.clip(np.searchsorted(times, t), 1, len(times) - 1)
    around = np.where(t == times[after], 0.0, times[after] - times[after - 1])
    set_points[around > _APART * float(np.median(np.diff(times)))] = np.nan
    return set_points
