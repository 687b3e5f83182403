"""Few data: fits to a fifth of one excitation loop, judged by motions in the whole sub-region.

    python benchmarks/few_data.py [MACHINES] [--workers N | --scheduler ADDRESS]

On the emulated COMAU NS16; about three minutes of one core a machine. A loop of six points is searched
for (small search) and recorded once at 1 m/s. Its first pass is cut into five segments of equal length, each with what
the filter's edges take (0.25 s on either side), and each is fitted alone: nothing of the other four fifths is known.
Three fits of the same columns: the paper's weighted least squares with nothing else, the same with the prior, and the
physically consistent one. Ten unseen motions at 0.1 m/s judge: RMSE over nominal torque, mean of joints.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import local_vs_global  # noqa: E402  beside this file
import workers  # noqa: E402  beside this file

from agent.estimation import FilterSettings  # noqa: E402
from agent.estimation.blocks import partition  # noqa: E402
from agent.estimation.consistent import consistent  # noqa: E402
from agent.estimation.filtering import Motion, motions  # noqa: E402
from agent.estimation.friction_selection import select_friction_terms  # noqa: E402
from agent.estimation.least_squares import weighted  # noqa: E402
from agent.estimation.observation import observe  # noqa: E402
from agent.estimation.problem import Estimate, Problem  # noqa: E402
from agent.estimation.summary import build_model  # noqa: E402
from agent.excitation import Criterion  # noqa: E402
from agent.excitation.criterion import one_blas_thread  # noqa: E402
from agent.excitation.genetic import genetic  # noqa: E402
from agent.model.identified import IdentifiedModel  # noqa: E402
from agent.recipe import load_recipe  # noqa: E402
from agent.recording import Log  # noqa: E402
from agent.robot.bodies import rigid_bodies  # noqa: E402
from fake_controller.plant import Plant  # noqa: E402

EDGE = 0.25
VALIDATIONS = 10
_NO_PRIOR = 1e-7  # of its usual prior_weight: enough for round-off, nothing else


def plain(problem: Problem) -> Estimate:
    """The paper's weighted least squares alone."""
    return weighted(replace(problem, prior_weight=_NO_PRIOR))


FITS: dict[str, Callable[[Problem], Estimate]] = {
    "weighted, no prior (the paper's)": plain,
    "weighted": weighted,
    "consistent": consistent,
}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("machines", type=int, nargs="?", default=3)
    workers.add_options(parser)
    arguments = parser.parse_args()
    seeds = range(1, arguments.machines + 1)
    print("| machine | fit | mean of five | each fifth | whole loop |\n| --- | --- | --- | --- | --- |")
    for seed, found in zip(seeds, workers.worked(errors, seeds, arguments), strict=True):
        for name, (fifths, whole) in found.items():
            each = " ".join(f"{value:.2f}" for value in fifths)
            print(f"| {seed} | {name} | {np.mean(fifths):.2f} | {each} | {whole:.2f} |", flush=True)


def errors(seed: int) -> dict[str, tuple[list[float], float]]:
    """By fit: error [% of nominal] of each fifth, and of the whole loop, on one machine."""
    recipe = load_recipe(ROOT / "recipes/ns16_quickstart.yaml")
    robot = recipe.robot
    loops = local_vs_global.LocalLoops
    local_vs_global.POPULATION, local_vs_global.GENERATIONS = 20, 8
    with one_blas_thread():
        fast = loops(local_vs_global.loop_problem(recipe, recipe.motion.speed), Criterion(robot))
        slow = loops(local_vs_global.loop_problem(recipe, recipe.validate.speed), Criterion(robot))
        loop, _ = local_vs_global.find(fast, genetic, seed)
        plant = Plant(robot, seed)
        unseen = [
            motion
            for log in local_vs_global.random_logs(plant, slow, VALIDATIONS)
            for motion in motions(log, FilterSettings(30.0))
        ]
        log = local_vs_global.record(plant, [loop.trajectory], np.inf)
        results = [fitted(part, unseen) for part in (*fifths_of(log), log)]
    return {name: ([result[name] for result in results[:-1]], results[-1][name]) for name in FITS}


def fifths_of(log: Log) -> Iterator[Log]:
    """The five segments."""
    length, edge = len(log.t) // 5, round(EDGE * log.sample_rate)
    for k in range(5):
        first = min(max(k * length - edge, 0), len(log.t) - length - 2 * edge)
        part = slice(first, first + length + 2 * edge)
        yield replace(
            log,
            t=log.t[part] - log.t[first],
            position=log.position[part],
            velocity=None,
            effort=log.effort[part],
            reference_position=None,
            segments=((0, part.stop - part.start),),
            cycle_starts=(),
        )


def fitted(log: Log, unseen: list[Motion]) -> dict[str, float]:
    """Error of every fit to one log."""
    robot = local_vs_global.load_recipe(ROOT / "recipes/ns16_quickstart.yaml").robot
    rigid, names, combinations = rigid_bodies(robot)
    observation = observe(rigid, [log], FilterSettings(30.0))
    problem = select_friction_terms(observation, partition(observation.segments)).with_own_prior_weight()
    return {
        name: error(build_model(problem, fit(problem), name, names, combinations, [log]), unseen)
        for name, fit in FITS.items()
    }


def error(model: IdentifiedModel, unseen: list[Motion]) -> float:
    """RMSE over nominal torque [%], mean of joints."""
    left = [motion.low_pass(motion.torque - model.predict(motion.q, motion.qd, motion.qdd)) for motion in unseen]
    return float(100 * np.mean(np.sqrt(np.mean(np.concatenate(left) ** 2, axis=0)) / model.robot.nominal_torque))


if __name__ == "__main__":
    main()
