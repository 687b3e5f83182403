"""Puts a controller together: a robot, the machine drawn from the seed, and one of the controller's interpolators."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.robot import kinematics_for, load_robot
from fake_controller.clock import CLOCKS
from fake_controller.controller import PERIOD, Controller
from fake_controller.faults import Fault, Faults
from fake_controller.interpolation import build_interpolator
from fake_controller.interpreter import left_over
from fake_controller.plant import Plant


def build_controller(
    robot_name: str,
    seed: int,
    clock: str,
    effects: Sequence[Mapping[str, Any]] = (),
    faults: Sequence[Fault] = (),
    model: Path | None = None,
    interpolator: str = "ours",
) -> Controller:
    """A controller at rest at the robot's calibration pose.

    Args:
        robot_name: built-in robot, or path of a robot.yaml.
        seed: of the machine, its noise, and the frames that somebody's last program has left.
        clock: `fast` or `real`.
        effects: built into the machine, as `fake_controller.actuation.load_effect` takes them.
        faults: what goes wrong, and when.
        model: file of a model that the machine is to be like, with its robot, instead of one drawn from the seed.
        interpolator: one of `fake_controller.interpolation.KINDS`, or `drawn`: which of them is the seed's.

    Raises:
        InputError: no such robot or model, or an effect that does not fit it.
    """
    identified = None
    if model is not None:
        from agent.model import IdentifiedModel

        identified = IdentifiedModel.load(model)
    robot = load_robot(robot_name) if identified is None else identified.robot
    return Controller(
        robot,
        Plant(robot, seed, effects, period=PERIOD, model=identified),
        build_interpolator(interpolator, robot, seed, PERIOD),
        kinematics_for(robot).forward,
        CLOCKS[clock](),
        serial=_serial(seed),
        faults=Faults(faults),
        system=left_over(seed),
    )


def _serial(seed: int) -> str:
    """Of the machine with a seed. A long seed is secret, so its serial is a digest of it."""
    number = f"{seed:04d}" if seed < 10_000 else hashlib.sha256(str(seed).encode()).hexdigest()[:8]
    return f"FAKE-{number}"
