"""Controller time in nanoseconds since it was switched on: wall time, or as fast as the machine can go."""

from __future__ import annotations

import threading
import time


class RealClock:
    """Controller time is wall time. `slice_samples`: samples worth computing before the clock is looked at again."""

    slice_samples = 10

    def __init__(self) -> None:
        self._start = time.monotonic_ns()

    def now(self) -> int:
        """Controller time [ns]."""
        return time.monotonic_ns() - self._start

    def wait_until(self, moment: int) -> None:
        """Return once controller time has reached `moment` [ns]."""
        remaining = moment - self.now()
        if remaining > 0:
            time.sleep(remaining * 1e-9)


class FastClock:
    """Controller time is what the controller has simulated: waiting takes no wall time."""

    slice_samples = 100

    def __init__(self) -> None:
        self._now = 0
        self._lock = threading.Lock()

    def now(self) -> int:
        return self._now

    def wait_until(self, moment: int) -> None:
        with self._lock:
            self._now = max(self._now, moment)


Clock = RealClock | FastClock
CLOCKS: dict[str, type[RealClock] | type[FastClock]] = {"fast": FastClock, "real": RealClock}
