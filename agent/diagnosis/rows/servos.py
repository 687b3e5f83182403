"""Parameters of position servos: where they lie among those of a model, and what a file says of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.simulators import ServoNumbers, SimulatedArm


@dataclass(frozen=True)
class PositionLayout:
    """Where each kind of parameters of position logs lies in a vector (p,), in this order.

    Base parameters, then Coulomb and viscous friction of each of n joints in turn; kp (n,) [N·m/rad], the cut of
    commands (1,) [rad or m], bend of damping (n,), stiffness of springs (n,) [N·m/rad], offset (n,) [rad or m] and
    delay (n,) [s].

    Damping d bends with speed by b: the torque is d v + b v |v|. No file of a simulator has b.
    """

    base: slice
    coulomb: slice
    viscous: slice
    kp: slice
    cut: slice
    bend: slice
    stiffness: slice
    offset: slice
    delay: slice

    @classmethod
    def create(cls, base: int, joints: int) -> PositionLayout:
        """Of a model with a number of base parameters, and of joints."""
        edges = np.cumsum([base, 2 * joints, joints, 1, joints, joints, joints, joints]).tolist()
        of_servos = (slice(*ends) for ends in pairwise(edges[1:]))
        return cls(slice(base), slice(base, edges[1], 2), slice(base + 1, edges[1], 2), *of_servos)

    @property
    def size(self) -> int:
        """Number p of parameters."""
        return int(self.delay.stop)


@dataclass(frozen=True, eq=False)
class ServoParameters:
    """Parameters of position servos, which `layout` finds in a change (p,) of all parameters.

    `covariance` (p, p) of all parameters as the file has them; `delay` [s] a usual one; `file`: its numbers; the rows
    are linear about a change `about` (p,). `spring` (n,) [N·m/rad] a usual one, None where the motion wants none;
    `offset` (n,) [rad] a usual one, and `with_offset` the joints that may have one. `free_error`: (n,) [rad or m] of
    the arm's free motion with other numbers, and parameters (10,) that the last link gains; `fit_error` (n,) that of
    the fit.
    `kp_known`: the file's kp are right. `cut` [rad or m]: how much nearer to the positions commands may have been cut,
    0 where they were not. `load` (10, 4): what the last link gains by a usual mass and usual first moments of a load
    there.
    `later` [s]: the delay may be as much more (less where negative), if the command was held in the other way. `step`
    [s] of the simulation, which adds inertia `added` (n,) [kg·m²]; `simulated` is the arm whose motion was compared;
    `one_delay`: all joints have that of the arm.
    """

    layout: PositionLayout
    covariance: np.ndarray
    delay: float
    file: ServoNumbers
    about: np.ndarray
    simulated: SimulatedArm
    added: np.ndarray
    load: np.ndarray
    spring: np.ndarray | None
    offset: np.ndarray
    with_offset: tuple[int, ...]
    free_error: Callable[[ServoNumbers, np.ndarray], np.ndarray]
    fit_error: np.ndarray
    cut: float = 0.0
    kp_known: bool = False
    later: float = 0.0
    step: float = 0.0
    one_delay: bool = True

    def gains(self, change: np.ndarray) -> np.ndarray:
        """(n,) kp [N·m/rad] of the file moved by a change (p,) of all parameters."""
        return np.asarray(self.file.kp + change[self.layout.kp])

    def offsets(self, change: np.ndarray) -> np.ndarray:
        """(n,) offsets [rad] of the file moved by a change (p,) of all parameters."""
        return np.asarray(self.file.offset + change[self.layout.offset])
