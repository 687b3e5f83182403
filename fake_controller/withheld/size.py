"""How much an effect really does to the torque: against the same programs on the same machine without it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.link import moving_segments
from agent.recording import Log
from agent.robot import RobotDescription

REST = 3  # samples of equal set-points that make a stop

_MEAN = 25  # samples, against noise


def torque_change(robot: RobotDescription, logs: Sequence[Log], others: Sequence[Log]) -> float:
    """Root mean square change over nominal torque (over N·m without one), on the joint and in the motion of the most.

    Both are laid on each other from stop to stop; noise of the sensors leaves a few tenths of a percent at most.
    """
    unit = np.nan_to_num(robot.nominal_torque, nan=1.0)
    largest = 0.0
    for log, other in zip(logs, others, strict=True):
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
