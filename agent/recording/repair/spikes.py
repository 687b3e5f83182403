"""Torques that stand out alone: one or two samples far from both of their neighbours, as a lost bit makes them.

Friction and contact step, they do not come and go within a sample. Spread by a filter, a spike looks like any other
error; before it, the median of five samples tells.
"""

from __future__ import annotations

import numpy as np

from agent.recording.scratch import Scratch

_TIMES = 12.0  # the usual step from sample to sample
_SHARE = 1.5  # of the range that 98 % of the samples keep: no friction comes back that far
_EVERY = 8  # samples, of those that tell what is usual
#: In more than this part of the samples it is what the channel is like.
_MAX_SHARE = 0.01


def find_spikes(effort: np.ndarray, scratch: Scratch) -> np.ndarray:
    """(K,) indices of such samples in effort (S, n)."""
    found: list[int] = []
    for part in scratch.parts(len(effort)):
        first = max(part.start - 2, 0)
        values = effort[first : part.stop + 2]
        step = np.abs(np.diff(values, axis=0))
        low, high = np.quantile(values[::_EVERY], [0.01, 0.99], axis=0)
        limit = np.maximum(_TIMES * np.median(step[::_EVERY], axis=0), _SHARE * (high - low))
        steps = np.flatnonzero(np.any(step > limit, axis=1))
        for place in np.unique(np.concatenate([steps, steps + 1])):
            window = values[max(place - 2, 0) : place + 3]
            inside = part.start <= first + place < part.stop
            if inside and len(window) == 5 and np.any(np.abs(values[place] - np.median(window, axis=0)) > limit):
                found.append(first + int(place))
    return np.array(found if len(found) <= _MAX_SHARE * len(effort) else [], dtype=int)
