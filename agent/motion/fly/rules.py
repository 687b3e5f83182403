"""What the system variables allow at a place of the path, one row of numbers a knot."""

from __future__ import annotations

import numpy as np

from agent.motion.fly.move_geometry import JointSegment, Segment
from agent.motion.fly.parameters import FlyParameters
from agent.motion.pdl2.settings import SpeedOption

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
        if by_rotation or option is SpeedOption.SPD_CONST or segment.length < 1e-6:
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


def corner_rules(before: Segment, leaving: np.ndarray, arriving: np.ndarray, parameters: FlyParameters) -> np.ndarray:
    """(7,) rules in the blend after a move: the stricter of those (7,) of both moves, and what `$STRESS_PER` leaves."""
    rules = np.minimum(leaving, arriving)
    floor = parameters.stress_floor
    rules[STRESS] = floor + (1.0 - floor) * before.settings.stress_percent / 100.0
    return rules
