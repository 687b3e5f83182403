"""A motion on an even grid, for the choice of motions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.diagnosis import LIMITS, Dataset, background_of
from agent.model import MotionSignals, NominalModel


@dataclass(frozen=True, eq=False)
class GridMotion:
    """A motion on an even grid: time (S,) [s], q, qd, qdd (S, n)."""

    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def background_on(dataset: Dataset, reference: NominalModel, motion: MotionSignals) -> np.ndarray:
    """The verdict's noise level (S, n) [N·m] on a motion that is not in the logs.

    The speed threshold of a stationary joint depends on all motions that are diagnosed together. On the motion's coarse
    grid, a joint that reverses is stationary between two samples, and its friction does not follow its direction there.
    """
    fit = dataset.fit
    moving = fit.sigma.min(axis=0)
    sigma = background_of(reference, moving, [motion], fit.signals)
    turns = np.zeros(sigma.shape, dtype=bool)
    turns[1:] = motion.qd[1:] * motion.qd[:-1] < 0
    turns[:-1] |= turns[1:]
    near = turns.copy()
    for shift in range(1, int(LIMITS.near_rest / float(np.median(np.diff(motion.time)))) + 1):
        near[shift:] |= turns[:-shift]
        near[:-shift] |= turns[shift:]
    return np.where(near, np.maximum(fit.sigma.max(axis=0), 2 * moving), sigma)
