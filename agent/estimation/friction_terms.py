"""The terms friction may be made of. Each acts on one axle, is linear in its one parameter, and lists its constants.

| form               | torque on the axle per unit of its parameter      | constants                            |
| ------------------ | ------------------------------------------------- | ------------------------------------ |
| coulomb            | tanh(w / transition)                              | transition [rad/s], 0: the sign      |
| viscous            | w                                                 |                                      |
| quadratic          | w |w|                                             |                                      |
| offset             | 1                                                 |                                      |
| coulomb_asymmetry  | |tanh(w / transition)|                            | transition                           |
| viscous_asymmetry  | |w|                                               |                                      |
| stribeck           | tanh(w / transition) exp(-|w| / fading)           | transition, fading [rad/s]           |
| load               | tanh(w / transition) |load|                       | transition                           |

w is the axle's speed, load the torque it transmits to the links (see `agent.robot.drivetrain`). The
first three are the seed paper's (AIM 2013, eq. 2), with the sign smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.robot import RobotDescription
from agent.robot.drivetrain import axle_motion

#: Symbol of each form's parameter and its unit on a revolute axle.
SYMBOLS = {
    "coulomb": ("f0", "N·m"),
    "viscous": ("f1", "N·m·s/rad"),
    "quadratic": ("f2", "N·m·s²/rad²"),
    "offset": ("offset", "N·m"),
    "coulomb_asymmetry": ("f0_asymmetry", "N·m"),
    "viscous_asymmetry": ("f1_asymmetry", "N·m·s/rad"),
    "stribeck": ("stribeck", "N·m"),
    "load": ("load", "-"),
}


@dataclass(frozen=True)
class FrictionTerm:
    """One column: `axle` from 0, `form` and `constants` of the table above."""

    axle: int
    form: str
    constants: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """As the table of parameters shows it, e.g. ``f0_2`` for the second axle."""
        return f"{SYMBOLS[self.form][0]}_{self.axle + 1}"


@dataclass(frozen=True, eq=False)
class AxleState:
    """What friction depends on: speed and transmitted load of every axle, (S, n); load None where unknown."""

    speed: np.ndarray
    load: np.ndarray | None = None

    @classmethod
    def of(cls, robot: RobotDescription, qd: np.ndarray, rigid_torque: np.ndarray | None = None) -> AxleState:
        """From joint speed (S, n) and, for the load, the torque of the rigid bodies (S, n)."""
        load = None if rigid_torque is None else rigid_torque @ np.linalg.inv(robot.coupling)
        return cls(axle_motion(robot, qd), load)


def axle_columns(terms: tuple[FrictionTerm, ...], state: AxleState) -> np.ndarray:
    """(S, T): each term's torque on its own axle per unit of its parameter."""
    columns = np.empty((len(state.speed), len(terms)))
    for k, term in enumerate(terms):
        columns[:, k] = _column(term, state)
    return columns


def _column(term: FrictionTerm, state: AxleState) -> np.ndarray:
    speed = state.speed[:, term.axle]
    match term.form:
        case "coulomb":
            return _sign(speed, term.constants[0])
        case "viscous":
            return speed
        case "quadratic":
            return speed * np.abs(speed)
        case "offset":
            return np.ones_like(speed)
        case "coulomb_asymmetry":
            return np.abs(_sign(speed, term.constants[0]))
        case "viscous_asymmetry":
            return np.abs(speed)
        case "stribeck":
            transition, fading = term.constants
            return _sign(speed, transition) * np.exp(-np.abs(speed) / fading)
        case "load":
            assert state.load is not None
            return _sign(speed, term.constants[0]) * np.abs(state.load[:, term.axle])
    raise ValueError(f"no friction form {term.form!r}")


def _sign(speed: np.ndarray, transition: float) -> np.ndarray:
    return np.sign(speed) if transition == 0 else np.tanh(speed / transition)
