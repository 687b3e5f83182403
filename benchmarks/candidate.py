"""CPU time of one candidate of the search, from genome to fitness, and of its parts.

    python benchmarks/candidate.py [RECIPE]

Takes one core; times are process times per candidate over random loops of the recipe's sub-region that keep all limits.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

CANDIDATES = 100


def main() -> None:
    """Print the table."""
    from agent.excitation import Candidates, Criterion, log_determinant
    from agent.excitation.criterion import one_blas_thread
    from agent.pipeline.planning import loop_problem
    from agent.recipe import load_recipe

    recipe = load_recipe(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "recipes/ns16_quickstart.yaml")
    candidates = Candidates(loop_problem(recipe, recipe.motion.speed))
    rng = np.random.default_rng(0)
    with one_blas_thread():
        drawn = [rng.random(candidates.problem.genes) for _ in range(CANDIDATES)]
        genomes = [genome for genome in drawn if candidates.score(genome).feasible]
        loops = [candidates.loop(genome) for genome in genomes]
        tenths = [(t.q[::10], t.qd[::10], t.qdd[::10]) for t in (loop.trajectory for loop in loops)]
        criterion = Criterion(recipe.robot, recipe.tool)
        matrices = [criterion.observation_matrix(*tenth) for tenth in tenths]
        rows = {
            "genome to fitness": cpu(candidates.score, genomes),
            "  interpolation, all samples": cpu(candidates.loop, genomes),
            "  regressor, every tenth sample": cpu(lambda tenth: criterion.observation_matrix(*tenth), tenths),
            "  determinant": cpu(lambda matrix: log_determinant(matrix, len(matrix)), matrices),
        }
    motion = np.mean([loop.trajectory.duration for loop in loops])
    samples = np.mean([len(loop.trajectory.t) for loop in loops])
    print(f"{len(genomes)} of {CANDIDATES} random loops of {recipe.path.name} keep all limits")
    print(f"{motion:.1f} s of motion, {samples:.0f} samples, {len(criterion.columns)} parameters")
    for name, milliseconds in rows.items():
        print(f"{name:34} {milliseconds:7.2f} ms")


def cpu(function: Callable, arguments: list) -> float:
    """Mean process time [ms] of a call, after one call of each to warm up."""
    function(arguments[0])
    start = time.process_time()
    for argument in arguments:
        function(argument)
    return 1e3 * (time.process_time() - start) / len(arguments)


if __name__ == "__main__":
    main()
