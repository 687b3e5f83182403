"""Puts a controller together: a robot, the machine drawn from the seed, and an interpolator that is not quite ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agent.motion import FlyInterpolator, FlyParameters
from agent.robot import load_robot
from agent.robot.kinematics import kinematics_for
from fake_controller.clock import CLOCKS
from fake_controller.controller import PERIOD, Controller
from fake_controller.faults import Fault, Faults
from fake_controller.interpreter import left_over
from fake_controller.plant import Plant

# Ramps and blends of the controller's own: a few percent off those of our interpolator, as a real one's are.
PARAMETERS = FlyParameters(blend_shape=0.05, ramp=1.56, jerk_time=0.083, stress_floor=0.52, curve_share=0.77)


def build_controller(
    robot_name: str,
    seed: int,
    clock: str,
    effects: Sequence[Mapping[str, Any]] = (),
    faults: Sequence[Fault] = (),
    model: Path | None = None,
) -> Controller:
    """A controller at rest at the robot's calibration pose.

    Args:
        robot_name: built-in robot, or path of a robot.yaml.
        seed: of the machine, its noise, and the frames that somebody's last program has left.
        clock: `fast` or `real`.
        effects: built into the machine, as `fake_controller.actuation.load_effect` takes them.
        faults: what goes wrong, and when.
        model: file of a model that the machine is to be like, with its robot, instead of one drawn from the seed.

    Raises:
        InputError: no such robot or model, or an effect that does not fit it.
    """
    identified = None
    if model is not None:
        from agent.model.identified import IdentifiedModel

        identified = IdentifiedModel.load(model)
    robot = load_robot(robot_name) if identified is None else identified.robot
    return Controller(
        robot,
        Plant(robot, seed, effects, period=PERIOD, model=identified),
        FlyInterpolator(robot, period=PERIOD, parameters=PARAMETERS),
        kinematics_for(robot).forward,
        CLOCKS[clock](),
        serial=f"FAKE-{seed:04d}",
        faults=Faults(faults),
        system=left_over(seed),
    )
