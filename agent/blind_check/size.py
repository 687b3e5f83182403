"""How much an effect really does to the torque: against the same programs on the same machine without it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.link import moving_segments
from agent.recording import read_log
from agent.robot import RobotDescription

REST = 3  # samples of equal set-points that make a stop

#: Below this share of nominal torque on every joint an effect is too small to matter, whatever was meant.
MATTERS = 0.005

_MEAN = 25  # samples, against noise


def kind_by_size(kind: str, change: float) -> str:
    """What a run counts as: one effect, of the catalogue or not, that changes less than matters is a small one.

    A torque that is cut off at a level which this motion never reaches is nothing that could be called unknown.
    """
    return "small" if kind in ("one", "outside") and change < MATTERS else kind


def torque_change(robot: RobotDescription, logs: Sequence[Path], others: Sequence[Path]) -> float:
    """Root mean square change over nominal torque (over N·m without one), on the joint and in the motion of the most.

    Both are laid on each other from stop to stop; noise of the sensors leaves a few tenths of a percent at most.
    """
    unit = np.nan_to_num(robot.nominal_torque, nan=1.0)
    largest = 0.0
    for log, other in ((read_log(a, robot), read_log(b, robot)) for a, b in zip(logs, others, strict=True)):
        assert log.reference_position is not None
        assert other.reference_position is not None
        assert log.effort is not None
        assert other.effort is not None
        squares, count = np.zeros(robot.dof), 0
        here, there = (
            moving_segments(positions, REST) for positions in (log.reference_position, other.reference_position)
        )
        for (a, b), (c, d) in zip(here, there, strict=False):
            length = min(b - a, d - c)
            if length < 2 * _MEAN:
                continue
            change = np.cumsum((log.effort[a : a + length] - other.effort[c : c + length]) / unit, axis=0)
            smooth = (change[_MEAN:] - change[:-_MEAN]) / _MEAN
            squares += np.sum(smooth**2, axis=0)
            count += len(smooth)
        if count:
            largest = max(largest, float(np.sqrt(np.max(squares / count))))
    return largest
