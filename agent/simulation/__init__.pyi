from .actuation import Actuation as Actuation, RigidActuation as RigidActuation
from .forward import (
    ExternalTorque as ExternalTorque,
    ForwardSimulation as ForwardSimulation,
    SimulatedMotion as SimulatedMotion,
)
from .servo import CascadedServo as CascadedServo, ServoGains as ServoGains
