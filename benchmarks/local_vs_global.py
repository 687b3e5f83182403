"""Local against global calibration, criteria against each other, and the genetic search against others.

    python benchmarks/local_vs_global.py [MACHINES] [--workers N | --scheduler ADDRESS] > docs/local-vs-global.md

Everything happens on the emulated COMAU NS16: about five minutes of one core a machine. Each of the
emulated machines (bodies, rotors and friction drawn around the nominal ones) is calibrated from as many seconds of
motion in each way and judged by the same motions in the sub-region that no fit saw.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import workers  # noqa: E402  beside this file
from cma_es import cma_es  # noqa: E402  beside this file

from agent.estimation import EstimationSettings, estimate  # noqa: E402
from agent.excitation import Candidates, Criterion, Loop, LoopProblem  # noqa: E402
from agent.excitation.criterion import log_determinant, one_blas_thread  # noqa: E402
from agent.excitation.genetic import genetic  # noqa: E402
from agent.excitation.loop_search import random_search  # noqa: E402
from agent.excitation.scoring import LoopScore, ranking  # noqa: E402
from agent.model import IdentifiedModel  # noqa: E402
from agent.motion import create_interpolator  # noqa: E402
from agent.motion.program import JointTarget, Move, MoveType, Termination  # noqa: E402
from agent.pipeline.planning import loop_problem  # noqa: E402
from agent.recipe import Recipe, load_recipe  # noqa: E402
from agent.recording import Log  # noqa: E402
from agent.robot import RobotDescription  # noqa: E402
from agent.validation import predict_log, summary  # noqa: E402
from fake_controller.plant import Plant  # noqa: E402

POPULATION, GENERATIONS = 30, 15
SECONDS = 60.0
VALIDATIONS, FAR_MOTIONS = 30, 5
SEARCHES = {"genetic": genetic, "random": random_search, "CMA-ES": cma_es}


class DOptimality(Criterion):
    """log10 det(HᵀH/M) with every joint's rows as they are."""

    def __init__(self, robot: RobotDescription):
        super().__init__(robot)
        self.weights = np.ones(robot.dof)


class ConditionNumber(DOptimality):
    """Minus log10 of the condition number of H."""

    def __call__(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, regressor: np.ndarray | None = None) -> float:
        matrix = self.observation_matrix(q, qd, qdd)
        if not np.isfinite(log_determinant(matrix, len(q))):
            return -np.inf
        values = np.linalg.svd(np.linalg.qr(matrix, mode="r"), compute_uv=False)
        return float(np.log10(values[-1] / values[0]))


class LocalLoops(Candidates):
    """Loops in the sub-region under a criterion of one's own."""

    def __init__(self, problem: LoopProblem, criterion: Criterion):
        super().__init__(problem)
        self._criterion = criterion


class GlobalLoops(LocalLoops):
    """Loops over the whole workspace: MOVEFLY JOINT between points anywhere in the joint ranges (one turn at most)."""

    def __init__(self, problem: LoopProblem, criterion: Criterion, override: float):
        super().__init__(problem, criterion)
        self._override = override
        lower, upper = problem.robot.position_limits
        middle, half = (lower + upper) / 2, np.minimum((upper - lower) / 2, np.pi)
        self._lower, self._range = middle - 0.95 * half, 1.9 * half
        self._plan = create_interpolator(problem.interpolator, problem.robot, problem.tool, period=problem.period).plan

    def loop(self, genome: np.ndarray) -> Loop:
        points = self._lower + self._range * genome.reshape(-1, self.problem.robot.dof)
        settings = self.problem.settings.changed(speed_override=self._override)
        closing = settings.changed(termination=Termination.FINE)
        moves = tuple(
            [Move(MoveType.JOINT, JointTarget(point), settings, fly=True) for point in points[1:]]
            + [Move(MoveType.JOINT, JointTarget(points[0]), closing)]
        )
        return Loop(genome, self.kinematics.forward(points), points[0], moves, self._plan(moves, points[0]))


def main() -> None:
    """Print the document."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", type=int, nargs="?", default=3)
    workers.add_options(parser)
    arguments = parser.parse_args()
    results = list(workers.worked(machine, range(1, arguments.machines + 1), arguments))
    print(document(results, sum(result["seconds"] for result in results)))


def machine(seed: int) -> dict:
    """All calibrations of one machine, the searches with the same seed, and the processor time of it all [s]."""
    started = time.process_time()
    with one_blas_thread():
        found = calibrate_all(load_recipe(ROOT / "recipes/ns16_quickstart.yaml"), seed)
    return {**found, "seconds": time.process_time() - started}


def calibrate_all(recipe: Recipe, seed: int) -> dict:
    """All calibrations of one machine, and the searches with the same seed."""
    robot = recipe.robot
    fast = loop_problem(recipe, recipe.motion.speed)
    local = LocalLoops(fast, Criterion(robot))
    ways = {
        "sub-region": local,
        "whole workspace, full speed": GlobalLoops(fast, Criterion(robot), 1.0),
        "whole workspace, 40 % speed": GlobalLoops(fast, Criterion(robot), 0.4),
        "plain D-optimality": LocalLoops(fast, DOptimality(robot)),
        "condition number": LocalLoops(fast, ConditionNumber(robot)),
    }
    plant = Plant(robot, seed)
    near = random_logs(plant, LocalLoops(loop_problem(recipe, recipe.validate.speed), Criterion(robot)), VALIDATIONS)
    far = random_logs(plant, ways["whole workspace, 40 % speed"], FAR_MOTIONS)
    note(f"machine {seed}: validation motions recorded")
    rows, local_fitness = {}, {}
    for name, candidates in ways.items():
        loop, fitness = find(candidates, genetic, seed)
        if candidates is local:
            local_fitness["genetic"] = fitness
        log = record(plant, [loop.trajectory] * int(np.ceil(SECONDS / loop.trajectory.duration)), SECONDS)
        for method in ("weighted", "consistent") if candidates in list(ways.values())[:3] else ("weighted",):
            model = estimate(robot, [log], EstimationSettings.create(method=method))
            rows[name, method] = (error(model, near), error(model, far))
            note(f"  {name}, {method}: {rows[name, method][0]}")
    for name in ("random", "CMA-ES"):
        local_fitness[name] = find(local, SEARCHES[name], seed)[1]
    note(f"  fitness {local_fitness}")
    return {"errors": rows, "fitness": local_fitness}


def find(candidates: Candidates, method: Callable, seed: int) -> tuple[Loop, float]:
    """The best loop a search finds that also keeps all limits on all samples, and its fitness."""
    seen: list[tuple[np.ndarray, LoopScore]] = []

    def evaluate(genomes: np.ndarray) -> list[LoopScore]:
        return [candidates.score(genome) for genome in genomes]

    def remember(genomes: np.ndarray, scores: list[LoopScore]) -> None:
        seen.extend(zip(genomes.copy(), scores, strict=True))

    rng = np.random.default_rng(seed)
    method(evaluate, candidates.problem.genes, POPULATION, GENERATIONS, rng, remember)
    for k in ranking([score for _, score in seen]):
        final = candidates.score_on_all(seen[k][0])
        if final.feasible and np.isfinite(final.fitness):
            return candidates.loop(seen[k][0]), final.fitness
    raise SystemExit("no loop keeps all limits: raise POPULATION or GENERATIONS")


def random_logs(plant: Plant, candidates: Candidates, count: int) -> list[Log]:
    """Recordings of random loops that keep all limits."""
    rng = np.random.default_rng(2)
    logs: list[Log] = []
    while len(logs) < count:
        genome = rng.uniform(size=candidates.problem.genes)
        if candidates.score(genome).feasible:
            logs.append(record(plant, [candidates.loop(genome).trajectory], np.inf))
    return logs


def record(plant: Plant, cycles: list, seconds: float) -> Log:
    """What the emulated controller measures along loops run one after the other, the first `seconds` of it."""
    period = float(cycles[0].t[1])
    reference = np.concatenate([cycle.q for cycle in cycles])
    velocity = np.concatenate([cycle.qd for cycle in cycles])
    samples = int(min(len(reference), seconds / period))
    plant.rest(reference[0])
    chunks = list(plant.run(reference[:samples], velocity[:samples]))
    lengths = np.cumsum([0, *(len(cycle.q) for cycle in cycles)])[:-1] * period
    return Log(
        path=Path("motion.mcap"),
        joint_names=plant.robot.joint_names,
        t=np.arange(samples) * period,
        position=np.concatenate([chunk.position for chunk in chunks]),
        velocity=np.concatenate([chunk.velocity for chunk in chunks]),
        effort=np.concatenate([chunk.torque for chunk in chunks]),
        reference_position=reference[:samples],
        planned_position=None,
        sample_rate=1 / period,
        stamp=0.0,
        segments=((0, samples),),
        cycle_starts=tuple(float(start) for start in lengths if start < samples * period) if len(cycles) > 1 else (),
    )


def error(model: IdentifiedModel, logs: list[Log]) -> np.ndarray:
    """(n,) normalised RMSE in percent over all samples of all logs."""
    return 100 * np.array(summary([predict_log(model, log) for log in logs]).overall.normalised_rmse)


def document(results: list[dict], seconds: float) -> str:
    """Markdown."""
    machines = len(results)
    joints = len(next(iter(results[0]["errors"].values()))[0])
    heads = " | ".join(f"J{k + 1}" for k in range(joints))

    def table(names: list[tuple[str, str, str]], which: int) -> list[str]:
        lines = [f"| calibrated by | {heads} | mean of joints | worst machine |", "| --- |" + " --- |" * (joints + 2)]
        for label, *key in names:
            errors = np.array([result["errors"][tuple(key)][which] for result in results])
            cells = " | ".join(f"{value:.2f}" for value in errors.mean(axis=0))
            means = errors.mean(axis=1)
            lines.append(f"| {label} | {cells} | {means.mean():.2f} | {means.max():.2f} |")
        return lines

    places = [
        (f"{way}, {method}", way, method)
        for way in ("sub-region", "whole workspace, full speed", "whole workspace, 40 % speed")
        for method in ("weighted", "consistent")
    ]
    criteria = [
        ("torque-normalised D-optimality", "sub-region", "weighted"),
        ("plain D-optimality", "plain D-optimality", "weighted"),
        ("condition number", "condition number", "weighted"),
    ]
    budget = POPULATION * GENERATIONS
    fitness = [
        f"| {name} | " + " | ".join(f"{result['fitness'][name]:.2f}" for result in results) + " |" for name in SEARCHES
    ]
    return "\n".join(
        [
            "# Local against global",
            "",
            f"Written by `benchmarks/local_vs_global.py` on the emulated COMAU NS16: {machines} machines of different "
            f"bodies, rotors and friction, {SECONDS:g} s of motion at 500 Hz for every calibration, one loop of six "
            "points repeated. Figures are RMSE in percent of nominal joint torque, all samples, standstill included, "
            "means over the machines. "
            f"The searches are small: {POPULATION} candidates over {GENERATIONS} generations (a recipe's default is "
            f"50 over 40). It took {seconds / 60:.0f} minutes of one core.",
            "",
            f"## In the sub-region: {VALIDATIONS} random motions at 0.1 m/s",
            "",
            "Loops in the sub-region move at 1 m/s on straight lines. Over the whole workspace the arm moves joint by "
            "joint (MOVEFLY JOINT) between points anywhere in its ranges, at full joint speed and at 40 % of it. "
            "Criterion, search, duration and estimator are the same.",
            "",
            *table(places, 0),
            "",
            f"## The same models outside it: {FAR_MOTIONS} random motions over the whole workspace at 40 % speed",
            "",
            *table(places, 1),
            "",
            "## What the loop is searched by",
            "",
            "Loops in the sub-region, found by equal searches for other criteria, weighted least squares, judged by "
            f"the {VALIDATIONS} motions in the sub-region.",
            "",
            *table(criteria, 0),
            "",
            f"## How it is searched: {budget} candidates each",
            "",
            "Fitness log10 det(HᵀH/M) of the best loop, on all samples; a search a machine's seed.",
            "",
            "| search |" + "".join(f" seed {k + 1} |" for k in range(machines)),
            "| --- |" + " --- |" * machines,
            *fitness,
        ]
    )


def note(text: str) -> None:
    """Progress."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
