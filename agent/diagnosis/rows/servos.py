"""Parameters of position servos: where they lie among those of a model, and what a file says of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.simulators import KINDS, ServoNumbers, SimulatedArm


@dataclass(frozen=True)
class PositionLayout:
    """Where each kind of parameters of position logs lies in a vector (p,), in this order.

    Base parameters, then friction [N·m] and damping [N·m·s/rad] of each of n joints in turn; kp (n,) [N·m/rad], the cut
    of commands (1,) [rad or m], bend of damping (n,), stiffness of springs (n,) [N·m/rad], offset (n,) [rad or m] and
    delay (n,) [s].

    Damping d bends with speed by b: the torque is d v + b v |v|. No file of a simulator has b.
    """

    base: slice
    friction: slice
    damping: slice
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
    def of_numbers(self) -> dict[str, slice]:
        """Where kinds of `ServoNumbers` lie; armature is a part of the base parameters."""
        return {kind: getattr(self, kind) for kind in KINDS if kind != "armature"}

    @property
    def size(self) -> int:
        """Number p of parameters."""
        return int(self.delay.stop)


@dataclass(frozen=True, eq=False)
class ServoPrior:
    """What numbers of a file usually change by: `covariance` (p, p) of all parameters as the file has them.

    A usual `delay` [s], `spring` (n,) [N·m/rad] (None where the motion wants none), `offset` (n,) [rad or m] of the
    joints `with_offset`, and `load` (10, 4): what the last link gains by a usual mass and usual first moments. By `cut`
    [rad or m] commands may have been cut nearer to the positions, 0 where they were not. `one_delay`: all joints have
    that of the arm. `kp_known`: the file's kp are right.
    """

    covariance: np.ndarray
    delay: float
    spring: np.ndarray | None
    offset: np.ndarray
    with_offset: tuple[int, ...]
    load: np.ndarray
    cut: float
    one_delay: bool
    kp_known: bool


@dataclass(frozen=True, eq=False)
class ComparedSimulation:
    """The simulated `arm` whose motion was compared, in steps of `step` [s], which add `inertia` (n,) [kg·m²].

    `error`: (n,) [rad or m] of its free motion with other numbers, and parameters (10,) that the last link gains;
    `fit_error` (n,) [rad or m] that of the fit.
    """

    arm: SimulatedArm
    step: float
    inertia: np.ndarray
    error: Callable[[ServoNumbers, np.ndarray], np.ndarray]
    fit_error: np.ndarray


@dataclass(frozen=True, eq=False)
class ServoParameters:
    """Numbers of position servos in a `file`, and how the logs may change them.

    `layout` of a change (p,) of all parameters; the rows are linear about the change `fitted` (p,). The delay may be
    `later` [s] by as much (sooner where negative), if the command was held in the other way.
    """

    layout: PositionLayout
    file: ServoNumbers
    fitted: np.ndarray
    prior: ServoPrior
    simulation: ComparedSimulation
    later: float

    def gains(self, change: np.ndarray) -> np.ndarray:
        """(n,) kp [N·m/rad] of the file moved by a change (p,) of all parameters."""
        return np.asarray(self.file.kp + change[self.layout.kp])

    def offsets(self, change: np.ndarray) -> np.ndarray:
        """(n,) offsets [rad] of the file moved by a change (p,) of all parameters."""
        return np.asarray(self.file.offset + change[self.layout.offset])
