"""The paper's genetic algorithm: elitism, recombination, mutation (operators: docs/decisions/genetic-operators.md)."""

from __future__ import annotations

import numpy as np

from agent.excitation.scoring import Evaluate, Note, ranking

#: Candidates that pass into the next generation as they are.
ELITE = 1
#: Candidates that are drawn for each parent; the best of them becomes it.
TOURNAMENT = 5
#: Chance that two parents are recombined; else the child is the first one, mutated.
RECOMBINATION = 0.9
#: How far a recombined gene may lie outside its parents' interval, in parts of that interval (BLX-alpha).
EXTENSION = 0.5
#: Mean number of mutated genes of a child.
MUTATIONS = 2.0
#: Standard deviation of a mutation in the first generation and in the last.
MUTATION_STEP = (0.25, 0.05)


def genetic(
    evaluate: Evaluate,
    genes: int,
    population: int,
    generations: int,
    rng: np.random.Generator,
    note: Note,
) -> None:
    """Run the search."""
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
