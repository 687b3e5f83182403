"""The (μ/μ_w, λ)-CMA-ES, for comparison with the project's own search.

Formulas and default constants of Hansen's tutorial (arXiv:1604.00772). Candidates outside the unit cube are moved to
its surface before they are evaluated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.excitation import LoopScore, ranking


def cma_es(
    evaluate: Callable[[np.ndarray], Sequence[LoopScore]],
    genes: int,
    population: int,
    generations: int,
    rng: np.random.Generator,
    note: Callable[[np.ndarray, Sequence[LoopScore]], None],
) -> None:
    """Run the search from the middle of the unit cube; arguments as `agent.excitation.genetic.genetic` has them."""
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
