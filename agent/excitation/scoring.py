"""Scores of many candidates, by any task engine."""

from __future__ import annotations

import hashlib
import pickle
import threading

import numpy as np

from agent.core import TaskEngine, one_blas_thread
from agent.excitation.candidates import Candidates, LoopProblem
from agent.excitation.genetic import LoopScore

#: Candidates in one task, at most: enough to share work, few enough that a generation feeds many workers.
_TOGETHER = 7
#: What this thread built last, and for which problem: `key`, `candidates`.
_built = threading.local()


class PopulationScorer:
    """Scores a population of genomes in the tasks of an engine."""

    def __init__(self, problem: LoopProblem, engine: TaskEngine):
        self._engine, self._scorer = engine, Scorer(problem)

    def scores(self, genomes: np.ndarray) -> list[LoopScore]:
        """Scores of genomes (N, genes), in their order."""
        together = np.array_split(genomes, -(-len(genomes) // _TOGETHER))
        scores: dict[int, list[LoopScore]] = {}
        for done in self._engine.map(self._scorer, together):
            if done.answer is None:
                raise RuntimeError(f"the search: {done.lost}")
            scores[done.number] = done.answer
        return [score for number in range(len(together)) for score in scores[number]]


class Scorer:
    """Scores genomes (N, genes), in any thread of any process; each builds robot, interpolator and criterion once."""

    def __init__(self, problem: LoopProblem):
        self._problem = problem
        self._key = hashlib.sha256(pickle.dumps(problem)).digest()

    def __call__(self, genomes: np.ndarray) -> list[LoopScore]:
        """Their scores, in their order."""
        if getattr(_built, "key", None) != self._key:
            _built.candidates = Candidates(self._problem)
            _built.key = self._key
        with one_blas_thread():
            return _built.candidates.scores(genomes)
