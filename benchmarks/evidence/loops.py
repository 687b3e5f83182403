"""Loops: the criteria, kinds of motion, and the best loop that a search finds for each, found once and kept."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.excitation import Candidates, Criterion, Loop, LoopProblem, LoopScore, ranking
from agent.excitation.criterion import log_determinant
from agent.excitation.genetic import genetic
from agent.motion import JointTarget, MotionError, Move, MoveType, Trajectory, create_interpolator
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe
from agent.robot import KinematicsError, RobotDescription
from benchmarks.evidence.results import Results

#: Seeds of the machines start here: none that was looked at while the agent was made.
FIRST_MACHINE = 501
#: Number of searches. A loop depends on no machine (except for learned noise), so machines take them in turn.
SEARCHES = 3
_FINALISTS = 10
_TOGETHER = 7  # candidates worked out together
_DRAWS = 400


class WeightedCriterion(Criterion):
    """log10 det(HᵀH/M) with the rows of joint i multiplied by `weights` (n,), of which only the ratios count."""

    def __init__(self, robot: RobotDescription, weights: np.ndarray):
        super().__init__(robot)
        self.weights = weights / np.max(weights)

    def __call__(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, regressor: np.ndarray | None = None) -> float:
        return log_determinant(self.observation_matrix(q, qd, qdd), len(q))


class ScaledCriterion(Criterion):
    """Criteria that depend on the parameters' units: `kind` of H with scaled columns, rows weighted as usual.

    "A": minus log10 of the trace of (HᵀH/M)⁻¹; "E": log10 of the smallest eigenvalue of HᵀH/M; "condition": minus log10
    of the condition number. A column's unit is its root mean square over random states of the arm, at half its largest
    speeds and accelerations.
    """

    def __init__(self, robot: RobotDescription, kind: str):
        super().__init__(robot)
        self._kind = kind
        rng = np.random.default_rng(0)
        shape = (500, robot.dof)
        q = rng.uniform(-np.pi / 2, np.pi / 2, shape)
        qd = rng.uniform(-0.5, 0.5, shape) * robot.max_velocity
        qdd = rng.uniform(-0.5, 0.5, shape) * robot.max_acceleration
        matrix = self.observation_matrix(q, qd, qdd)
        self._scale = np.linalg.norm(matrix, axis=0) / np.sqrt(shape[0])

    def __call__(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, regressor: np.ndarray | None = None) -> float:
        matrix = self.observation_matrix(q, qd, qdd) / self._scale
        if not np.isfinite(log_determinant(matrix, len(q))):
            return -np.inf
        values = np.linalg.svd(np.linalg.qr(matrix, mode="r"), compute_uv=False) / np.sqrt(len(q))
        if self._kind == "A":
            return float(-np.log10(np.sum(values**-2.0)))
        if self._kind == "E":
            return float(2 * np.log10(values[-1]))
        return float(np.log10(values[-1] / values[0]))


class LocalLoops(Candidates):
    """Loops in the sub-region under a criterion of one's own."""

    def __init__(self, problem: LoopProblem, criterion: Criterion | None = None):
        super().__init__(problem)
        self._criterion = criterion or self._criterion


#: A loop, or the limit that it breaks.
Planned = Loop | MotionError | KinematicsError


class StoppingLoops(LocalLoops):
    """The same via-points, but the arm stops at each instead of flying by."""

    def loops(self, genomes: np.ndarray) -> list[Planned]:
        return [loop if isinstance(loop, InputError) else self._stopping(loop) for loop in super().loops(genomes)]

    def _stopping(self, flown: Loop) -> Planned:
        settings = self.problem.settings.stopping()
        moves = tuple(replace(move, fly=False, settings=settings) for move in flown.moves)
        return _planned(self._interpolator.plan, flown.genome, flown.poses, flown.joints, moves)


class GlobalLoops(LocalLoops):
    """Loops over the whole workspace: MOVEFLY JOINT between points anywhere in the joint ranges (one turn at most), at
    `override` of the joints' speeds."""

    def __init__(self, problem: LoopProblem, override: float):
        super().__init__(problem)
        self._override = override
        lower, upper = (np.array(limits) for limits in problem.robot.position_limits)
        middle, half = (lower + upper) / 2, np.minimum((upper - lower) / 2, np.pi)
        self._lower, self._range = middle - 0.95 * half, 1.9 * half
        self._plan = create_interpolator(problem.interpolator, problem.robot, problem.tool, period=problem.period).plan

    def loops(self, genomes: np.ndarray) -> list[Planned]:
        return [self._anywhere(genome) for genome in genomes]

    def _anywhere(self, genome: np.ndarray) -> Planned:
        points = self._lower + self._range * genome.reshape(-1, self.problem.robot.dof)
        settings = self.problem.settings.changed(speed_override=self._override)
        closing = settings.stopping()
        moves = tuple(
            [Move(MoveType.JOINT, JointTarget(point), settings, fly=True) for point in points[1:]]
            + [Move(MoveType.JOINT, JointTarget(points[0]), closing)]
        )
        return _planned(self._plan, genome, self.kinematics.forward(points), points, moves)


def _planned(plan: Callable, genome: np.ndarray, poses: np.ndarray, joints: np.ndarray, moves: tuple) -> Planned:
    try:
        return Loop(genome, poses, joints, moves, plan(moves, joints[0]))
    except (MotionError, KinematicsError) as error:
        return error


def best_loop(candidates: Candidates, method: Callable, population: int, generations: int, seed: int) -> dict:
    """Genome and fitness, on all samples, of the best candidate of a search that keeps all limits there.

    Raises:
        RuntimeError: there is none.
    """
    seen: list[tuple[np.ndarray, LoopScore]] = []

    def evaluate(genomes: np.ndarray) -> list[LoopScore]:
        parts = (genomes[first : first + _TOGETHER] for first in range(0, len(genomes), _TOGETHER))
        scores = [score for part in parts for score in candidates.scores(part)]
        seen.extend(zip(genomes.copy(), scores, strict=True))
        return scores

    rng = np.random.default_rng(seed)
    method(evaluate, candidates.problem.genes, population, generations, rng, lambda genomes, scores: None)
    found = None
    for rank, k in enumerate(ranking([score for _, score in seen])):
        if found is not None and rank >= _FINALISTS:
            break
        final = candidates.score_on_all(seen[k][0])
        better = found is None or final.fitness > found["fitness"]
        if final.feasible and np.isfinite(final.fitness) and better:
            found = {"genome": seen[k][0].tolist(), "fitness": final.fitness, "candidates": len(seen)}
    if found is None:
        raise RuntimeError(f"none of {len(seen)} loops keeps all limits")
    return found


def found_loop(recipe: Recipe, machine: int, setting: str, candidates: Candidates, kept: Results) -> Trajectory:
    """The set-points of the best loop for a setting, by a genetic search of the recipe's size unless `kept` has it."""
    seed = FIRST_MACHINE + (machine - FIRST_MACHINE) % SEARCHES
    found = kept.get(seed, setting)
    if found is None:
        started = time.process_time()
        found = best_loop(candidates, genetic, recipe.search.population, recipe.search.generations, seed)
        kept.keep(seed, setting, found, time.process_time() - started)
    return candidates.loop(np.array(found["genome"])).trajectory


def unseen_motions(recipe: Recipe, machine: int) -> list[Trajectory]:
    """Test motions of a machine's models: random motions in the sub-region, in number and speed as in the recipe."""
    slow = LocalLoops(loop_problem(recipe, recipe.validate.speed))
    return random_loops(slow, recipe.validate.motions, np.random.default_rng([machine, 21]))


def random_loops(candidates: Candidates, count: int, rng: np.random.Generator) -> list[Trajectory]:
    """Set-points of random loops that keep all limits.

    Raises:
        RuntimeError: hardly any does.
    """
    loops: list[Trajectory] = []
    for _ in range(_DRAWS):
        genome = rng.uniform(size=candidates.problem.genes)
        if candidates.score(genome).feasible:
            loops.append(candidates.loop(genome).trajectory)
        if len(loops) == count:
            return loops
    raise RuntimeError(f"of {_DRAWS} random loops only {len(loops)} keep all limits")
