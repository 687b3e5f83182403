"""Controller time: as it passes on the wall, or as fast as the machine can go."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """What tells the controller's time, in nanoseconds since it was switched on.

    `slice_samples` is how many samples are worth computing before the clock is looked at again.
    """

    slice_samples: int

    def now(self) -> int:
        """Controller time [ns]."""

    def wait_until(self, moment: int) -> None:
        """Return once controller time has reached `moment` [ns]."""


class RealClock:
    """Controller time is time on the wall."""

    slice_samples = 10

    def __init__(self) -> None:
        self._start = time.monotonic_ns()

    def now(self) -> int:
        return time.monotonic_ns() - self._start

    def wait_until(self, moment: int) -> None:
        left = moment - self.now()
        if left > 0:
            time.sleep(left * 1e-9)


class FastClock:
    """Controller time is what the controller has lived through: waiting takes none of ours."""

    slice_samples = 100

    def __init__(self) -> None:
        self._now = 0
        self._lock = threading.Lock()

    def now(self) -> int:
        return self._now

    def wait_until(self, moment: int) -> None:
        with self._lock:
            self._now = max(self._now, moment)


CLOCKS: dict[str, type[RealClock] | type[FastClock]] = {"fast": FastClock, "real": RealClock}
