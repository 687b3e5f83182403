from .actuation import RigidActuation as RigidActuation
from .forward import (
    ExternalTorque as ExternalTorque,
    ForwardSimulation as ForwardSimulation,
    SimulatedMotion as SimulatedMotion,
)
from .servo import ServoGains as ServoGains
