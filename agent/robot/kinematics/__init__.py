"""Forward and inverse kinematics of a serial arm, over many samples at once; the numerical inverse is compiled.

Poses are those of the tool centre point (TCP) in the base frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.robot.description import RobotDescription
from agent.robot.kinematics.base import Kinematics
from agent.robot.kinematics.chain import chain_of
from agent.robot.kinematics.numerical import NumericalKinematics
from agent.robot.kinematics.parallel_axes import ParallelAxesKinematics
from agent.robot.kinematics.spherical_wrist import SphericalWristKinematics

if TYPE_CHECKING:
    from agent.robot.dynamics import Tool


def kinematics_for(robot: RobotDescription, tool: Tool | None = None) -> Kinematics:
    """The arm's kinematics: closed form for a spherical wrist or for three parallel axes, else numerical.

    Raises:
        InputError: the description's joints are not the chain from the URDF's root to the tip frame.
    """
    chain = chain_of(robot, None if tool is None else tool.frame)
    if chain.dof == 6 and not chain.prismatic.any():
        for kind in (SphericalWristKinematics, ParallelAxesKinematics):
            if (geometry := kind.recognise(chain)) is not None:
                return kind(robot, chain, geometry)
    return NumericalKinematics(robot, chain)
