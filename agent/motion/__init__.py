"""Motion programs, via-point regions and the interpolators that turn a program into set-points."""

from agent.motion.fly import FlyInterpolator
from agent.motion.fly_parameters import FlyParameters
from agent.motion.interpolator import Interpolator, MotionError, create_interpolator, interpolator_names

__all__ = [
    "FlyInterpolator",
    "FlyParameters",
    "Interpolator",
    "MotionError",
    "create_interpolator",
    "interpolator_names",
]
