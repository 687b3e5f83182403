"""Simulators as their owners keep them, MuJoCo's MJCF or a URDF, read as an identified model.

Nothing in such a file was identified, so its parameters come without uncertainty: the model holds them as exact, and
the error it should have is for the caller to say (`docs/decisions/simulator-background.md`).
"""

from agent.model.simulators.arm import SIMULATOR
from agent.model.simulators.joints import load_joint_map
from agent.model.simulators.load import Simulator, is_simulator, load_arm, load_simulator

__all__ = ["SIMULATOR", "Simulator", "is_simulator", "load_arm", "load_joint_map", "load_simulator"]
