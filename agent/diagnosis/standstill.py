"""Where joints stand still: stiction holds them there, and the torque is anything below the Coulomb level."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.model.signals import MotionSignals

#: Of the highest speed: a joint that is no faster stands.
STANDING = 0.004


def at_rest(signals: Sequence[MotionSignals], limits: DecisionLimits = LIMITS) -> np.ndarray:
    """(S', n) bool, all motions in a row: whether a joint stands there for a while, or close by."""
    from scipy.ndimage import binary_dilation, binary_opening

    fastest = np.max([np.abs(motion.qd).max(axis=0) for motion in signals], axis=0)
    parts = []
    for motion in signals:
        rate = 1 / float(np.median(np.diff(motion.time)))
        standing = np.abs(motion.qd) <= STANDING * fastest
        long = binary_opening(standing, np.ones((max(int(limits.long_rest * rate), 1), 1)))
        parts.append(binary_dilation(long, np.ones((2 * int(limits.near_rest * rate) + 1, 1)))[motion.kept])
    return np.concatenate(parts)
