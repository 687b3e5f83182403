"""Output error: the servo numbers whose free motion follows the recorded positions (Levenberg-Marquardt).

Minimised is Σ (q − q(θ))² / σ² over all frames and joints, plus a wide prior about the file's numbers: each may differ
by what would take all of its joint's torque. Where a recorder cut the commands, how near to the positions is fitted
too. Every stretch starts at its first frames' position and speed, as a start
that is fitted hides where friction holds a joint. It is judged from when the servos have settled. Derivatives are those
of the linear response. No number goes below zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from agent.core import InputError
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.recording import CommandedStretch, LinearisedMotion
from agent.diagnosis.rows.rounding import UNIFORM, rounding_step
from agent.model import NominalModel, RigidFrictionModel, ball
from agent.robot import ParameterLayout
from agent.simulators import KINDS, FreeMotion, FreeSimulator, ServoNumbers

Model = TypeVar("Model", bound=RigidFrictionModel)

_ROUNDS, _TRIES = 30, 6  # numerical: at most, and steps that are tried in each
_DAMPING, _STIFFER, _LOOSER = 1e-2, 5.0, 0.1  # numerical: of a step at first, after one that fails and one that gains
_GAINED = 1e-3  # numerical: of the cost, below which a round is the last
LONGEST_DELAY = 0.6  # s
USUAL_DELAY = 0.1  # s, standard deviation of a delay before the logs
LOAD_NUMBERS = ("m0", "hx0", "hy0", "hz0")  # mass and first moments of a load at the last link
_LOAD = len(LOAD_NUMBERS)
_LIGHTEST = 1e-6  # kg, below which a load has no inertia
_DELAY, _OFFSET = KINDS.index("delay"), KINDS.index("offset")
#: Kinds that are the file's until the motion says otherwise.
EXTRA = ("offset", "stiffness")


@dataclass(frozen=True, eq=False)
class Parameters:
    """Which of the 7 n numbers, the cut of commands and 4 numbers of a load are free, and which move together.

    `basis` (7 n + 5, p) of their change, `scale` (7 n + 5,) how far each may usually move; `one_delay` of the arm, or
    one of each joint; `springs`: stiffness is free.
    """

    basis: np.ndarray
    scale: np.ndarray
    one_delay: bool
    springs: bool

    @classmethod
    def create(
        cls, scale: np.ndarray, fixed: Sequence[str] = (), one_delay: bool = True, load: bool = False
    ) -> Parameters:
        """All numbers but kinds that are `fixed`, and the cut; one delay of the arm, or one a joint; a `load`."""
        kinds, n = len(KINDS), (len(scale) - 1 - _LOAD) // len(KINDS)
        eye = np.eye(len(scale))
        columns = []
        for number, kind in enumerate(KINDS):
            own = eye[:, number * n : (number + 1) * n]
            if kind in fixed:
                continue
            columns.append(own.sum(axis=1, keepdims=True) if kind == "delay" and one_delay else own)
        columns.append(eye[:, kinds * n : kinds * n + 1])
        if load:
            columns.append(eye[:, kinds * n + 1 :])
        return cls(np.hstack(columns), scale, one_delay, "stiffness" not in fixed)


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """A fit: the numbers, the motions linearised there, and residuals q − q(θ) per stretch (S', n).

    `simulator` is that of the file, without the load; `load` (10,) what the last link gains by it.
    """

    simulator: FreeSimulator
    reference: NominalModel
    parameters: Parameters
    numbers: ServoNumbers
    stretches: tuple[CommandedStretch, ...]
    motions: tuple[LinearisedMotion, ...]
    residuals: tuple[np.ndarray, ...]
    sigma: np.ndarray
    load: np.ndarray

    @cached_property
    def columns(self) -> list[np.ndarray]:
        """Per stretch (S', n, 7 n + 1), as `LinearisedMotion.number_columns`."""
        return [motion.number_columns(self.simulator, self.numbers) for motion in self.motions]

    @property
    def rmse(self) -> np.ndarray:
        """(n,) root mean square over all frames."""
        return np.sqrt(np.mean(np.concatenate(self.residuals) ** 2, axis=0))


def usual_scale(reference: NominalModel, numbers: ServoNumbers, stretches: Sequence[CommandedStretch]) -> np.ndarray:
    """(7 n + 5,) of each number what would take all of its joint's torque; of kp itself, of a delay `USUAL_DELAY`.

    Of a cut it is the widest lag, of a load what would take the strongest joint's torque at full reach.
    """
    lag, speed, acceleration = [], [], []
    travel = np.maximum(np.std(np.concatenate([stretch.position for stretch in stretches]), axis=0), 1e-6)
    for stretch in stretches:
        asked = stretch.command.between(np.append(stretch.time, 2 * stretch.time[-1] - stretch.time[-2]), numbers.delay)
        qd = np.gradient(stretch.position, stretch.time, axis=0)
        lag.append(asked - stretch.position)
        speed.append(qd)
        acceleration.append(np.gradient(qd, stretch.time, axis=0))
    torque, speeds, accelerations = (
        np.maximum(np.sqrt(np.mean(np.concatenate(part) ** 2, axis=0)), 1e-6) for part in (lag, speed, acceleration)
    )
    offset, torque = torque, torque * numbers.kp
    delay = np.full(len(torque), USUAL_DELAY)
    servos = np.stack([torque / accelerations, torque / speeds, torque, numbers.kp, torque / travel, delay, offset])
    weight = max(float(np.linalg.norm(reference.robot.gravity)), 1.0)
    mass = float(torque.max()) / weight / reference.reach
    load = mass * np.array([1.0, *[reference.reach] * (_LOAD - 1)])
    return np.concatenate([servos.ravel(), [widest_lag(stretches)], load])


def widest_lag(stretches: Sequence[CommandedStretch]) -> float:
    """The largest distance of a wanted command from the position [rad or m]."""
    return max(float(np.abs(s.wanted.set_points - s.position).max()) for s in stretches)


def position_step(stretches: Sequence[CommandedStretch]) -> np.ndarray:
    """(n,) step to which positions are rounded [rad or m]."""
    return np.asarray(
        np.max([[rounding_step(column) for column in stretch.position.T] for stretch in stretches], axis=0)
    )


def usual_twist(motions: Sequence[FreeMotion], kp: np.ndarray) -> np.ndarray:
    """(n,) how far the servos' torque twists them [rad or m]: a share of torque is the same share of it.

    Not the lag behind the recorded command: most of that is the delay, which has no error of its own.
    """
    torque = np.std(np.concatenate([motion.torque for motion in motions]), axis=0)
    return np.asarray(np.maximum(torque / np.maximum(kp, 1e-9), 1e-6))


def fit_output_error(
    simulator: FreeSimulator,
    reference: NominalModel,
    stretches: Sequence[CommandedStretch],
    file: ServoNumbers,
    start: ServoNumbers,
    parameters: Parameters,
    progress: Callable[[str], None] = lambda text: None,
    gained: float = _GAINED,
    load: np.ndarray | None = None,
    errors: np.ndarray | float = 0.0,
) -> OutputErrorFit:
    """Fit the numbers, from a `start` and what the last link gains by a `load` (10,) on.

    Joints that err by `errors` (n,) [rad or m] whatever the numbers are count for less.

    Raises:
        InputError: the simulator blows up with the numbers to start from.
    """
    basis, scale = parameters.basis, parameters.scale
    size = np.sqrt(np.maximum((basis**2 * scale[:, None] ** 2).sum(axis=0) / (basis**2).sum(axis=0), 1e-300))
    n, cut = len(start.kp), stretches[0].nearest if stretches[0].nearest < np.inf else 0.0
    begun = np.zeros(_LOAD) if load is None else load[:_LOAD]
    table, last = np.concatenate([start.table.ravel(), [cut], begun]), len(KINDS) * n
    first = _run(simulator, table, stretches)
    if first is None:
        raise InputError(f"{simulator.arm.path}: the simulator blows up under the recorded command as the file is")
    motions: list[FreeMotion] = first
    sigma = np.hypot(position_step(stretches) * np.sqrt(UNIFORM), LIMITS.least_error * usual_twist(motions, start.kp))
    x = np.linalg.lstsq(basis, table - np.concatenate([file.table.ravel(), [cut], np.zeros(_LOAD)]), rcond=None)[0]
    expected = np.hypot(sigma, errors)
    weight, residuals = _DAMPING, _left(stretches, motions)

    def cost_of(residuals_at: Sequence[np.ndarray], at: np.ndarray) -> float:
        return sum(float(np.sum((residual / expected) ** 2)) for residual in residuals_at) + float(
            np.sum((at / size) ** 2)
        )

    def linearised() -> Iterator[LinearisedMotion]:
        carrying = _loaded(reference, table[-_LOAD:])
        for stretch, motion in zip(_cut(stretches, table), motions, strict=True):
            yield stretch.linearised(simulator, ServoNumbers.of_table(table[:last].reshape(-1, n)), motion, carrying)

    cost = cost_of(residuals, x)
    for number in range(_ROUNDS):
        numbers = ServoNumbers.of_table(table[:last].reshape(-1, n))
        matrix, side = np.diag(1 / size**2), -x / size**2
        for line, missing in zip(linearised(), residuals, strict=True):
            columns = _columns(line, line.number_columns(simulator, numbers), table[-_LOAD:], basis)
            rows = (columns / expected[None, :, None]).reshape(-1, len(size))
            matrix += rows.T @ rows
            side += rows.T @ (missing / expected).ravel()
        drop = 0.0
        for _ in range(_TRIES):
            step = _bounded_step(matrix, side, weight, basis, table)
            moved = _possible(table + basis @ step, last, reference.reach)
            now = _run(simulator, moved, stretches)
            if now is not None:
                left_now = _left(stretches, now)
                if (cost_now := cost_of(left_now, x + step)) < cost:
                    drop = 1 - cost_now / cost
                    table, x, motions, residuals, cost = moved, x + step, now, left_now, cost_now
                    break
            weight *= _STIFFER
        if not drop:
            break
        weight = max(weight * _LOOSER, 1e-8)
        progress(f"output error, round {number + 1}")
        if drop < gained:
            break
    numbers, lines = ServoNumbers.of_table(table[:last].reshape(-1, n)), tuple(linearised())
    carried = load_shape(table[-_LOAD:]) @ table[-_LOAD:]
    at = _cut(stretches, table)
    return OutputErrorFit(simulator, reference, parameters, numbers, at, lines, tuple(residuals), sigma, carried)


def _columns(line: LinearisedMotion, of_numbers: np.ndarray, load: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """(S', n, p) change of the judged positions with each free number."""
    columns = of_numbers @ basis[:-_LOAD]
    if basis[-_LOAD:].any():
        columns += line.load_columns(load_shape(load)) @ basis[-_LOAD:]
    return np.asarray(columns)


def _cut(stretches: Sequence[CommandedStretch], table: np.ndarray) -> tuple[CommandedStretch, ...]:
    """The stretches, their commands cut as the table says where they were cut."""
    if stretches[0].nearest == np.inf:
        return tuple(stretches)
    return tuple(stretch.cut(float(table[-_LOAD - 1])) for stretch in stretches)


def load_shape(load: np.ndarray) -> np.ndarray:
    """(10, 4) parameters of a link per unit of a point's mass and first moments (4,), exact at this one."""
    if load[0] < _LIGHTEST:
        return np.eye(10)[:, :_LOAD]
    return ball({**dict(zip(LOAD_NUMBERS, map(float, load), strict=True)), "point_mass": 1.0})


def _loaded(reference: NominalModel, load: np.ndarray) -> NominalModel:
    """The reference with a load at its last link."""
    return NominalModel(with_link(reference.model, load_shape(load) @ load)) if load.any() else reference


def with_link(model: Model, gained: np.ndarray) -> Model:
    """The model in which the link that carries a load has gained standard parameters (10,)."""
    change = np.zeros(model.projection.shape[1])
    change[ParameterLayout.of(model.robot).link(model.robot.load_link)] = gained
    values = model.values.copy()
    values[: len(model.independent)] += model.projection @ change
    return replace(model, values=values)


def _possible(table: np.ndarray, last: int, reach: float) -> np.ndarray:
    """The numbers and the load next to these that can be: none below zero but offsets, no load beyond the arm's
    reach."""
    possible = np.where(_not_negative(table), np.maximum(table, 0.0), table)
    kinds = possible[:last].reshape(len(KINDS), -1)
    kinds[_DELAY] = np.minimum(kinds[_DELAY], LONGEST_DELAY)
    away, most = float(np.linalg.norm(possible[last + 2 :])), reach * possible[last + 1]
    possible[last + 2 :] *= min(1.0, most / away) if away > 0 else 1.0
    return possible


def _not_negative(table: np.ndarray) -> np.ndarray:
    """(7 n + 5,) bool: which numbers cannot be below zero: all but offsets and the moments of a load."""
    count, which = len(table) - 1 - _LOAD, np.arange(len(table))
    return np.asarray((which <= count + 1) & (which // (count // len(KINDS)) != _OFFSET))


def _left(stretches: Sequence[CommandedStretch], motions: Sequence[FreeMotion]) -> list[np.ndarray]:
    return [missed(stretch, motion) for stretch, motion in zip(stretches, motions, strict=True)]


def missed(stretch: CommandedStretch, motion: FreeMotion) -> np.ndarray:
    """(S', n) what a motion misses of the judged positions."""
    return stretch.position[stretch.judged] - motion.at(stretch.time[stretch.judged])


def _bounded_step(
    matrix: np.ndarray, side: np.ndarray, weight: float, basis: np.ndarray, table: np.ndarray
) -> np.ndarray:
    """The damped step; numbers and a mass that are zero and would fall stay there."""
    bounded = _not_negative(table)
    free = np.ones(len(matrix), dtype=bool)
    for _ in range(len(matrix)):
        at = np.flatnonzero(free)
        some = matrix[np.ix_(at, at)]
        unit = 1 / np.sqrt(np.diag(some))
        some = some * np.outer(unit, unit) + weight * np.eye(len(at))
        step = np.zeros(len(matrix))
        step[at] = unit * np.linalg.solve(some, unit * side[at])
        below = bounded & (table <= 0) & (basis @ step < 0)
        stopped = np.any(basis[below] != 0, axis=0) & free
        if not stopped.any():
            break
        free &= ~stopped
    return step


def _run(simulator: FreeSimulator, table: np.ndarray, stretches: Sequence[CommandedStretch]) -> list[FreeMotion] | None:
    if not np.all(np.isfinite(table)):
        return None
    numbers, load = ServoNumbers.of_table(table[: -_LOAD - 1].reshape(len(KINDS), -1)), table[-_LOAD:]
    carrying = simulator.carrying(load_shape(load) @ load) if load.any() else simulator
    ran = []
    for stretch in _cut(stretches, table):
        if (motion := stretch.run(carrying, numbers)) is None:
            return None
        ran.append(motion)
    return ran
