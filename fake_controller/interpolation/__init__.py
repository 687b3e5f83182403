"""The controller's interpolators: ours with ramps and blends a few percent off, and a second one that shares nothing
with it but the settings of a move."""

from __future__ import annotations

from agent.motion import FlyInterpolator, FlyParameters, Interpolator
from agent.robot import RobotDescription
from fake_controller.interpolation.parts import drawn_law
from fake_controller.interpolation.second import SecondInterpolator

#: Ramps and blends of the controller's own: a few percent off those of our interpolator, as a real one's are.
PARAMETERS = FlyParameters(blend_shape=0.05, ramp=1.56, jerk_time=0.083, stress_floor=0.52, curve_share=0.77)
KINDS = ("ours", "second")


def build_interpolator(kind: str, robot: RobotDescription, seed: int, period: float) -> Interpolator:
    """One of `KINDS` at `period` [s]; the second one's law is drawn from the seed."""
    if kind == "second":
        return SecondInterpolator(robot, drawn_law(seed), period)
    return FlyInterpolator(robot, period=period, parameters=PARAMETERS)
