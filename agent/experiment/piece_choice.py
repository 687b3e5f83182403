"""The motion that separates what a diagnosis leaves open: pieces chosen one after the other, then varied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from agent.diagnosis import LAW, LIMITS, Diagnosis
from agent.excitation import LoopProblem
from agent.experiment.deadline import Deadline, OutOfTime
from agent.experiment.picking import d_optimal, fill_time
from agent.experiment.pieces import Piece, Pieces
from agent.experiment.questions import OpenPair
from agent.experiment.scorer import ExperimentScorer, InformationGain

#: numerical: drawn pieces, of which the best are combined, and neighbours tried for each of these
_POOL, _NEIGHBOURS = 240, 12


@dataclass(frozen=True, eq=False)
class Expected:
    """Of one open pair: the probability of the right answer without another motion and after it.

    `before_if`, `after_if`: where the first or the second of the two is true (None: not an effect). Where the rival is
    nothing, the smallest size that would be found (1 is practical size).
    """

    pair: OpenPair
    before: float
    after: float
    before_if: tuple[float | None, float | None]
    after_if: tuple[float | None, float | None]
    minimum_detectable_size: float | None


@dataclass(frozen=True, eq=False)
class Experiment:
    """A motion as pieces, and what it is expected to tell. No pieces: no motion in the sub-region tells more, as far as
    it was searched: `cut_short` says that there was no time to weigh all."""

    pieces: tuple[Piece, ...]
    expected: tuple[Expected, ...]
    weighed: int
    cut_short: bool = False

    @property
    def duration(self) -> float:
        """Duration of the pieces [s], without the transfers between them."""
        return sum(piece.duration for piece in self.pieces)


Weighed = tuple[Piece, InformationGain]


def plan_experiment(
    diagnosis: Diagnosis,
    pairs: Sequence[OpenPair],
    problem: LoopProblem,
    seconds: float,
    seed: int = 1,
    deadline: Deadline | None = None,
    runnable: Callable[[Sequence[Piece]], bool] = lambda pieces: True,
) -> Experiment:
    """Return the motion of at most `seconds` in the problem's sub-region that settles most open `pairs`.

    The worst pair counts first. The same seed gives the same motion, where the `deadline` does not end the search
    before: then it is the best of what was weighed. `runnable` says whether pieces can be run one after the other:
    while they cannot, the last one is left out. Half of the time is for what is asked; what is left says most of
    everything, since no plan knows laws that nobody thought of.

    Args:
        diagnosis: diagnosis that leaves pairs open.
        pairs: of hypotheses, the most urgent first.
        problem: sub-region and limits of the motion.
        seconds: longest motion [s].
        seed: of the draw of pieces.
        deadline: end of planning; None: no end.
        runnable: whether pieces can be run one after the other.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    scorer = ExperimentScorer(diagnosis.dataset, diagnosis.selected.evidence, pairs, problem.load)
    pieces = Pieces(problem, _joints(diagnosis, pairs), seconds, np.random.default_rng(seed))
    pool: list[Weighed] = []
    deadline, cut_short = deadline or Deadline(), True
    with suppress(OutOfTime):
        for number in range(_POOL):
            deadline.share(0.5)(f"motions that would tell more: {number + 1} of {_POOL} weighed")
            if (piece := pieces.draw()) is not None:
                pool.append((piece, scorer.information_of(piece.motion)))
        cut_short = False
    before = scorer.chances(scorer.nothing)
    at_best = scorer.chances(_sum(scorer, pool))
    asked = (at_best > np.maximum(np.nan_to_num(before), LIMITS.majority)) & (np.nan_to_num(before) < LAW.confidence)
    if not asked.any():
        return Experiment((), (), len(pool), cut_short)
    chosen = _varied(scorer, pieces, _greedy(scorer, pool, seconds / 2, asked), seconds / 2, asked, deadline)
    design = fill_time(
        d_optimal(diagnosis.dataset, scorer.model_information),
        [piece for piece, _ in pool],
        seconds,
        [piece for piece, _ in chosen],
    )
    while design and not runnable(design):
        design.pop()
    added = sum((scorer.information_of(piece.motion) for piece in design), scorer.nothing)
    after, detectable = scorer.chances(added), scorer.minimum_detectable_sizes(added)
    expected = tuple(
        Expected(pairs[k], _mean(before[k]), _mean(after[k]), _known(before[k]), _known(after[k]), detectable[k])
        for k in map(int, np.flatnonzero(asked.any(axis=1)))
    )
    return Experiment(tuple(design), expected, len(pool), cut_short)


def _varied(
    scorer: ExperimentScorer,
    pieces: Pieces,
    chosen: list[Weighed],
    longest: float,
    asked: np.ndarray,
    deadline: Deadline,
) -> list[Weighed]:
    """Neighbours of each chosen piece in its stead, where that tells more."""
    with suppress(OutOfTime):
        for number in np.repeat(range(len(chosen)), _NEIGHBOURS):
            deadline(f"piece {number + 1} of {len(chosen)} is varied")
            if (other := pieces.vary(chosen[number][0])) is None:
                continue
            varied = [*chosen[:number], (other, scorer.information_of(other.motion)), *chosen[number + 1 :]]
            fits = sum(piece.duration for piece, _ in varied) <= longest
            if fits and _utility(scorer, varied, asked) > _utility(scorer, chosen, asked):
                chosen = varied
    return chosen


def _mean(chances: np.ndarray) -> float:
    finite = chances[np.isfinite(chances)]
    return float(finite.mean()) if len(finite) else 0.0


def _known(chances: np.ndarray) -> tuple[float | None, float | None]:
    first, second = (float(chance) if np.isfinite(chance) else None for chance in chances)
    return first, second


def _joints(diagnosis: Diagnosis, pairs: Sequence[OpenPair]) -> list[int]:
    """Joints that the hypotheses sit on; all of them where every one is of the whole arm."""
    names = diagnosis.dataset.robot.joint_names
    sides = [side for pair in pairs for side in (pair.first, pair.second) if side.form is not None]
    return sorted({names.index(joint) for side in sides for joint in side.joints}) or list(range(len(names)))


def _greedy(scorer: ExperimentScorer, pool: Sequence[Weighed], seconds: float, asked: np.ndarray) -> list[Weighed]:
    chosen: list[Weighed] = []
    now = _utility(scorer, chosen, asked)
    while True:
        remaining = seconds - sum(piece.duration for piece, _ in chosen)
        options = [
            entry for entry in pool if entry[0].duration <= remaining and all(entry[0] is not c[0] for c in chosen)
        ]
        if not options:
            break
        worth = [_utility(scorer, [*chosen, entry], asked) for entry in options]
        best = int(np.argmax(worth))
        if worth[best] <= now:
            break
        chosen, now = [*chosen, options[best]], worth[best]
        if scorer.chances(_sum(scorer, chosen))[asked].min() > LAW.confidence:
            break
    return chosen


def _sum(scorer: ExperimentScorer, chosen: Sequence[Weighed]) -> InformationGain:
    return sum((gain for _, gain in chosen), scorer.nothing)


def _utility(scorer: ExperimentScorer, chosen: Sequence[Weighed], asked: np.ndarray) -> float:
    """Log odds of the worst pair within reach and of all of them; more than certain counts no more."""
    chance = np.clip(scorer.chances(_sum(scorer, chosen))[asked], 1e-300, LAW.confidence)
    odds = np.log(chance / (1 - chance))
    return float(odds.min() + odds.mean())
