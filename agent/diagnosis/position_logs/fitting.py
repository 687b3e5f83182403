"""Output error: the servo numbers whose free motion follows the recorded positions (Levenberg-Marquardt).

Minimised is Σ (q − q(θ))² / σ² over all frames and joints, plus a wide prior about the file's numbers: each may differ
by what would take all of its joint's torque. Where a recorder cut the commands, how near to the positions is fitted
too. Every stretch starts at its first frames' position and speed, as a start
that is fitted hides where friction holds a joint. It is judged from when the servos have settled. Derivatives are those
of the linear response. No number goes below zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from agent.core import InputError
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.stretch import CommandedStretch, LinearisedMotion
from agent.diagnosis.rows.rounding import UNIFORM, rounding_step
from agent.model import NominalModel, RigidFrictionModel, ball
from agent.robot import ParameterLayout
from agent.simulators import KINDS, FreeMotion, FreeSimulator, ServoNumbers

Model = TypeVar("Model", bound=RigidFrictionModel)

_ROUNDS, _TRIES = 30, 6  # numerical: at most, and steps that are tried in each
_DAMPING = 1e-2  # numerical: of a step at first
_GAINED = 1e-3  # numerical: of the cost, below which a round is the last
LONGEST_DELAY = 0.6  # s
USUAL_DELAY = 0.1  # s, standard deviation of a delay before the logs
LOAD_NUMBERS = ("m0", "hx0", "hy0", "hz0")  # mass and first moments of a load at the last link
_LOAD = len(LOAD_NUMBERS)
_LIGHTEST = 1e-6  # kg, below which a load has no inertia
#: Kinds that are the file's until the motion says otherwise.
EXTRA = ("offset", "stiffness")


@dataclass(frozen=True, eq=False)
class MovedNumbers:
    """What a fit moves: numbers of n servos, how near [rad or m] commands are cut (0: not), `LOAD_NUMBERS` (4,)."""

    servos: ServoNumbers
    cut: float
    load: np.ndarray

    @classmethod
    def of_vector(cls, vector: np.ndarray) -> MovedNumbers:
        """From (7 n + 5,), in the order of `vector`."""
        table = vector[: -_LOAD - 1].reshape(len(KINDS), -1)
        return cls(ServoNumbers.of_table(table), float(vector[-_LOAD - 1]), vector[-_LOAD:])

    @property
    def vector(self) -> np.ndarray:
        """(7 n + 5,) numbers of servos kind by kind, the cut, and the load."""
        return np.concatenate([self.servos.table.ravel(), [self.cut], self.load])

    @property
    def at_zero(self) -> np.ndarray:
        """(7 n + 5,) bool: which numbers cannot fall, as all but offsets and the moments of a load where they are 0."""
        of_servos = np.repeat([kind != "offset" for kind in KINDS], len(self.servos.kp))
        return np.concatenate([of_servos, [True], np.arange(_LOAD) == 0]) & (self.vector <= 0)

    def possible(self, reach: float) -> MovedNumbers:
        """The nearest ones that can be: none below zero but offsets, no load beyond the arm's reach [m]."""
        servos = self.servos.possible
        mass, moments = max(self.load[0], 0.0), self.load[1:]
        moment, largest = float(np.linalg.norm(moments)), reach * mass
        load = np.append(mass, moments * (min(1.0, largest / moment) if moment > 0 else 1.0))
        return MovedNumbers(replace(servos, delay=np.minimum(servos.delay, LONGEST_DELAY)), max(self.cut, 0.0), load)


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """Which of the `MovedNumbers` are free, and which move together.

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
    ) -> FreeParameters:
        """All numbers but kinds that are `fixed`, and the cut; one delay of the arm, or one a joint; a `load`."""
        servos = len(scale) - 1 - _LOAD
        eye = np.eye(len(scale))[:, : None if load else servos + 1]
        kinds = dict(zip(KINDS, np.split(eye[:, :servos], len(KINDS), axis=1), strict=True))
        if one_delay:
            kinds["delay"] = kinds["delay"].sum(axis=1, keepdims=True)
        free = [part for kind, part in kinds.items() if kind not in fixed]
        return cls(np.hstack([*free, eye[:, servos:]]), scale, one_delay, "stiffness" not in fixed)

    @property
    def size(self) -> np.ndarray:
        """(p,) how far each free parameter may usually move."""
        squares = self.basis**2
        return np.sqrt(np.maximum((squares * self.scale[:, None] ** 2).sum(axis=0) / squares.sum(axis=0), 1e-300))


@dataclass(frozen=True, eq=False)
class OutputErrorProblem:
    """Which stretches a simulator has to follow, by what; `reference` is the model of its file, without a load."""

    simulator: FreeSimulator
    reference: NominalModel
    stretches: tuple[CommandedStretch, ...]
    parameters: FreeParameters

    def cut(self, numbers: MovedNumbers) -> tuple[CommandedStretch, ...]:
        """The stretches, their commands cut as the numbers say where they were cut."""
        if self.stretches[0].nearest == np.inf:
            return self.stretches
        return tuple(stretch.cut(numbers.cut) for stretch in self.stretches)

    def run(self, numbers: MovedNumbers) -> Iterator[FreeMotion | None]:
        """The motions with other numbers, one after the other; None where the simulator blows up."""
        load = numbers.load
        carrying = self.simulator.carrying(load_shape(load) @ load) if load.any() else self.simulator
        finite = bool(np.all(np.isfinite(numbers.vector)))
        for stretch in self.cut(numbers):
            yield stretch.run(carrying, numbers.servos) if finite else None

    def linearised(self, numbers: MovedNumbers, motions: Sequence[FreeMotion]) -> Iterator[LinearisedMotion]:
        """The motions with these numbers, with their linear response."""
        carrying = _loaded(self.reference, numbers.load)
        for stretch, motion in zip(self.cut(numbers), motions, strict=True):
            yield stretch.linearised(self.simulator, numbers.servos, motion, carrying)


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """A fit: the numbers, the motions linearised there, and residuals q − q(θ) per stretch (S', n).

    `simulator` is that of the file, without the load; `load` (10,) what the last link gains by it.
    """

    simulator: FreeSimulator
    reference: NominalModel
    parameters: FreeParameters
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
    def problem(self) -> OutputErrorProblem:
        """What was fitted, with the commands as they were found to be cut."""
        return OutputErrorProblem(self.simulator, self.reference, self.stretches, self.parameters)

    @property
    def rmse(self) -> np.ndarray:
        """(n,) root mean square over all frames."""
        return np.sqrt(np.mean(np.concatenate(self.residuals) ** 2, axis=0))


def usual_scale(reference: NominalModel, numbers: ServoNumbers, stretches: Sequence[CommandedStretch]) -> MovedNumbers:
    """Of each number what would take all of its joint's torque; of kp itself, of a delay `USUAL_DELAY`.

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
    servos = ServoNumbers(torque / accelerations, torque / speeds, torque, numbers.kp, torque / travel, delay, offset)
    weight = max(float(np.linalg.norm(reference.robot.gravity)), 1.0)
    mass = float(torque.max()) / weight / reference.reach
    load = mass * np.array([1.0, *[reference.reach] * (_LOAD - 1)])
    return MovedNumbers(servos, widest_lag(stretches), load)


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


@dataclass(frozen=True, eq=False)
class _Iterate:
    """Numbers, their change (p,) from the file's, the motions, and residuals and cost there."""

    numbers: MovedNumbers
    change: np.ndarray
    motions: list[FreeMotion]
    residuals: list[np.ndarray]
    cost: float


@dataclass(frozen=True, eq=False)
class _LevenbergMarquardt:
    """Steps down the cost, Σ (residual / expected (n,))² and that of the prior."""

    problem: OutputErrorProblem
    expected: np.ndarray

    def at(
        self, numbers: MovedNumbers, change: np.ndarray, motions: Iterable[FreeMotion | None], limit: float = np.inf
    ) -> _Iterate | None:
        """The residuals and the cost of motions; None where that is no less than a `limit`, or one blows up."""
        judged, residuals, cost = [], [], float(np.sum((change / self.problem.parameters.size) ** 2))
        for stretch, motion in zip(self.problem.stretches, motions, strict=False):
            if motion is None or cost >= limit:
                return None
            judged.append(motion)
            residuals.append(missed(stretch, motion))
            cost += float(np.sum((residuals[-1] / self.expected) ** 2))
        return _Iterate(numbers, change, judged, residuals, cost) if cost < limit else None

    def normal_equations(self, iterate: _Iterate) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (p, p) and right-hand side (p,) of the linear step."""
        basis, size = self.problem.parameters.basis, self.problem.parameters.size
        matrix, side = np.diag(1 / size**2), -iterate.change / size**2
        lines = self.problem.linearised(iterate.numbers, iterate.motions)
        for line, residual in zip(lines, iterate.residuals, strict=True):
            of_servos = line.number_columns(self.problem.simulator, iterate.numbers.servos)
            columns = _columns(line, of_servos, iterate.numbers.load, basis)
            rows = (columns / self.expected[None, :, None]).reshape(-1, len(size))
            matrix += rows.T @ rows
            side += rows.T @ (residual / self.expected).ravel()
        return matrix, side

    def lower(self, iterate: _Iterate, weight: float) -> tuple[_Iterate | None, float]:
        """The next iterate, and how much to damp its step.

        None where no step that promises enough is lower. The damping follows what a step gains of what it promises
        (as in Nielsen, Damping parameter in Marquardt's method, 1999).
        """
        problem, basis, (matrix, side) = self.problem, self.problem.parameters.basis, self.normal_equations(iterate)
        for number in range(1, _TRIES + 1):
            step = _bounded_step(matrix, side, weight, basis, iterate.numbers.at_zero)
            promised = float(step @ (2 * side - matrix @ step))
            if promised < _GAINED * iterate.cost:
                break
            numbers = MovedNumbers.of_vector(iterate.numbers.vector + basis @ step).possible(problem.reference.reach)
            trial = self.at(numbers, iterate.change + step, problem.run(numbers), iterate.cost)
            if trial is not None:
                surplus = 2 * (iterate.cost - trial.cost) / promised - 1
                return trial, weight * max(0.5, 1 - surplus * surplus * surplus)
            weight *= 2.0**number
        return None, weight


def fit_output_error(
    problem: OutputErrorProblem,
    start: ServoNumbers,
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
    simulator, stretches, parameters = problem.simulator, problem.stretches, problem.parameters
    cut = stretches[0].nearest if stretches[0].nearest < np.inf else 0.0
    numbers = MovedNumbers(start, cut, np.zeros(_LOAD) if load is None else load[:_LOAD])
    motions = [motion for motion in problem.run(numbers) if motion is not None]
    if len(motions) < len(stretches):
        raise InputError(f"{simulator.arm.path}: the simulator blows up under the recorded command as the file is")
    sigma = np.hypot(position_step(stretches) * np.sqrt(UNIFORM), LIMITS.least_error * usual_twist(motions, start.kp))
    from_file = numbers.vector - MovedNumbers(simulator.numbers, cut, np.zeros(_LOAD)).vector
    change = np.linalg.lstsq(parameters.basis, from_file, rcond=None)[0]
    descent = _LevenbergMarquardt(problem, np.hypot(sigma, errors))
    iterate, weight = descent.at(numbers, change, motions), _DAMPING
    assert iterate is not None
    for number in range(_ROUNDS):
        lower, weight = descent.lower(iterate, weight)
        if lower is None:
            break
        drop, iterate = 1 - lower.cost / iterate.cost, lower
        progress(f"output error, round {number + 1}")
        if drop < gained:
            break
    numbers, load = iterate.numbers, iterate.numbers.load
    lines, carried = tuple(problem.linearised(numbers, iterate.motions)), load_shape(load) @ load
    of_file, residuals = (simulator, problem.reference, parameters), tuple(iterate.residuals)
    return OutputErrorFit(*of_file, numbers.servos, problem.cut(numbers), lines, residuals, sigma, carried)


def _columns(line: LinearisedMotion, of_numbers: np.ndarray, load: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """(S', n, p) change of the judged positions with each free number."""
    columns = of_numbers @ basis[:-_LOAD]
    if basis[-_LOAD:].any():
        columns += line.load_columns(load_shape(load)) @ basis[-_LOAD:]
    return np.asarray(columns)


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


def missed(stretch: CommandedStretch, motion: FreeMotion) -> np.ndarray:
    """(S', n) what a motion misses of the judged positions."""
    return stretch.position[stretch.judged] - motion.at(stretch.time[stretch.judged])


def _bounded_step(
    matrix: np.ndarray, side: np.ndarray, weight: float, basis: np.ndarray, at_zero: np.ndarray
) -> np.ndarray:
    """The damped step; numbers and a mass that are zero and would fall stay there."""
    free = np.ones(len(matrix), dtype=bool)
    for _ in range(len(matrix)):
        moving = np.flatnonzero(free)
        damped = matrix[np.ix_(moving, moving)]
        unit = 1 / np.sqrt(np.diag(damped))
        damped = damped * np.outer(unit, unit) + weight * np.eye(len(moving))
        step = np.zeros(len(matrix))
        step[moving] = unit * np.linalg.solve(damped, unit * side[moving])
        stopped = np.any(basis[at_zero & (basis @ step < 0)] != 0, axis=0) & free
        if not stopped.any():
            break
        free &= ~stopped
    return step
