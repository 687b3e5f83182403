import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.excitation import LoopScore, ranking
from agent.excitation.genetic import ELITE, genetic, infeasible, offspring, random_search

GENES = 12


def bowl(genomes: np.ndarray) -> list[LoopScore]:
    """Best at 0.3 everywhere; forbidden where the first gene is above one half, by how much it is."""
    scores = []
    for genome in genomes:
        beyond = float(genome[0] - 0.5)
        scores.append(
            infeasible(beyond, "first gene") if beyond > 0 else LoopScore(-float(np.sum((genome - 0.3) ** 2)))
        )
    return scores


def run(method: Callable[..., None], seed: int, population: int = 30, generations: int = 25) -> list[tuple]:
    noted: list[tuple[np.ndarray, Sequence[LoopScore]]] = []
    rng = np.random.default_rng(seed)
    method(bowl, GENES, population, generations, rng, lambda genomes, scores: noted.append((genomes.copy(), scores)))
    return noted


def best_of(noted: list[tuple]) -> np.ndarray:
    return np.array([max(score.fitness for score in scores) for _, scores in noted])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_the_best_never_gets_worse(seed: int) -> None:
    noted = run(genetic, seed)
    assert (np.diff(best_of(noted)) >= 0).all()
    assert [genomes.shape for genomes, _ in noted] == [(30, GENES)] * 25


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None)
def test_the_elite_survives_unchanged(seed: int) -> None:
    noted = run(genetic, seed, generations=6)
    for (before, scores), (after, _) in itertools.pairwise(noted):
        np.testing.assert_array_equal(after[:ELITE], before[ranking(scores)[:ELITE]])


@pytest.mark.parametrize("method", [genetic, random_search])
def test_a_seed_gives_bit_identical_results(method: Callable[..., None]) -> None:
    first, again, other = run(method, 5), run(method, 5), run(method, 6)
    assert all((a[0] == b[0]).all() for a, b in zip(first, again, strict=True))
    assert not (first[-1][0] == other[-1][0]).all()


def test_finds_a_better_optimum_than_random_search() -> None:
    for seed in range(5):
        assert best_of(run(genetic, seed))[-1] > best_of(run(random_search, seed)).max() + 0.05


@given(st.integers(0, 2**32 - 1), st.integers(2, 40), st.floats(0.0, 3.0))
@settings(max_examples=60)
def test_children_stay_in_the_ranges(seed: int, size: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    parents = rng.random((size, GENES)).round()  # all at the edges
    children = offspring(parents, 50, step, rng)
    assert children.shape == (50, GENES)
    assert ((children >= 0) & (children <= 1)).all()


SCORES = st.lists(
    st.one_of(
        st.builds(LoopScore, st.floats(-1e3, 1e3)),
        st.just(LoopScore(-np.inf)),
        st.builds(infeasible, st.floats(1e-9, 1e3), st.just("")),
        st.just(infeasible(np.nan, "")),
    ),
    min_size=1,
    max_size=30,
)


@given(SCORES)
def test_infeasible_candidates_rank_below_feasible_ones(scores: list[LoopScore]) -> None:
    ranked = [scores[k] for k in ranking(scores)]
    feasible = [score.feasible for score in ranked]
    assert feasible == sorted(feasible, reverse=True)
    kept = [score.fitness for score in ranked if score.feasible]
    broken = [score.excess for score in ranked if not score.feasible]
    assert kept == sorted(kept, reverse=True)
    assert broken == sorted(broken)
