"""The terms friction may be made of. Each acts on one axle and is linear in its one parameter.

| form               | torque on the axle per unit of its parameter |
| ------------------ | --------------------------------------------- |
| coulomb            | s                                             |
| viscous            | w                                             |
| quadratic          | w |w|                                         |
| offset             | 1                                             |
| viscous_asymmetry  | |w|                                           |
| stribeck           | s exp(-|w| / fading)                          |
| load               | s |load|                                      |

w is the axle's speed, load the torque it transmits to the links (see `agent.robot.drivetrain`), and s its direction of
sliding, between -1 and 1, which a `Reversal` makes of the motion. With s = sign(w) the first three are the seed paper's
(AIM 2013, eq. 2). A torque offset is what an asymmetric Coulomb friction amounts to while the joint moves.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from agent.robot import RobotDescription, axle_motion

#: Symbol of each form's parameter, and the power of speed it is multiplied with.
FORMS = {
    "coulomb": ("f0", 0),
    "viscous": ("f1", 1),
    "quadratic": ("f2", 2),
    "offset": ("offset", 0),
    "viscous_asymmetry": ("f1_asymmetry", 1),
    "stribeck": ("stribeck", 0),
    "load": ("load", 0),
}
#: Forms that change sign with the speed and nothing else.
ODD = ("coulomb", "viscous", "quadratic", "stribeck")


@dataclass(frozen=True)
class Reversal:
    """How the direction of sliding changes sign.

    kind "speed": s = tanh(w / scale), scale a speed [rad/s], or sign(w) with scale 0; friction follows the speed.
    kind "travel": ds = (1 - s sign(dx)) dx / scale, scale a travel [rad]: presliding, in which the contact gives way
    like a spring before it slides, so that friction after a stop is what it was before (Dahl, AIAA J. 14, 1976).
    On a slide metres stand for radians.
    """

    kind: str = "speed"
    scale: float = 0.0

    def following(self, speed: np.ndarray) -> np.ndarray:
        """(S,) s at speeds (S,); of a travel, once it is left behind."""
        return np.tanh(speed / self.scale) if self.kind == "speed" and self.scale else np.sign(speed)

    def text(self, unit: str) -> str:
        """In words; `unit` is the unit of the axle's travel."""
        if self.scale == 0:
            return "sign"
        return f"reversal within {self.scale:.3g} {unit}" + ("/s" if self.kind == "speed" else "")


@dataclass(frozen=True)
class FrictionTerm:
    """One column: `axle` from 0, `form` of the table above; `reversal` and `fading` [rad/s] where the form has one.

    On a slide metres stand for radians.
    """

    axle: int
    form: str
    reversal: Reversal | None = None
    fading: float | None = None

    @property
    def name(self) -> str:
        """As the table of parameters shows it, e.g. ``f0_2`` for the second axle."""
        return f"{FORMS[self.form][0]}_{self.axle + 1}"

    def unit(self, prismatic: bool) -> str:
        """Unit of its parameter."""
        if self.form == "load":
            return "-"
        power = FORMS[self.form][1]
        exponent = "²" if power == 2 else ""
        force, length = ("N" if prismatic else "N·m"), _length_unit(prismatic)
        return force if power == 0 else f"{force}·s{exponent}/{length}{exponent}"

    def meaning(self, joint: str, prismatic: bool) -> str:
        """In words."""
        unit = _length_unit(prismatic)
        details = [self.reversal.text(unit)] if self.reversal else []
        details += [f"fading over {self.fading:.3g} {unit}/s"] if self.fading else []
        return f"{self.form.replace('_', ' ')} friction of {joint}" + (f" ({', '.join(details)})" if details else "")


def _length_unit(prismatic: bool) -> str:
    return "m" if prismatic else "rad"


@dataclass(frozen=True, eq=False)
class AxleMotion:
    """Inputs of friction: position, speed and transmitted load of every axle (S, n); load is None if unknown."""

    position: np.ndarray
    speed: np.ndarray
    load: np.ndarray | None = None
    _known: dict[tuple[int, Reversal], np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(
        cls, robot: RobotDescription, q: np.ndarray, qd: np.ndarray, rigid_torque: np.ndarray | None = None
    ) -> AxleMotion:
        """From consecutive samples of joint motion (S, n) and, for the load, the torque of the rigid bodies (S, n)."""
        load = None if rigid_torque is None else rigid_torque @ np.linalg.inv(robot.coupling)
        return cls(axle_motion(robot, q), axle_motion(robot, qd), load)

    def directions(self, axle: int, reversals: list[Reversal]) -> None:
        """Work out several directions of one axle at once; `direction` returns them."""
        new = [r for r in reversals if r.kind == "travel" and (axle, r) not in self._known]
        if new:
            directions = dahl(self.position[:, axle], np.array([r.scale for r in new]))
            self._known.update({(axle, r): directions[:, k] for k, r in enumerate(new)})

    def direction(self, axle: int, reversal: Reversal) -> np.ndarray:
        """(S,) direction of sliding s."""
        if (axle, reversal) not in self._known:
            if reversal.kind == "travel":
                self.directions(axle, [reversal])
            else:
                self._known[axle, reversal] = reversal.following(self.speed[:, axle])
        return self._known[axle, reversal]

    @cached_property
    def magnitude(self) -> np.ndarray:
        """(S, n) |w|."""
        return np.abs(self.speed)


def axle_columns(terms: tuple[FrictionTerm, ...], motion: AxleMotion) -> np.ndarray:
    """(S, T): each term's torque on its own axle per unit of its parameter."""
    for axle in {term.axle for term in terms}:
        motion.directions(axle, list(dict.fromkeys(t.reversal for t in terms if t.axle == axle and t.reversal)))
    columns = np.empty((len(terms), len(motion.speed))).T
    for k, term in enumerate(terms):
        axle = term.axle
        direction = None if term.reversal is None else motion.direction(axle, term.reversal)
        load = None if motion.load is None else motion.load[:, axle]
        columns[:, k] = _column(term, motion.speed[:, axle], motion.magnitude[:, axle], direction, load)
    return columns


def steady_columns(terms: Sequence[FrictionTerm], speed: np.ndarray, sharp: bool = False) -> np.ndarray:
    """The same (S, T) at constant speeds (S,) of the axles, long after a reversal and without load; 0 at speed 0.

    A direction that follows the speed does so here; `sharp`: it is that of full sliding at the slowest speed already.

    Args:
        terms: of friction.
        speed: (S,) of the axles [rad/s].
        sharp: whether the slowest speed slides in full already.
    """
    columns, magnitude = np.zeros((len(speed), len(terms))), np.abs(speed)
    for k, term in enumerate(terms):
        direction = (Reversal() if sharp else term.reversal or Reversal()).following(speed)
        columns[:, k] = _column(term, speed, magnitude, direction, np.zeros_like(speed))
    return np.where(magnitude[:, None] > 0, columns, 0.0)


def _column(
    term: FrictionTerm, speed: np.ndarray, magnitude: np.ndarray, direction: np.ndarray | None, load: np.ndarray | None
) -> np.ndarray | float:
    match term.form:
        case "viscous":
            return speed
        case "quadratic":
            return speed * magnitude
        case "offset":
            return 1.0
        case "viscous_asymmetry":
            return magnitude
    assert direction is not None
    match term.form:
        case "coulomb":
            return direction
        case "stribeck":
            assert term.fading is not None
            return direction * np.exp(-magnitude / term.fading)
        case "load":
            assert load is not None
            return direction * np.abs(load)
    raise ValueError(f"no friction form {term.form!r}")


def dahl(position: np.ndarray, travels: np.ndarray) -> np.ndarray:
    """(S, K) direction of sliding s over a path (S,) for travels (K,), from s = 0 at its start.

    It is exact: a distance x to one side leads from s to sign - (sign - s) exp(-x / travel). What a stretch between two
    reversals begins with is worked out one stretch after the other, all that lies between them at once.
    """
    step = np.diff(position, prepend=position[:1])
    side, gone = np.sign(step), np.cumsum(np.abs(step))
    starts = np.flatnonzero(np.diff(side, prepend=np.nan))
    before, lengths = gone[starts] - np.abs(step[starts]), np.diff(starts, append=len(step))
    begins = np.empty((len(travels), len(starts)))
    for begin, decays in zip(begins, np.exp(-np.diff(before, append=gone[-1]) / travels[:, None]), strict=True):
        stretches = zip(side[starts].tolist(), decays.tolist(), strict=True)
        begin[:] = list(itertools.accumulate(stretches, lambda s, on: on[0] - (on[0] - s) * on[1], initial=0.0))[:-1]
    decay = np.exp(-(gone - np.repeat(before, lengths))[:, None] / travels)
    return side[:, None] - (side[:, None] - np.repeat(begins, lengths, axis=1).T) * decay
