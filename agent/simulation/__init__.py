"""Forward simulation of a servo-controlled arm."""

from agent.simulation.actuation import Actuation, RigidActuation
from agent.simulation.forward import ExternalTorque, ForwardSimulation, SimulatedMotion
from agent.simulation.servo import CascadedServo, ServoGains

__all__ = [
    "Actuation",
    "CascadedServo",
    "ExternalTorque",
    "ForwardSimulation",
    "RigidActuation",
    "ServoGains",
    "SimulatedMotion",
]
