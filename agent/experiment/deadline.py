"""Time that planning may take, told with what is being done."""

from __future__ import annotations

import time
from collections.abc import Callable
from copy import copy


class OutOfTime(Exception):
    """The time for planning is used up: what was found until then is taken."""


class Deadline:
    """`seconds` from now on; called with what is being done, it says so with the time left.

    Parameters
    ----------
    progress
        Where it is said.
    seconds
        Of the clock; without a limit if absent.
    clock
        Seconds from any beginning.
    """

    def __init__(
        self,
        progress: Callable[[str], None] = lambda text: None,
        seconds: float = float("inf"),
        clock: Callable[[], float] = time.monotonic,
    ):
        self._progress, self._clock = progress, clock
        self._begun, self._seconds, self._whole = clock(), seconds, seconds

    @property
    def remaining(self) -> float:
        """[s], negative once it is over."""
        return self._begun + self._seconds - self._clock()

    def share(self, part: float) -> Deadline:
        """A deadline that ends when this `part` of the time is used up; what it says is the whole time left."""
        other = copy(self)
        other._seconds = part * self._seconds
        return other

    def from_now(self) -> Deadline:
        """A deadline that begins now and ends with this one."""
        return Deadline(self._progress, self.remaining, self._clock)

    def __call__(self, text: str) -> None:
        """Say what is being done.

        Raises
        ------
        OutOfTime
            No time is left.
        """
        if self.remaining <= 0:
            raise OutOfTime
        remaining = self._begun + self._whole - self._clock()
        self._progress(text if remaining == float("inf") else f"{text}, at most {remaining:.0f} s of planning left")
