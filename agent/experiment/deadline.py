"""Time that planning may take, told with what is being done."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace


class OutOfTime(Exception):
    """The time for planning is used up: what was found until then is taken."""


@dataclass(frozen=True)
class Deadline:
    """`seconds` from `begun` on, of `whole` seconds; called with what is being done, it says so with the time left.

    Parameters
    ----------
    progress
        Where it is said.
    seconds
        Of the clock; without a limit if absent.
    clock
        Seconds from any beginning.
    """

    progress: Callable[[str], None] = lambda text: None
    seconds: float = float("inf")
    clock: Callable[[], float] = time.monotonic
    begun: float | None = field(default=None)
    whole: float | None = field(default=None)

    def __post_init__(self) -> None:
        if self.begun is None:
            object.__setattr__(self, "begun", self.clock())

    @property
    def left(self) -> float:
        """[s], negative once it is over."""
        assert self.begun is not None
        return self.begun + self.seconds - self.clock()

    def share(self, part: float) -> Deadline:
        """A deadline that ends when this `part` of the time is used up."""
        return replace(self, seconds=part * self.seconds, whole=self.whole or self.seconds)

    def rest(self) -> Deadline:
        """A deadline that begins now and ends with this one."""
        return Deadline(self.progress, self.left, self.clock)

    def __call__(self, text: str) -> None:
        """Say what is being done.

        Raises
        ------
        OutOfTime
            No time is left.
        """
        if self.left <= 0:
            raise OutOfTime
        left = replace(self, seconds=self.whole or self.seconds).left
        self.progress(text if left == float("inf") else f"{text}, at most {left:.0f} s of planning left")
