"""The motion that separates what a diagnosis leaves open: pieces chosen one after the other, then varied."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from agent.diagnosis import Diagnosis
from agent.excitation import LoopProblem
from agent.experiment.outlook import Outlook, Told
from agent.experiment.pieces import Piece, Pieces
from agent.experiment.questions import OpenPair

#: Pieces that are drawn, of which the best are put together; then so many neighbours of each are tried.
_POOL, _NEIGHBOURS = 240, 12
#: A motion has at most so many pieces, and ends early where the right answer is this likely.
_MOST_PIECES, _SURE = 5, 0.97
#: Of the time for a motion so much goes into the ways between its pieces.
_WAYS = 0.15
#: A pair is asked about where one of the two, if it is true, can be told by all pieces together with more than this. Of
#: two of which one can always do what the other does, as friction by direction can be an offset, only one can be told.
_WITHIN_REACH = 0.3
#: One of which the right answer is this likely without another motion is not asked about beside others.
_KNOWN = 0.9
#: A further piece raises what is expected by at least so much.
_LEAST_IMPROVEMENT = 0.01


@dataclass(frozen=True, eq=False)
class Expected:
    """Of one open pair: the probability of the right answer without another motion and after it, and both where the
    first or the second of the two is true (None: not weighed); where the rival is nothing, the smallest size that would
    be found (in the parameters that were asked about: 1 is practical size)."""

    pair: OpenPair
    before: float
    after: float
    before_if: tuple[float | None, float | None]
    after_if: tuple[float | None, float | None]
    minimum_detectable_size: float | None


@dataclass(frozen=True, eq=False)
class Experiment:
    """A motion as pieces, and what it is expected to tell. No pieces: no motion in the sub-region tells more."""

    pieces: tuple[Piece, ...]
    expected: tuple[Expected, ...]
    weighed: int

    @property
    def duration(self) -> float:
        """Of the pieces [s], without the ways between them."""
        return sum(piece.duration for piece in self.pieces)


def plan_experiment(
    found: Diagnosis,
    pairs: Sequence[OpenPair],
    problem: LoopProblem,
    seconds: float = 60.0,
    seed: int = 1,
    progress: Callable[[str], None] = lambda text: None,
    runnable: Callable[[Sequence[Piece]], bool] = lambda pieces: True,
) -> Experiment:
    """The motion of at most `seconds` in the problem's sub-region that settles most of what is open (`pairs`).

    The worst pair counts first. The same seed gives the same motion. `runnable` says whether pieces can be run one
    after the other: while they cannot, the last one is left out.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    outlook = Outlook(found.dataset, pairs, problem.load)
    before = outlook.probabilities(outlook.nothing)
    pieces = Pieces(problem, _joints(found, pairs), (1 - _WAYS) * seconds, np.random.default_rng(seed))
    pool: list[tuple[Piece, Told]] = []
    for number in range(_POOL):
        progress(f"motions that would tell more: {number + 1} of {_POOL} weighed")
        if (piece := pieces.draw()) is not None:
            pool.append((piece, outlook.told(piece.motion)))
    before_if, at_best = outlook.chances(outlook.nothing), outlook.chances(_sum(outlook, pool))
    least_known = _KNOWN if np.any(before_if <= _KNOWN) else 1.0
    within_reach = np.any((before_if <= least_known) & (at_best > np.maximum(before_if, _WITHIN_REACH)), axis=1)
    if not within_reach.any():
        return Experiment((), (), len(pool))
    chosen = _greedy(outlook, pool, (1 - _WAYS) * seconds, within_reach)
    for number in range(len(chosen)):
        for _ in range(_NEIGHBOURS):
            progress(f"piece {number + 1} of {len(chosen)} is varied")
            other = pieces.vary(chosen[number][0])
            if other is None:
                continue
            varied = [*chosen[:number], (other, outlook.told(other.motion)), *chosen[number + 1 :]]
            fits = sum(piece.duration for piece, _ in varied) <= (1 - _WAYS) * seconds
            if fits and _utility(outlook, varied, within_reach) > _utility(outlook, chosen, within_reach):
                chosen = varied
    while chosen and not runnable([piece for piece, _ in chosen]):
        chosen = chosen[:-1]
    added = _sum(outlook, chosen)
    after, each = outlook.probabilities(added), outlook.chances(added)
    detectable = outlook.minimum_detectable_sizes(added)
    expected = tuple(
        Expected(pairs[k], float(before[k]), float(after[k]), _known(before_if[k]), _known(each[k]), detectable[k])
        for k in map(int, np.flatnonzero(within_reach))
    )
    return Experiment(tuple(piece for piece, _ in chosen), expected, len(pool))


def _known(chances: np.ndarray) -> tuple[float | None, float | None]:
    first, second = (float(chance) if np.isfinite(chance) else None for chance in chances)
    return first, second


def _joints(found: Diagnosis, pairs: Sequence[OpenPair]) -> list[int]:
    """Joints that the hypotheses sit on; all of them where one is of the whole arm."""
    names = found.dataset.robot.joint_names
    sides = [side for pair in pairs for side in (pair.first, pair.second) if side.forms]
    if any(not side.joints for side in sides):
        return list(range(len(names)))
    return sorted({names.index(joint) for side in sides for joint in side.joints})


def _greedy(
    outlook: Outlook, pool: Sequence[tuple[Piece, Told]], seconds: float, within_reach: np.ndarray
) -> list[tuple[Piece, Told]]:
    chosen: list[tuple[Piece, Told]] = []
    now = _utility(outlook, chosen, within_reach)
    while len(chosen) < _MOST_PIECES:
        left = seconds - sum(piece.duration for piece, _ in chosen)
        options = [entry for entry in pool if entry[0].duration <= left and all(entry[0] is not c[0] for c in chosen)]
        if not options:
            break
        worth = [_utility(outlook, [*chosen, entry], within_reach) for entry in options]
        best = int(np.argmax(worth))
        if worth[best] - now < _LEAST_IMPROVEMENT:
            break
        chosen, now = [*chosen, options[best]], worth[best]
        if outlook.probabilities(_sum(outlook, chosen))[within_reach].min() > _SURE:
            break
    return chosen


def _sum(outlook: Outlook, chosen: Sequence[tuple[Piece, Told]]) -> Told:
    return sum((told for _, told in chosen), outlook.nothing)


def _utility(outlook: Outlook, chosen: Sequence[tuple[Piece, Told]], within_reach: np.ndarray) -> float:
    """Log odds of the pairs within reach, the worst first, then the others."""
    chance = np.clip(outlook.probabilities(_sum(outlook, chosen))[within_reach], 1e-9, 1 - 1e-9)
    odds = np.clip(np.log(chance / (1 - chance)), -20, 4)
    return float(odds.min() + 0.3 * odds.mean())
