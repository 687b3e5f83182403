"""Candidates drawn evenly from the sub-region: what a search has to beat at an equal number of candidates."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.excitation.scoring import LoopScore


def random_search(
    evaluate: Callable[[np.ndarray], Sequence[LoopScore]],
    genes: int,
    population: int,
    generations: int,
    rng: np.random.Generator,
    note: Callable[[np.ndarray, Sequence[LoopScore]], None],
) -> None:
    """Run the search; `note` is told of each generation: its genomes (N, genes) in [0, 1] and their scores."""
    for _ in range(generations):
        genomes = rng.random((population, genes))
        note(genomes, evaluate(genomes))
