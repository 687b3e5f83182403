"""Searches to compare the project's own with. All take what `agent.excitation` gives a search method.

A search here sees candidates one generation at a time and notes all of them; who asks takes the best of what was noted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.excitation import LoopScore, ranking

Evaluate = Callable[[np.ndarray], Sequence[LoopScore]]
Note = Callable[[np.ndarray, Sequence[LoopScore]], None]
#: Candidates of one climb of the multi-start search.
CLIMB = 500


def cma_es(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """The (μ/μ_w, λ)-CMA-ES from the middle of the unit cube.

    Formulas and default constants of Hansen's tutorial (arXiv:1604.00772). Candidates outside the unit cube are moved
    to its surface before they are evaluated.
    """
    parents = population // 2
    weights = np.log(parents + 0.5) - np.log(np.arange(1, parents + 1))
    weights /= weights.sum()
    effective = 1 / np.sum(weights**2)
    c_sigma = (effective + 2) / (genes + effective + 5)
    d_sigma = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (genes + 1)) - 1) + c_sigma
    c_c = (4 + effective / genes) / (genes + 4 + 2 * effective / genes)
    c_1 = 2 / ((genes + 1.3) ** 2 + effective)
    c_mu = min(1 - c_1, 2 * (effective - 2 + 1 / effective) / ((genes + 2) ** 2 + effective))
    expected = np.sqrt(genes) * (1 - 1 / (4 * genes) + 1 / (21 * genes**2))

    mean, sigma, covariance = np.full(genes, 0.5), 0.3, np.eye(genes)
    path_sigma, path_c = np.zeros(genes), np.zeros(genes)
    for generation in range(generations):
        values, axes = np.linalg.eigh(covariance)
        lengths = np.sqrt(np.maximum(values, 1e-20))
        genomes = mean + sigma * (rng.standard_normal((population, genes)) * lengths) @ axes.T
        genomes = np.clip(genomes, 0.0, 1.0)
        scores = list(evaluate(genomes))
        note(genomes, scores)
        steps = (genomes[ranking(scores)[:parents]] - mean) / sigma
        step = weights @ steps
        mean = mean + sigma * step
        path_sigma = (1 - c_sigma) * path_sigma + np.sqrt(c_sigma * (2 - c_sigma) * effective) * (
            axes @ ((axes.T @ step) / lengths)
        )
        length = np.linalg.norm(path_sigma) / np.sqrt(1 - (1 - c_sigma) ** (2 * (generation + 1)))
        going = float(length < (1.4 + 2 / (genes + 1)) * expected)
        path_c = (1 - c_c) * path_c + going * np.sqrt(c_c * (2 - c_c) * effective) * step
        covariance = (
            (1 - c_1 - c_mu + c_1 * (1 - going) * c_c * (2 - c_c)) * covariance
            + c_1 * np.outer(path_c, path_c)
            + c_mu * (weights * steps.T) @ steps
        )
        sigma *= np.exp(c_sigma / d_sigma * (np.linalg.norm(path_sigma) / expected - 1))


def differential_evolution(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """DE/rand/1/bin of Storn and Price (1997) with dither: F from [0.5, 1) a generation, CR 0.7, as SciPy's defaults.

    Written here because SciPy's own knows no ranking by feasibility. Genes outside the cube are drawn anew.
    """
    genomes = rng.random((population, genes))
    scores = list(evaluate(genomes))
    note(genomes, scores)
    for _ in range(1, generations):
        factor = rng.uniform(0.5, 1.0)
        picked = np.array(
            [rng.choice(np.delete(np.arange(population), k), 3, replace=False) for k in range(population)]
        )
        first, second, third = (genomes[picked[:, k]] for k in range(3))
        mutants = first + factor * (second - third)
        mutants = np.where((mutants < 0) | (mutants > 1), rng.random(mutants.shape), mutants)
        crossed = rng.random(mutants.shape) < 0.7
        crossed[np.arange(population), rng.integers(genes, size=population)] = True
        trials = np.where(crossed, mutants, genomes)
        tried = list(evaluate(trials))
        note(trials, tried)
        for k, score in enumerate(tried):
            if ranking([score, scores[k]])[0] == 0:
                genomes[k], scores[k] = trials[k], score


def multi_start(
    evaluate: Evaluate, genes: int, population: int, generations: int, rng: np.random.Generator, note: Note
) -> None:
    """Climbs of `CLIMB` candidates each, each from the best of `population` random ones, by steps of one normal
    deviate a gene whose size follows the one-fifth rule (Rechenberg)."""
    left = population * generations
    while left > 0:
        genomes = rng.random((min(population, left), genes))
        scores = list(evaluate(genomes))
        note(genomes, scores)
        left -= len(genomes)
        best = int(ranking(scores)[0])
        here, worth, step = genomes[best], scores[best], 0.2
        for _ in range(min(CLIMB - population, left)):
            there = here + step * rng.standard_normal(genes)
            there = np.abs(there - 2.0 * np.round(there / 2.0))[None]
            score = evaluate(there)[0]
            note(there, [score])
            left -= 1
            if ranking([score, worth])[0] == 0:
                here, worth, step = there[0], score, step * np.exp(1 / 3)
            else:
                step *= np.exp(-1 / 12)
