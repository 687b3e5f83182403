"""Which kinematics an arm gets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.robot.description import RobotDescription
from agent.robot.kinematics import parallel_axes, spherical_wrist
from agent.robot.kinematics.base import Kinematics
from agent.robot.kinematics.chain import chain_of
from agent.robot.kinematics.numerical import NumericalKinematics

if TYPE_CHECKING:
    from agent.robot.dynamics import Tool


def kinematics_for(robot: RobotDescription, tool: Tool | None = None) -> Kinematics:
    """The arm's kinematics: closed form for a spherical wrist or for three parallel axes, else numerical.

    Raises:
        InputError: the description's joints are not the chain from the URDF's root to the tip frame.
    """
    chain = chain_of(robot, None if tool is None else tool.frame)
    if (wrist := spherical_wrist.recognise(chain)) is not None:
        return spherical_wrist.SphericalWristKinematics(robot, chain, wrist)
    if (parallel := parallel_axes.recognise(chain)) is not None:
        return parallel_axes.ParallelAxesKinematics(robot, chain, parallel)
    return NumericalKinematics(robot, chain)
