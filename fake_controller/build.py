"""Puts a controller together: a robot, the machine drawn from the seed, and one of the controller's interpolators."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.core import InputError
from agent.robot import RobotDescription, kinematics_for, load_robot
from fake_controller.clock import CLOCKS
from fake_controller.controller import PERIOD, Controller
from fake_controller.faults import Fault, Faults, check_wire
from fake_controller.interpolation import build_interpolator
from fake_controller.plant import Plant
from fake_controller.program.interpreter import left_over
from fake_controller.ros2.cell import IMPOSSIBLE as ON_ROS2, Ros2Cell
from fake_controller.ur.arm import MODELS
from fake_controller.ur.cell import IMPOSSIBLE, UrCell
from fake_controller.ur.state import Version

#: Version of the software of a UR controller.
POLYSCOPE = (5, 12, 6, 1102099)


def build_controller(
    robot_name: str,
    seed: int,
    clock: str,
    effects: Sequence[Mapping[str, Any]] = (),
    faults: Sequence[Fault] = (),
    model: Path | None = None,
    interpolator: str = "ours",
) -> Controller:
    """A controller with a stationary arm at the robot's calibration pose.

    Args:
        robot_name: built-in robot, or path of a robot.yaml.
        seed: of the machine, its noise, and the frames that an earlier program has left.
        clock: `fast` or `real`.
        effects: built into the machine, as `fake_controller.actuation.load_effect` takes them.
        faults: what goes wrong, and when.
        model: file of a model that the machine is to be like, with its robot, instead of one drawn from the seed.
        interpolator: one of `fake_controller.interpolation.KINDS`.

    Raises:
        InputError: no such robot or model, or an effect that does not fit it.
    """
    robot, plant = _machine(robot_name, seed, effects, PERIOD, model)
    own = build_interpolator(interpolator, robot, seed, PERIOD)
    number = f"{seed:04d}" if seed < 10_000 else _digest(seed)[:8]  # a long seed is secret
    forward = kinematics_for(robot).forward
    serial, system = f"FAKE-{number}", left_over(seed)
    return Controller(robot, plant, own, forward, CLOCKS[clock](), serial, Faults(faults), system)


def build_ur_cell(
    robot_name: str,
    seed: int,
    clock: str,
    effects: Sequence[Mapping[str, Any]] = (),
    faults: Sequence[Fault] = (),
    model: Path | None = None,
    version: Version = POLYSCOPE,
    shortest_watchdog: float = 0.05,
) -> UrCell:
    """A UR controller with a stationary arm and a running clock.

    Args:
        robot_name, seed, clock, effects, faults, model: as of `build_controller`.
        version: of the software; major 3 is a CB3, 5 an e-Series.
        shortest_watchdog: [s] that the watchdog of a program is granted at least.

    Raises:
        InputError: no UR robot, no such model, an effect that does not fit it, or a fault that makes no sense there.
    """
    robot, plant = _machine(robot_name, seed, effects, 0.002 if version[0] >= 5 else 0.008, model)
    if robot.name not in MODELS:
        raise InputError(f"{robot.name} is no robot of Universal Robots; emulated are {', '.join(MODELS)}")
    if plant.machine.path_changes:
        raise InputError("interpolator_mismatch is not simulated on UR controllers; remove it from the effects")
    try:
        check_wire(faults, "ur", IMPOSSIBLE)
    except ValueError as error:
        raise InputError(str(error)) from None
    serial = f"2019{int(_digest(seed)[:6], 16):08d}"
    return UrCell(robot, plant, CLOCKS[clock](), serial, seed, version, Faults(faults), shortest_watchdog)


def build_ros2_cell(
    robot_name: str,
    seed: int,
    effects: Sequence[Mapping[str, Any]] = (),
    faults: Sequence[Fault] = (),
    model: Path | None = None,
    rate: float = 500.0,
    effort: str = "torque",
    tolerance: float = 0.2,
    clock: Callable[[], float] = time.time,
) -> Ros2Cell:
    """An arm with a trajectory controller of ROS 2, in real time.

    Args:
        robot_name, seed, effects, faults, model: as of `build_controller`.
        rate: cycles a second.
        effort: what joint_states have as effort, one of `fake_controller.ros2.cell.EFFORTS`.
        tolerance: of the path, by the controller's parameters [rad]; 0 is none.
        clock: the Unix clock of its computer.

    Raises:
        InputError: no such robot or model, an effect that does not fit it, or a fault that makes no sense there.
    """
    robot, plant = _machine(robot_name, seed, effects, 1.0 / rate, model)
    if plant.machine.path_changes:
        raise InputError("interpolator_mismatch is not simulated on ROS 2; remove it from the effects")
    try:
        check_wire(faults, "ros2", ON_ROS2)
    except ValueError as error:
        raise InputError(str(error)) from None
    return Ros2Cell(robot, plant, 1.0 / rate, Faults(faults), effort, tolerance, clock)


def _machine(
    robot_name: str, seed: int, effects: Sequence[Mapping[str, Any]], period: float, model: Path | None
) -> tuple[RobotDescription, Plant]:
    identified = None
    if model is not None:
        from agent.model import IdentifiedModel

        identified = IdentifiedModel.load(model)
    robot = load_robot(robot_name) if identified is None else identified.robot
    return robot, Plant(robot, seed, effects, period=period, model=identified)


def _digest(seed: int) -> str:
    return hashlib.sha256(str(seed).encode()).hexdigest()
