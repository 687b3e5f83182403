"""Whether an arm that was told to stop does so, by what is measured of it."""

from __future__ import annotations

import numpy as np

#: Duration over which a speed is measured [s].
SPAN = 0.1
#: No joint of an arm that stands is faster than this part of its limit.
STILL = 0.01
#: An arm that brakes has less than this part of its speed left when that is asked, and has not regained that part of
#: it: one that disobeys slows down too, where its path has a corner.
BRAKING, REGAINED = 0.8, 0.25
#: Duration of standing [s] from which an arm is at rest without the controller's word.
RESTING = 0.3


class Braking:
    """Follows the speed of an arm; positions come from its samples or, where none come, from its state.

    Args:
        max_velocity: (n,) of its joints [rad/s].
        regained: as `REGAINED`; positions that are renewed now and then only need more.
    """

    def __init__(self, max_velocity: np.ndarray, regained: float = REGAINED) -> None:
        self._limit = max_velocity
        self._regained = regained
        self._times = np.empty(0)
        self._positions = np.empty((0, len(max_velocity)))
        self._still_since: float | None = None
        #: The fastest joint's, as a part of its limit; None where nobody knows.
        self.speed: float | None = None
        #: The same when the stop was asked for, and the least since then.
        self.before: float | None = None
        self._least = np.inf

    def take(self, times: np.ndarray, positions: np.ndarray) -> None:
        """Measured positions (K, n) at times (K,) [s] of one clock."""
        if len(self._times) and not 0.0 <= times[0] - self._times[-1] <= 10 * SPAN:
            self.forget()
        self._times = np.concatenate([self._times, times])
        self._positions = np.concatenate([self._positions, positions])
        first = max(0, int(np.searchsorted(self._times, self._times[-1] - SPAN, side="right")) - 1)
        self._times, self._positions = self._times[first:], self._positions[first:]
        passed = float(self._times[-1] - self._times[0])
        if passed >= SPAN / 2:
            way = np.ptp(self._positions, axis=0)
            self.speed = float(np.max(way / self._limit)) / passed
            if self.before is not None:
                self._least = min(self._least, self.speed)
            if not self.speed <= STILL:
                self._still_since = None
            elif self._still_since is None:
                self._still_since = float(self._times[0])

    @property
    def shape(self) -> tuple[int, ...]:
        """(n,)."""
        return self._limit.shape

    def forget(self) -> None:
        """Positions of another source, or another clock, follow."""
        self._times, self._positions = self._times[:0], self._positions[:0]
        self._still_since = self.speed = None

    @property
    def stands(self) -> bool:
        """Whether the arm stood when it was seen last."""
        return self._still_since is not None

    @property
    def rested(self) -> float:
        """For how long [s] it has."""
        return 0.0 if self._still_since is None else float(self._times[-1]) - self._still_since

    @property
    def brakes(self) -> bool:
        """Whether the arm is clearly slower than when the stop was asked for, and does not speed up again."""
        if self.speed is None or self.before is None:
            return False
        return self.speed < min(BRAKING * self.before, self._least + self._regained * self.before)
