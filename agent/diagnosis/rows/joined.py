"""Rows of several motions, one after the other, without the samples at the ends that the filter spoils."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.model import MotionSignals


def joined(signals: Sequence[MotionSignals], name: str) -> np.ndarray:
    """(S', n) or (S',) of an attribute of the motions."""
    return np.concatenate([getattr(motion, name)[motion.kept] for motion in signals])


def log_of_rows(signals: Sequence[MotionSignals]) -> np.ndarray:
    """(S',) number of each row's log."""
    return np.concatenate([np.full(len(motion.time[motion.kept]), motion.log_index) for motion in signals])
