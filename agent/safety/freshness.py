"""Whether samples show what the arm does now: how old the newest judged one is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: No sample is older when it is judged than the watchdog of its link, but for what a busy computer keeps a process
#: waiting [s], and the samples that a link hands out at once.
PROCESS_STALL, SAMPLES_AT_ONCE = 0.2, 10
#: The first samples of a motion may come later than the others by this [s]: the controller was still planning.
FIRST_SAMPLE_DELAY = 0.3
#: No more than this [s] of the time in which this process stood still is excused.
EXCUSED = 0.5
#: Two clocks that are both right differ by no more than this part of the time that passes.
DRIFT = 2e-4


class Freshness:
    """Compares the controller's time of the newest judged sample with what it must be now.

    The offset between the two clocks is the smallest that was seen, but for the drift of clocks. So a delay that is
    always the same counts for nothing, one that grows counts in full, and a controller whose time runs faster than
    ours is never late.

    Args:
        period: of samples [s].
        watchdog: of the link [s].
        clock: our time [s].
    """

    def __init__(self, period: float, watchdog: float, clock: Callable[[], float]) -> None:
        self.oldest = watchdog + max(PROCESS_STALL, SAMPLES_AT_ONCE * period)
        self._clock = clock
        self._since = clock()
        self._begun = True
        self._newest: float | None = None  # controller time of the newest judged sample
        self._offset = self._least = 0.0  # of our clock to the controller's, and what it is at least

    def hold(self) -> None:
        """The motion is being started: who knows when its first sample comes."""
        self._begun = False

    def begin(self) -> None:
        """The motion has started: from now on samples have to come."""
        self._begun = True
        self._since = self._clock() if self._newest is None else self._since

    def judged(self, newest: float) -> None:
        """A block was judged; `newest` is the controller time [s] of its last sample."""
        now = self._clock()
        if self._newest is None:
            self._offset, self._least = now - newest, now - newest - FIRST_SAMPLE_DELAY
        else:
            drift = DRIFT * (now - self._since)
            self._least += drift
            self._offset = max(min(self._offset + drift, now - newest), self._least)
        self._since, self._newest = now, newest

    @property
    def silent(self) -> float:
        """Time [s] since a sample was last judged."""
        return self._clock() - self._since

    @property
    def age(self) -> float:
        """How old [s] the newest judged sample is; infinite where there is none."""
        if self._newest is None:
            return np.inf
        return float(np.maximum(self.silent, self._clock() - self._offset - self._newest))

    def fault(self, excused: float = 0.0) -> str | None:
        """Why the arm has to stop now, if it has to; `excused` seconds passed while nobody could look at anything."""
        silent = self.silent - excused
        if self._newest is None:
            late = self._begun and not silent <= self.oldest + FIRST_SAMPLE_DELAY
            return f"no sample came within {silent:.1f} s of the start" if late else None
        age = self.age - excused
        if age <= self.oldest:
            return None
        what = "no sample came for" if not silent < PROCESS_STALL else "samples were late by"
        return (
            f"{what} {age:.2f} s, {self.oldest:.2g} s are allowed. The link is slower than the controller samples, "
            "or this computer has too much else to do"
        )
