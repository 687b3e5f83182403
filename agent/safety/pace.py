"""Whether the arm moves as fast as was planned, on a link that does not tell the override.

The time that the plan has for the way the set-points have gone is compared with the time they took, from stop to stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from agent.motion.trajectory import Trajectory

#: The controller's interpolator is not ours: so much may it be ahead or behind, of the time and in seconds.
SHARE, ALLOWANCE = 0.2, 0.5
#: Set-points that rest so long [s] have ended a stretch.
REST = 0.006
#: A stretch is the planned one if it begins where that begins, and a plan shorter than this is none [rad, or m].
NEAR, SHORTEST = 0.05, 1e-3


class PaceCheck:
    """Follows the set-points of a motion along its plan.

    Args:
        chains: what was planned from stop to stop, in order.
    """

    def __init__(self, chains: Sequence[Trajectory]) -> None:
        self._plans = [_Plan(chain) for chain in chains]
        if self._plans and self._plans[0].way[-1] < SHORTEST:
            del self._plans[0]  # the arm stood there already
        self._last: tuple[float, np.ndarray] | None = None
        self._began: float | None = None
        self._way = self._rested = 0.0
        self._plan: _Plan | None = None

    def take(self, time: np.ndarray, reference: np.ndarray) -> str | None:
        """Next set-points (K, n) [rad] at their times (K,) [s]; returns why the arm has to stop, if it has to."""
        if self._last is not None:
            time = np.concatenate([[self._last[0]], time])
            reference = np.concatenate([self._last[1][None, :], reference])
        self._last = float(time[-1]), reference[-1]
        steps = np.linalg.norm(np.diff(reference, axis=0), axis=1)
        for k, (step, passed) in enumerate(zip(steps, np.diff(time), strict=True)):
            if step == 0.0:
                self._rested += passed
                if self._rested >= REST:
                    self._began = None
                continue
            self._rested = 0.0
            if self._began is None:
                self._begin(float(time[k]), reference[k])
            self._way += step
        if self._began is None or self._plan is None:
            return None
        return self._plan.compare(self._way, self._last[0] - self._began)

    def _begin(self, time: float, position: np.ndarray) -> None:
        self._began, self._way = time, 0.0
        self._plan = self._plans.pop(0) if self._plans else None
        if self._plan is not None and np.abs(position - self._plan.start).max() > NEAR:
            self._plan = None


class _Plan:
    """way (S,): joint-space length [rad, m] that a chain has gone at its times (S,)."""

    def __init__(self, chain: Trajectory) -> None:
        self.start = chain.q[0]
        self.time = chain.t - chain.t[0]
        self.way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain.q, axis=0), axis=1))])

    def compare(self, way: float, took: float) -> str | None:
        """What is wrong where `way` took so long [s]."""
        planned = float(np.interp(way, self.way, self.time))
        if abs(took - planned) <= ALLOWANCE + SHARE * planned:
            return None
        return (
            f"what was planned to take {planned:.1f} s took {took:.1f} s: the override is not at 100 %, or was "
            "changed; set it to 100 %, then run the command again"
        )
