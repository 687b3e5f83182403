"""Numbers that no arm can have: bits of a torn row, a counter that was taken for an angle.

They are dropped where a log is read, so that nothing behind the reader has to expect them.
"""

from __future__ import annotations

import numpy as np

from agent.recording.scratch import Scratch

#: What no joint reaches in any unit that people mistake for SI: 1600 turns [rad], N·mm of the largest arms.
LIMITS = {"position": 1e4, "velocity": 1e6, "effort": 1e9}
_TIMES = 1e3  # of what 99 % of the samples keep: no impact, no spike of a current sensor
_MAX_SHARE = 0.01  # of the samples: beyond, it is what the channel is like
_EVERY = 8  # samples, of those that tell what is usual


def impossible(values: np.ndarray, field: str, scratch: Scratch) -> np.ndarray:
    """(S,) which samples of `position`, `velocity` or `effort` (S, n) hold such a number; not a number is none.

    A velocity or effort a thousand times what 99 % of the samples keep is one too.
    """
    some = np.abs(values[::_EVERY])
    largest = np.quantile(np.where(np.isfinite(some), some, 0.0), 0.99, axis=0) if len(values) else 0.0
    usual = np.where((field != "position") & (largest > 0), _TIMES * np.minimum(largest, LIMITS[field]), np.inf)
    absurd, alone = np.zeros(len(values), bool), np.zeros(len(values), bool)
    for part in scratch.parts(len(values)):
        size = np.abs(values[part])
        absurd[part] = np.any(size > LIMITS[field], axis=1)
        alone[part] = np.any(size > usual, axis=1)
    return absurd | alone if np.count_nonzero(alone) <= _MAX_SHARE * len(values) else absurd
