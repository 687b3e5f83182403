"""What a robot reports as effort, recognised while the arm rests: its gravity torque, a part of it, or nothing of it.

Drivers of ROS report torque, motor current, or torque without gravity under one name, and some have changed that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.core import ControllerError

if TYPE_CHECKING:
    from agent.robot import RobotDescription, Tool
    from drivers.protocol import Driver

#: Effort along the model's gravity torque, as a share of it: below the first, gravity is not in it; from the second to
#: the third it is that torque. Static friction and wrong masses of a description each change it by up to a half.
ABSENT, LOW, HIGH = 0.2, 0.4, 2.5
#: Gravity torque [N·m] of the heaviest joint below which nothing can be told.
SMALLEST = 2.0


def check_effort(driver: Driver, robot: RobotDescription, tool: Tool | None, address: str) -> str:
    """Compare the effort of the stationary arm with what the recipe says; returns a remark for a person, or nothing.

    Args:
        driver: connected, with the arm stationary.
        robot: description of the arm.
        tool: at the flange; None: none.
        address: of the controller, for messages.

    Raises:
        ControllerError: it cannot be what the recipe says.
    """
    from agent.robot import Dynamics
    from drivers.protocol import ReportsEffort

    if not isinstance(driver, ReportsEffort) or driver.effort == "none":
        return ""
    q, torque = driver.resting()
    nothing = np.zeros((1, robot.dof))
    gravity = Dynamics(robot, tool).inverse_dynamics(q[None], nothing, nothing)[0]
    heaviest = float(np.abs(gravity).max())
    if not np.isfinite(torque).all():
        raise ControllerError(
            f"{address}: the recipe says that effort is {driver.effort}, and the robot reports none, so nothing can be "
            "identified; say effort: none to record the motion alone"
        )
    if heaviest < SMALLEST:
        return (
            f"{address}: what the robot reports as effort cannot be recognised in this pose, as gravity hardly loads a "
            "joint; move the arm to a stretched pose and run the command again to have it checked"
        )
    share = float(torque @ gravity / (gravity @ gravity))
    observation = f"while the arm is stationary it is {share:.2f} of the gravity torque of the description"
    if abs(share) < ABSENT:
        raise ControllerError(
            f"{address}: the recipe says that effort is {driver.effort}, and {observation}: gravity has been taken out "
            "of it, as UR drivers do from 2026 on (use_currents_as_efforts), or it is a motor current. Without gravity "
            "it identifies nothing: change that in the robot's driver, say effort: current, or effort: none to record "
            "the motion alone"
        )
    if not LOW <= share <= HIGH:
        raise ControllerError(
            f"{address}: the recipe says that effort is {driver.effort}, and {observation}: it is in another unit, or "
            "the recipe's tool or the description's masses are not those of this arm. Is it a "
            + (
                "torque? Then say effort: torque"
                if driver.effort == "current"
                else "motor current? Then say effort: current"
            )
        )
    return ""
