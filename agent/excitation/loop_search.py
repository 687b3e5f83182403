"""The search for the loop that excites the parameters best: one front for every method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.core import InProcess, InputError, LocalProcesses, TaskEngine, available_cores, one_blas_thread
from agent.excitation.candidates import Candidates, Loop, LoopProblem
from agent.excitation.genetic import METHODS, LoopScore, ranking
from agent.excitation.scoring import PopulationScorer

#: Starting another process costs as much as scoring this many candidates.
_CANDIDATES_A_WORKER = 250
#: Best candidates that are scored again on all samples.
FINALISTS = 10


@dataclass(frozen=True)
class Generation:
    """Statistics of a generation: its number from 0, best and mean fitness of its feasible candidates (NaN if none is),
    their number, and how many candidates were evaluated so far. Fitness is on every tenth sample."""

    number: int
    best: float
    mean: float
    feasible: int
    evaluated: int


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The loop that was found, and how.

    `fitness` is log10 det(HᵀH/M) over all samples of one cycle. `finalists` (F, 2): fitness of the best candidates on
    every tenth sample and on all. `columns` names the parameters that the fitness counts.
    """

    loop: Loop
    fitness: float
    generations: tuple[Generation, ...]
    finalists: np.ndarray
    evaluated: int
    columns: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, without the set-points."""
        names = ("best", "mean", "feasible")
        return {
            "fitness": self.fitness,
            "genome": self.loop.genome.tolist(),
            "history": {name: [getattr(generation, name) for generation in self.generations] for name in names},
            "finalists": self.finalists.tolist(),
            "evaluated": self.evaluated,
            "parameters": len(self.columns),
        }


def search(
    problem: LoopProblem,
    method: str = "genetic",
    population: int = 50,
    generations: int = 40,
    seed: int = 1,
    engine: TaskEngine | None = None,
    progress: Callable[[Generation], None] | None = None,
) -> SearchResult:
    """Find a loop. The same seed gives the same loop to the bit, whichever `engine` scores the candidates (default: one
    process a core, where there is work for them).

    `progress` is called after each generation. The ten best candidates are scored again on all samples, and the best of
    them is the result.

    Args:
        problem: sub-region, robot and limits.
        method: genetic or one of the other registered searches.
        population: candidates in a generation.
        generations: of the search.
        seed: of all draws.
        engine: scores candidates; None: one process per core.
        progress: called after each generation.

    Raises:
        InputError: no such method; or no candidate keeps all limits: names the limit that the best one breaks, where
            and by how much.
    """
    if method not in METHODS:
        raise InputError(f"search method {method!r} is not known; there are: {', '.join(METHODS)}")
    history = _History(progress)
    with nullcontext(engine) if engine is not None else _processes(population * generations) as scoring:
        candidates = Candidates(problem)
        rng = np.random.default_rng(seed)
        evaluate = PopulationScorer(problem, scoring).scores
        METHODS[method](evaluate, problem.genes, population, generations, rng, history.note)
    with one_blas_thread():
        genome, fitness, finalists = _final(candidates, history)
        loop = candidates.loop(genome)
    return SearchResult(loop, fitness, tuple(history.generations), finalists, len(history.archive), candidates.columns)


class _History:
    """Every distinct candidate with its score, and the statistics of each generation."""

    def __init__(self, progress: Callable[[Generation], None] | None):
        self.generations: list[Generation] = []
        self.archive: dict[bytes, tuple[np.ndarray, LoopScore]] = {}
        self._progress = progress

    def note(self, genomes: np.ndarray, scores: Sequence[LoopScore]) -> None:
        for genome, score in zip(genomes, scores, strict=True):
            self.archive.setdefault(genome.tobytes(), (genome.copy(), score))
        fitness = np.array([score.fitness for score in scores if score.feasible and np.isfinite(score.fitness)])
        best, mean = (float(fitness.max()), float(fitness.mean())) if len(fitness) else (np.nan, np.nan)
        generation = Generation(len(self.generations), best, mean, len(fitness), len(self.archive))
        self.generations.append(generation)
        if self._progress is not None:
            self._progress(generation)


def _final(candidates: Candidates, history: _History) -> tuple[np.ndarray, float, np.ndarray]:
    """Genome and fitness of the best of the finalists on all samples; (F, 2) their fitness before and after."""
    genomes = [genome for genome, _ in history.archive.values()]
    scores = [score for _, score in history.archive.values()]
    order = ranking(scores)
    useful = [int(k) for k in order if scores[k].feasible and np.isfinite(scores[k].fitness)]
    if not useful:
        raise InputError(_no_loop_text(scores[order[0]], len(scores)))
    last = scores[useful[0]]
    for first in range(0, len(useful), FINALISTS):
        group = useful[first : first + FINALISTS]
        again = [candidates.score_on_all(genomes[k]) for k in group]
        winner = int(ranking(again)[0])
        if again[winner].feasible and np.isfinite(again[winner].fitness):
            table = np.array([[scores[k].fitness, new.fitness] for k, new in zip(group, again, strict=True)])
            return genomes[group[winner]], again[winner].fitness, table
        last = again[winner]
    raise InputError(_no_loop_text(last, len(scores)))


def _no_loop_text(best: LoopScore, count: int) -> str:
    if best.feasible:
        return (
            f"none of {count} loops excites every parameter: the sub-region is too small, or the arm too slow in it; "
            "enlarge motion.via_points or its cone, or raise motion.speed"
        )
    return (
        f"none of {count} loops in the sub-region keeps all limits; the nearest to it: {best.reason}. "
        "Move or shrink motion.via_points, or lower motion.speed"
    )


def _processes(candidates: int) -> InProcess | LocalProcesses:
    count = min(available_cores(), 1 + candidates // _CANDIDATES_A_WORKER)
    return InProcess() if count == 1 else LocalProcesses(count)
