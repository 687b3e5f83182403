"""Whether samples show what the arm does now: how old the newest judged one is, and whether they are frozen."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from drivers.protocol import SampleBlock

#: No sample is older when it is judged than the watchdog of its link, but for what a busy computer keeps a process
#: waiting [s], and the samples that a link hands out at once.
WAITS, BATCH = 0.2, 10
#: The first samples of a motion may come later than the others by this [s]: the controller was still planning.
HELD_UP = 0.3
#: No more than this [s] of the time in which this process stood still is excused.
EXCUSED = 0.5
#: Two clocks that are both right differ by no more than this part of the time that passes.
DRIFT = 2e-4
#: Of 24 healthy motions of two laws, none is stopped with `FROZEN` of 0.2 to 0.8 s and `CREEPS` of 0.025 to 0.2.
#: Duration [s] over which positions are compared with plan and speeds: a stop follows a freeze within 0.7 s, of which
#: the link takes up to 0.2 s (`WAITS`).
FROZEN = 0.4
#: Positions that advance by less than this part of the slowest planned motion around there are frozen. An arm that
#: halts at a corner which the plan flies through at 1.2 m/s, at 1.7 m/s², still goes 14 % of the planned way.
CREEPS = 0.05
#: Positions contradict speeds where they go less than this part of the way that the speeds make, beyond what speeds of
#: `NOISE` of a joint's limit make. A filter of speeds that is 20 ms late errs by 0.05 of the way over `FROZEN`.
BELIEVED, NOISE = 0.5, 0.02


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
        self.oldest = watchdog + max(WAITS, BATCH * period)
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
            self._offset, self._least = now - newest, now - newest - HELD_UP
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
            late = self._begun and not silent <= self.oldest + HELD_UP
            return f"no sample came within {silent:.1f} s of the start" if late else None
        age = self.age - excused
        if age <= self.oldest:
            return None
        what = "no sample came for" if not silent < WAITS else "samples were late by"
        return (
            f"{what} {age:.2f} s, {self.oldest:.2g} s are allowed. The link is slower than the controller samples, "
            "or this computer has too much else to do"
        )


class StuckPositions:
    """The last samples of a motion: how far positions went, and whether they contradict the speeds.

    Args:
        limits: (n,) speed limits of the joints [rad/s].
        gap: samples this far apart [s] say nothing about the time between them.
    """

    def __init__(self, limits: np.ndarray, gap: float) -> None:
        self._limits = limits
        self._gap = gap
        self._blocks: list[SampleBlock] = []

    def take(self, blocks: Iterable[SampleBlock]) -> None:
        """The next samples."""
        self._blocks.extend(blocks)
        while len(self._blocks) > 1 and self._blocks[1].time[0] <= self._blocks[-1].time[-1] - FROZEN:
            self._blocks.pop(0)

    def crept(self) -> float | None:
        """How far the joint that went farthest got in the last `FROZEN` seconds, over its speed limit [s].

        By set-points or, without them, measured positions; None where less is known.
        """
        _time, since = self._span()
        leading = self._column("reference_position")
        if leading is None:
            leading = np.concatenate([block.position for block in self._blocks])
        if since is None:
            return None
        return float(np.max(np.ptp(leading[since:], axis=0) / self._limits))

    def contradiction(self) -> int | None:
        """The joint that moves by the reported speeds and stands by the positions, if any."""
        time, since = self._span()
        if since is None:
            return None
        steps = np.diff(time[since:])[:, None]
        for positions, speeds in (("position", "velocity"), ("reference_position", "reference_velocity")):
            position, speed = self._column(positions), self._column(speeds)
            if position is not None and speed is not None:
                went = np.ptp(position[since:], axis=0) / self._limits
                said = np.abs(np.sum(speed[since + 1 :] * steps, axis=0)) / self._limits
                short = BELIEVED * (said - NOISE * FROZEN) - went
                if not np.max(short) <= 0.0:
                    return int(np.argmax(short))
        return None

    def _span(self) -> tuple[np.ndarray, int | None]:
        """Times (K,) [s], and where the last `FROZEN` seconds begin; None if they are not there as a whole."""
        time = np.concatenate([block.time for block in self._blocks])
        since = int(np.searchsorted(time, time[-1] - FROZEN, side="right")) - 1
        whole = since >= 0 and bool(np.max(np.diff(time[since:]), initial=0.0) <= self._gap)
        return time, since if whole else None

    def _column(self, name: str) -> np.ndarray | None:
        columns = [values for block in self._blocks if (values := getattr(block, name)) is not None]
        return np.concatenate(columns) if len(columns) == len(self._blocks) else None
