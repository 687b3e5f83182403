"""Simulators as files: MuJoCo's MJCF and URDF read as an identified model, corrected, exported and run forward.

Nothing in such a file was identified, so its parameters come without uncertainty: the model holds them as exact, and
the error it should have is for the caller to say (`docs/decisions/simulator-background.md`).
"""

from agent.simulators.arm import SIMULATOR
from agent.simulators.corrected.corrected_file import write_corrected, written_files
from agent.simulators.corrected.correction import Commands, Correction, Released, correct
from agent.simulators.export import export_model, export_table
from agent.simulators.forward import ExternalTorque, ForwardSimulation, RigidActuation, ServoGains, SimulatedMotion
from agent.simulators.joints import load_joint_map
from agent.simulators.loads import identified_load, load_text
from agent.simulators.mjcf import compiled, mujoco_package
from agent.simulators.servos import SERVO_STIFFNESS, PositionServos, servo_stiffness
from agent.simulators.simulator import Simulator, is_simulator, load_arm, load_simulator

__all__ = [
    "SERVO_STIFFNESS",
    "SIMULATOR",
    "Commands",
    "Correction",
    "ExternalTorque",
    "ForwardSimulation",
    "PositionServos",
    "Released",
    "RigidActuation",
    "ServoGains",
    "SimulatedMotion",
    "Simulator",
    "compiled",
    "correct",
    "export_model",
    "export_table",
    "identified_load",
    "is_simulator",
    "load_arm",
    "load_joint_map",
    "load_simulator",
    "load_text",
    "mujoco_package",
    "servo_stiffness",
    "write_corrected",
    "written_files",
]
