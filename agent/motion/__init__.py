"""Motion programs, via-point regions and the interpolators that turn a program into set-points."""

from agent.motion.fly.interpolator import FlyInterpolator
from agent.motion.fly_parameters import FlyParameters
from agent.motion.interpolator import Interpolator, MotionError
from agent.motion.loop import approach_moves, loop_moves
from agent.motion.regions import ViaRegions
from agent.motion.registry import create_interpolator, interpolator_names
from agent.motion.trajectory import BindingLimit, Trajectory

__all__ = [
    "BindingLimit",
    "FlyInterpolator",
    "FlyParameters",
    "Interpolator",
    "MotionError",
    "Trajectory",
    "ViaRegions",
    "approach_moves",
    "create_interpolator",
    "interpolator_names",
    "loop_moves",
]
