"""What the system variables allow at a place of the path, one row of numbers a knot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.motion.fly.fly_parameters import FlyParameters
from agent.motion.fly.move_geometry import JointSegment, Segment
from agent.motion.path_settings import SpeedOption

#: Columns of a row: programmed TCP speed [m/s] and rotational speed [rad/s] (inf: not programmed), part of the joint
#: speed limits, whether the robot's Cartesian limits apply (1, or inf: not), part of the acceleration limits that
#: stress leaves, acceleration and deceleration overrides.
LINEAR, ROTATIONAL, JOINT, CARTESIAN, STRESS, ACCELERATION, DECELERATION = range(7)


def segment_rules(segment: Segment, parameters: FlyParameters) -> np.ndarray:
    """(7,) rules along one move."""
    settings = segment.settings
    override = settings.speed_override * settings.arm_override
    linear = rotational = np.inf
    joint, cartesian = 1.0, 1.0
    option = settings.speed_option
    if isinstance(segment, JointSegment):
        joint, cartesian = override, np.inf
    elif option is SpeedOption.SPD_JNT:
        joint = override
    else:
        by_rotation = option is SpeedOption.SPD_ROT and segment.angle > 1e-6
        if not by_rotation:
            linear = settings.linear_speed * override
        if by_rotation or option is SpeedOption.SPD_CONST or segment.curve.length < 1e-6:
            rotational = settings.rotational_speed * override
    return np.array(
        [
            linear,
            rotational,
            joint,
            cartesian,
            1.0,
            settings.acceleration_override * settings.arm_override**parameters.override_power,
            settings.deceleration_override * settings.arm_override**parameters.override_power,
        ]
    )


def path_rules(segments: Sequence[Segment], parameters: FlyParameters) -> np.ndarray:
    """(2 M - 1, 7) rules of M moves and of the blends between them, in their order.

    A blend has the stricter rules of both moves, and what `$STRESS_PER` of the move before leaves.
    """
    table = np.empty((2 * len(segments) - 1, 7))
    table[::2] = [segment_rules(segment, parameters) for segment in segments]
    table[1::2] = np.minimum(table[:-2:2], table[2::2])
    floor = parameters.stress_floor
    for k, segment in enumerate(segments[:-1]):
        table[2 * k + 1, STRESS] = floor + (1.0 - floor) * segment.settings.stress_percent / 100.0
    return table
