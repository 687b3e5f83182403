"""When a move has ended: `$TERM_TYPE` and its tolerance, against what the servos have reached.

The interpolator's set-points come to rest exactly; how long the arm takes to follow depends on its servos. Whoever has
the measured position asks here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from agent.motion.program import MotionSettings, Termination

#: [rad] tolerances of JNT_FINE and JNT_COARSE; the controller's own are not public.
_JOINT_TOLERANCES = {Termination.JNT_FINE: 5e-4, Termination.JNT_COARSE: 2e-3}


@dataclass(frozen=True)
class SettlingCondition:
    """How near the arm has to be to its resting set-point: `tolerance` [m] of the TCP, or [rad] of every joint."""

    tolerance: float
    joints: bool

    def met(
        self, reference: np.ndarray, measured: np.ndarray, forward: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """(S,) whether measured positions (S, n) are near enough to the set-point (n,).

        `forward` gives TCP poses (S, 4, 4) from joints (S, n).
        """
        if self.joints:
            return np.abs(measured - reference).max(axis=1) <= self.tolerance
        away = forward(measured)[:, :3, 3] - forward(reference[None])[:, :3, 3]
        return np.linalg.norm(away, axis=1) <= self.tolerance

    def settled_at(
        self,
        reference: np.ndarray,
        measured: np.ndarray,
        forward: Callable[[np.ndarray], np.ndarray],
        hold: int = 1,
    ) -> int | None:
        """The sample at which the condition has held for `hold` samples in a row, None if it never has."""
        near = self.met(reference, measured, forward)
        count = np.cumsum(near)
        since_miss = count - np.maximum.accumulate(np.where(near, 0, count))
        held = np.flatnonzero(since_miss >= hold)
        return int(held[0]) if len(held) else None


def settling_condition(settings: MotionSettings) -> SettlingCondition | None:
    """What ends a move that does not fly; None for NOSETTLE, which ends with the set-points."""
    termination = settings.termination
    if termination is Termination.NOSETTLE:
        return None
    if termination in _JOINT_TOLERANCES:
        return SettlingCondition(_JOINT_TOLERANCES[termination], joints=True)
    fine = termination is Termination.FINE
    return SettlingCondition(settings.tolerance_fine if fine else settings.tolerance_coarse, joints=False)
