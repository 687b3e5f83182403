"""What has to be so before a trajectory is sent. Each refusal says what to do; nothing has moved then."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drivers.errors import RefusedError
from drivers.transports.ros2.link import RosLink
from drivers.wire.ros2 import MANAGER

_KINDS = ("joint_trajectory_controller/JointTrajectoryController", "ur_controllers/ScaledJointTrajectoryController")
#: Faster joints are not stationary [rad/s].
_STILL = 0.01
#: Age of samples beyond the least that a motion may begin with (99th percentile), as a share of the watchdog.
_OLDEST = 0.6
_UNKNOWN, _NAMED = "_NODE_NAME_UNKNOWN_", 5.0  # of a node whose name has not come yet, and how long it may take [s]


def check_controller(link: RosLink, parameters: Mapping[str, Any], manager: Mapping[str, Any], by_goal: bool) -> None:
    """The controller is of the expected kind, joins points by splines, and would stop the arm off its path.

    Raises:
        RefusedError: it is not, or does not.
    """
    node, kind = link.target.node, manager.get(f"{link.target.controller}.type")
    if kind is not None and kind not in _KINDS:
        raise RefusedError(f"{node} is a {kind}; activate a JointTrajectoryController, and name it in the address")
    method = parameters.get("interpolation_method", "splines")
    if method != "splines":
        raise RefusedError(
            f"{node} has interpolation_method {method!r}; set it to splines in the controller's YAML file"
        )
    interfaces = parameters.get("command_interfaces") or []
    if not {"position", "velocity", "effort"} & {*interfaces}:
        raise RefusedError(
            f"{node} commands {', '.join(interfaces) or 'nothing'}; position, velocity or effort is expected"
        )
    loose = [name for name in link.joints if not float(parameters.get(f"constraints.{name}.trajectory") or 0.0) > 0.0]
    if loose and not by_goal:
        raise RefusedError(
            f"{node} would not stop the arm off its path: constraints.{loose[0]}.trajectory is 0, and without "
            "control_msgs no goal can bring a tolerance of its own. Install control_msgs where the agent runs (apt: "
            "ros-$ROS_DISTRO-control-msgs, then source again), or set the constraints in the controller's YAML file"
        )


def check_active(link: RosLink) -> None:
    """Exactly this controller is active, and so is the hardware, as far as controller_manager can be asked.

    Raises:
        RefusedError: they are not.
    """
    target = link.target
    listed = link.call("controller_manager_msgs.srv", "ListControllers", target.name(MANAGER, "list_controllers"))
    for controller in [] if listed is None else listed.controller:
        claims = {*link.joints} & {
            interface.split("/")[-2] for interface in controller.claimed_interfaces if "/" in interface
        }
        if controller.name == target.controller and controller.state != "active":
            raise RefusedError(f"{target.node} is {controller.state}; activate it: ros2 control switch_controllers")
        if controller.name != target.controller and controller.state == "active" and claims:
            raise RefusedError(f"{controller.name} is active and commands the arm too; deactivate it")
    hardware = link.call(
        "controller_manager_msgs.srv", "ListHardwareComponents", target.name(MANAGER, "list_hardware_components")
    )
    for component in [] if hardware is None else hardware.component:
        if component.state.label not in ("active", ""):
            raise RefusedError(
                f"the hardware {component.name} is {component.state.label}; activate it, look at the robot first"
            )


def check_alone(link: RosLink) -> None:
    """Nobody else may command the arm.

    Raises:
        RefusedError: somebody may.
    """
    link.wait(lambda: _UNKNOWN not in "".join(link.others()), _NAMED)  # names come after what they publish
    others = [name for name in link.others() if name.rpartition("/")[2] not in link.target.beside]
    if others:
        raise RefusedError(
            f"{', '.join(others)} can command {link.target.node} too: end it. A client that stays idle, such as "
            f"MoveIt's, may be named in the address: ',beside={others[0].rpartition('/')[2]}'. An agent that was "
            "killed is seen for 20 s"
        )


def check_arm(link: RosLink, joints: Sequence[str], recorded: bool) -> None:
    """The arm stands, its samples are numbers and fresh, and nothing slows its trajectories down.

    Raises:
        RefusedError: something of that is not so.
    """
    if tuple(joints) != link.joints:
        raise RefusedError(f"the program is for {', '.join(joints)}, {link.target.node} has {', '.join(link.joints)}")
    if not link.heard():
        raise RefusedError(
            f"{link.target.node} does not listen to its topic joint_trajectory, by which the arm is braked; activate it"
        )
    sample = link.latest
    if not np.isfinite(sample.position).all():
        raise RefusedError("joint_states has positions that are no numbers; look at the robot's driver")
    if recorded and not np.isfinite(sample.effort).all():
        raise RefusedError(
            "joint_states has no effort, so nothing can be identified: say `effort: none` in the recipe's controller "
            "to record the motion alone"
        )
    speed = sample.velocity if np.isfinite(sample.velocity).all() else link.velocity
    if np.abs(speed).max() > _STILL:
        raise RefusedError("the arm moves already; wait until it rests")
    scaling = link.scaling
    if scaling is not None and not abs(scaling - 1.0) <= 1e-6:
        raise RefusedError(f"the controller's speed is scaled to {100 * scaling:.0f} %; set it to 100 % there")
    _, age = link.pace()
    if not age <= _OLDEST * link.watchdog:
        raise RefusedError(
            f"joint_states come up to {age:.2f} s late, {_OLDEST * link.watchdog:.2g} s are allowed; "
            "free this computer or the network"
        )
