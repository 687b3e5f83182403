"""What a candidate is worth, and how candidates are ranked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LoopScore:
    """`fitness` of a candidate; `excess` > 0 says how far it breaks a limit (0: it breaks none), `reason` which."""

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
    """(N,) indices, best first: all that break no limit by fitness, then the others by how far they break one.

    Equal candidates stay in the order in which they came.
    """
    fitness = np.array([score.fitness for score in scores])
    excess = np.array([score.excess for score in scores])
    return np.lexsort((-fitness, excess))
