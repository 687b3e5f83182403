"""Robot description, kinematics, dynamics, base parameters and drives.

`agent.robot.dynamics` is imported where it is used: it loads Pinocchio. So is
`agent.robot.base_reduction`, whose function has its name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
