"""Whether reported positions stand still where the plan moves, or contradict the reported speeds."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from drivers.protocol import SampleBlock

#: Of 24 healthy motions of two laws, none is stopped with `FREEZE_WINDOW` of 0.2 to 0.8 s and `FROZEN_SHARE` of 0.025
#: to 0.2.
#: Duration [s] over which positions are compared with plan and speeds: a stop follows a freeze within 0.7 s, of which
#: the link takes up to 0.2 s (`PROCESS_STALL`).
FREEZE_WINDOW = 0.4
#: Positions that advance by less than this part of the slowest planned motion around there are frozen. An arm that
#: halts at a corner which the plan flies through at 1.2 m/s, at 1.7 m/s², still goes 14 % of the planned way.
FROZEN_SHARE = 0.05
#: Positions contradict speeds where they go less than this part of the way that the speeds make, beyond what speeds of
#: `NOISE` of a joint's limit make. A filter of speeds that is 20 ms late errs by 0.05 of the way over `FREEZE_WINDOW`.
CONTRADICTION_SHARE, NOISE = 0.5, 0.02


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
        while len(self._blocks) > 1 and self._blocks[1].time[0] <= self._blocks[-1].time[-1] - FREEZE_WINDOW:
            self._blocks.pop(0)

    def advance(self) -> float | None:
        """How far the joint that went farthest got in the last `FREEZE_WINDOW` seconds, over its speed limit [s].

        By set-points or, without them, measured positions; None where less is known.
        """
        _time, since = self._span()
        leading = self._column("reference_position")
        if leading is None:
            leading = np.concatenate([block.position for block in self._blocks])
        if since is None:
            return None
        return float(np.max(np.ptp(leading[since:], axis=0) / self._limits))

    def contradicting_joint(self) -> int | None:
        """The joint that moves by the reported speeds and stands by the positions, if any."""
        time, since = self._span()
        if since is None:
            return None
        steps = np.diff(time[since:])[:, None]
        for positions, speeds in (("position", "velocity"), ("reference_position", "reference_velocity")):
            position, speed = self._column(positions), self._column(speeds)
            if position is not None and speed is not None:
                travelled = np.ptp(position[since:], axis=0) / self._limits
                reported = np.abs(np.sum(speed[since + 1 :] * steps, axis=0)) / self._limits
                short = CONTRADICTION_SHARE * (reported - NOISE * FREEZE_WINDOW) - travelled
                if not np.max(short) <= 0.0:
                    return int(np.argmax(short))
        return None

    def _span(self) -> tuple[np.ndarray, int | None]:
        """Times (K,) [s], and where the last `FREEZE_WINDOW` seconds begin; None if they are not there as a whole."""
        time = np.concatenate([block.time for block in self._blocks])
        since = int(np.searchsorted(time, time[-1] - FREEZE_WINDOW, side="right")) - 1
        whole = since >= 0 and bool(np.max(np.diff(time[since:]), initial=0.0) <= self._gap)
        return time, since if whole else None

    def _column(self, name: str) -> np.ndarray | None:
        columns = [values for block in self._blocks if (values := getattr(block, name)) is not None]
        return np.concatenate(columns) if len(columns) == len(self._blocks) else None
