import time
from collections.abc import Callable

import numpy as np
import pytest

from agent.core import one_blas_thread
from agent.excitation import Candidates, LoopProblem, search


@pytest.mark.verify
def test_the_genetic_search_beats_random_search_at_equal_budget(
    problem: LoopProblem, measured: Callable[..., None]
) -> None:
    for seed in (1, 2, 3):
        found = {method: search(problem, method, seed=seed).fitness for method in ("genetic", "random")}
        gain = found["genetic"] - found["random"]
        measured(
            f"search, seed {seed}: genetic {found['genetic']:.2f}, random {found['random']:.2f}, 2000 candidates each",
            round(gain, 2),
            "log10 det(HᵀH/M)",
            "at least 5",
            gain >= 5.0,
        )
        assert gain >= 5.0


@pytest.mark.verify
def test_cpu_of_a_candidate(problem: LoopProblem, measured: Callable[..., None]) -> None:
    candidates = Candidates(problem)
    genomes = np.random.default_rng(0).random((100, problem.genes))
    with one_blas_thread():
        candidates.score(genomes[0])
        start = time.process_time()
        scores = [candidates.score(genome) for genome in genomes]
        milliseconds = 1e3 * (time.process_time() - start) / len(genomes)
    assert all(score.feasible for score in scores)
    measured("one candidate, genome to fitness", round(milliseconds, 1), "ms of a core", "25", milliseconds <= 25.0)
    assert milliseconds <= 25.0
