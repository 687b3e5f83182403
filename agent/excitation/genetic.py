"""Search methods: the paper's genetic algorithm (docs/decisions/genetic-operators.md), and random search.

The genetic algorithm has elitism, recombination and mutation. Both rank candidates by feasibility first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

#: Candidates that enter the next generation unchanged.
ELITE = 1
#: Candidates drawn for each parent; the best of them is chosen.
TOURNAMENT = 5
#: Probability that two parents are recombined; otherwise the child is the first one, mutated.
RECOMBINATION = 0.9
#: Distance of a recombined gene outside its parents' interval, at most, as a part of that interval (BLX-alpha).
EXTENSION = 0.5
#: Mean number of mutated genes of a child.
MUTATIONS = 2.0
#: Standard deviation of a mutation in the first generation and in the last.
MUTATION_STEP = (0.25, 0.05)


@dataclass(frozen=True)
class LoopScore:
    """`fitness` of a candidate; `excess` > 0 is how far it breaks a limit (0: none), `reason` names the limit."""

    fitness: float
    excess: float = 0.0
    reason: str = ""

    @property
    def feasible(self) -> bool:
        """Whether no limit is broken."""
        return self.excess == 0.0


#: Scores of genomes (N, genes) in [0, 1]; and a callback for each generation: its genomes and their scores.
Evaluate = Callable[[np.ndarray], Sequence[LoopScore]]
Note = Callable[[np.ndarray, Sequence[LoopScore]], None]


def infeasible(excess: float, reason: str) -> LoopScore:
    """Score of a candidate that breaks a limit; an excess that is no number ranks last."""
    return LoopScore(-np.inf, excess if excess > 0 else np.inf, reason)


def ranking(scores: Sequence[LoopScore]) -> np.ndarray:
    """(N,) indices, best first: feasible candidates by fitness, then the others by how far they break a limit.

    Equal candidates keep their order.
    """
    fitness = np.array([score.fitness for score in scores])
    excess = np.array([score.excess for score in scores])
    return np.lexsort((-fitness, excess))


def genetic(
    evaluate: Evaluate,
    genes: int,
    population: int,
    generations: int,
    rng: np.random.Generator,
    note: Note,
) -> None:
    """The paper's genetic algorithm."""
    genomes = rng.random((population, genes))
    scores = list(evaluate(genomes))
    note(genomes, scores)
    for generation in range(1, generations):
        order = ranking(scores)
        elite = order[:ELITE]
        step = MUTATION_STEP[0] * (MUTATION_STEP[1] / MUTATION_STEP[0]) ** (generation / max(generations - 1, 1))
        children = offspring(genomes[order], population - len(elite), step, rng)
        scores = [*(scores[k] for k in elite), *evaluate(children)]
        genomes = np.vstack([genomes[elite], children])
        note(genomes, scores)


def random_search(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """Candidates drawn evenly from the sub-region: the baseline at an equal number of candidates."""
    for _ in range(generations):
        genomes = rng.random((population, genes))
        note(genomes, evaluate(genomes))


#: Methods by the names that a recipe uses.
METHODS = {"genetic": genetic, "random": random_search}


def offspring(ranked: np.ndarray, count: int, step: float, rng: np.random.Generator) -> np.ndarray:
    """(count, genes) children of a population (N, genes) in order of rank, best first."""
    size, genes = ranked.shape
    first, second = rng.integers(size, size=(2, count, TOURNAMENT)).min(axis=2)
    mother, father = ranked[first], ranked[second]
    along = rng.uniform(-EXTENSION, 1.0 + EXTENSION, (count, genes))
    recombined = rng.random((count, 1)) < RECOMBINATION
    children = np.where(recombined, mother + along * (father - mother), mother)
    mutated = rng.random((count, genes)) < MUTATIONS / genes
    children = children + np.where(mutated, rng.normal(0.0, step, (count, genes)), 0.0)
    return _reflected(children)


def _reflected(genes: np.ndarray) -> np.ndarray:
    """Genes beyond 0 or 1 mirrored back inside: cutting them off would crowd the edges of the ranges."""
    return np.abs(genes - 2.0 * np.round(genes / 2.0))
