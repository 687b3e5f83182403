"""Which kinematics an arm gets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agent.robot.description import RobotDescription
from agent.robot.kinematics.base import Kinematics
from agent.robot.kinematics.chain import chain_of
from agent.robot.kinematics.numerical import NumericalKinematics
from agent.robot.kinematics.spherical_wrist import SphericalWristKinematics
from agent.robot.kinematics.spherical_wrist_geometry import recognise

if TYPE_CHECKING:
    from agent.robot.dynamics import Tool


def kinematics_for(robot: RobotDescription, tool: Tool | None = None) -> Kinematics:
    """The arm's kinematics: closed form where the URDF shows a spherical wrist on the usual arm, numerical otherwise.

    Raises:
        InputError: the description's joints are not the chain from the URDF's root to the tip frame.
    """
    chain = chain_of(robot, None if tool is None else tool.frame)
    geometry = recognise(chain)
    if geometry is None:
        return NumericalKinematics(robot, chain)
    return SphericalWristKinematics(robot, chain, geometry)
