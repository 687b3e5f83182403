"""Numbers that no arm can have: bits of a torn row, a counter that was taken for an angle, a torque of one sample.

They are dropped where a log is read, so that nothing behind the reader has to expect them. Friction and contact step,
they do not come and go within a sample. Spread by a filter, a spike looks like any other error; before it, the median
of five samples tells.
"""

from __future__ import annotations

import numpy as np

from agent.recording.scratch import Scratch

#: What no joint reaches in any unit that people mistake for SI: 1600 turns [rad], N·mm of the largest arms.
LIMITS = {"position": 1e4, "velocity": 1e6, "effort": 1e9}
_ALONE = 1e3  # times what 99 % of the samples keep: no impact, no spike of a current sensor
_SPIKE = 12.0  # times the usual step from sample to sample
_SPIKE_SHARE = 1.5  # of the range that 98 % of the samples keep: no friction comes back that far
_MOST = 0.01  # of the samples: beyond, it is what the channel is like
_EVERY = 8  # samples, of those that tell what is usual


def impossible(values: np.ndarray, field: str, scratch: Scratch) -> np.ndarray:
    """(S,) samples of `position`, `velocity` or `effort` (S, n) with a number that no arm can have; NaN does not count.

    A velocity or effort a thousand times what 99 % of the samples keep counts as well.
    """
    some = np.abs(values[::_EVERY])
    largest = np.quantile(np.where(np.isfinite(some), some, 0.0), 0.99, axis=0) if len(values) else 0.0
    usual = np.where((field != "position") & (largest > 0), _ALONE * np.minimum(largest, LIMITS[field]), np.inf)
    absurd, alone = np.zeros(len(values), bool), np.zeros(len(values), bool)
    for part in scratch.parts(len(values)):
        size = np.abs(values[part])
        absurd[part] = np.any(size > LIMITS[field], axis=1)
        alone[part] = np.any(size > usual, axis=1)
    return absurd | alone if np.count_nonzero(alone) <= _MOST * len(values) else absurd


def find_spikes(effort: np.ndarray, scratch: Scratch) -> np.ndarray:
    """(K,) indices of samples of effort (S, n) that stand out from both of their neighbours."""
    found: list[int] = []
    for part in scratch.parts(len(effort)):
        first = max(part.start - 2, 0)
        values = effort[first : part.stop + 2]
        step = np.abs(np.diff(values, axis=0))
        low, high = np.quantile(values[::_EVERY], [0.01, 0.99], axis=0)
        limit = np.maximum(_SPIKE * np.median(step[::_EVERY], axis=0), _SPIKE_SHARE * (high - low))
        steps = np.flatnonzero(np.any(step > limit, axis=1))
        for place in np.unique(np.concatenate([steps, steps + 1])):
            window = values[max(place - 2, 0) : place + 3]
            inside = part.start <= first + place < part.stop
            if inside and len(window) == 5 and np.any(np.abs(values[place] - np.median(window, axis=0)) > limit):
                found.append(first + int(place))
    return np.array(found if len(found) <= _MOST * len(effort) else [], dtype=int)
