"""The motion that separates what a diagnosis leaves open: pieces chosen one after the other, then varied."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from agent.diagnosis import Diagnosis
from agent.excitation import LoopProblem
from agent.experiment.choice import best_rehearsed, rehearsed, settled
from agent.experiment.deadline import Deadline, OutOfTime
from agent.experiment.otherwise import Pick, d_optimal, together
from agent.experiment.outlook import Outlook, Told
from agent.experiment.pieces import Piece, Pieces
from agent.experiment.questions import Hypothesis, OpenPair
from agent.experiment.rehearsal import said_by

#: Pieces that are drawn, of which the best are put together; then so many neighbours of each are tried.
_POOL, _NEIGHBOURS = 240, 12
#: A motion has at most so many pieces that are chosen for what they separate, and ends early where the right answer is
#: this likely; what only fills the time may be more.
_MOST_PIECES, _SURE = 5, 0.97
#: Of the time for a motion so much goes into the ways between its pieces.
_WAYS = 0.15
#: A pair is asked about where one of the two, if it is true, can be told by all pieces together with more than this. Of
#: two of which one can always do what the other does, as friction by direction can be an offset, only one can be told.
_WITHIN_REACH = 0.3
#: One of which the right answer is this likely without another motion is not asked about beside others.
_KNOWN = 0.9
#: Of the time so much asks what is open, where there are rivals, and the rest says most of everything: rehearsals know
#: neither laws that nobody thought of nor how a model errs at speeds that it was not seen at.
_ASKED = 0.5
#: Parts of the time for planning by which pieces are drawn, varied, and the motions rehearsed; the rest says what is
#: expected of the best.
_DRAWN_BY, _VARIED_BY, _REHEARSED_BY = 0.3, 0.45, 0.8
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
    """A motion as pieces, and what it is expected to tell. No pieces: no motion in the sub-region tells more, as far as
    it was searched: `cut_short` says that there was no time to weigh all."""

    pieces: tuple[Piece, ...]
    expected: tuple[Expected, ...]
    weighed: int
    cut_short: bool = False

    @property
    def duration(self) -> float:
        """Of the pieces [s], without the ways between them."""
        return sum(piece.duration for piece in self.pieces)


def plan_experiment(  # noqa: C901
    found: Diagnosis,
    pairs: Sequence[OpenPair],
    problem: LoopProblem,
    seconds: float = 60.0,
    seed: int = 1,
    deadline: Deadline | None = None,
    runnable: Callable[[Sequence[Piece]], bool] = lambda pieces: True,
) -> Experiment:
    """The motion of at most `seconds` in the problem's sub-region that settles most of what is open (`pairs`).

    The worst pair counts first. The same seed gives the same motion, where the `deadline` does not end the search
    before: then it is the best of what was weighed. `runnable` says whether pieces can be run one after the other:
    while they cannot, the last one is left out.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    outlook = Outlook(found.dataset, pairs, problem.load)
    pieces = Pieces(problem, _joints(found, pairs), (1 - _WAYS) * seconds, np.random.default_rng(seed))
    pool: list[tuple[Piece, Told]] = []
    deadline = deadline or Deadline()
    cut_short = True
    with suppress(OutOfTime):
        for number in range(_POOL):
            deadline.share(_DRAWN_BY)(f"motions that would tell more: {number + 1} of {_POOL} weighed")
            if (piece := pieces.draw()) is not None:
                pool.append((piece, outlook.told(piece.motion)))
        cut_short = False
    before_if = outlook.chances(outlook.nothing)
    at_best = _at_best(outlook, pool, (1 - _WAYS) * seconds)
    least_known = _KNOWN if np.any(before_if <= _KNOWN) else 1.0
    doubtful = _doubtful(found, pairs, before_if)
    wanted = (before_if <= least_known) | doubtful[:, None]
    sides = wanted & (at_best > np.maximum(before_if, _WITHIN_REACH))
    asked = sides.any(axis=1) | doubtful
    if not asked.any():
        return Experiment((), (), len(pool), cut_short)
    longest = (1 - _WAYS) * seconds

    def designed(wanted: np.ndarray, longest: float) -> list[Piece]:
        chosen = _greedy(outlook, pool, longest, wanted)
        with suppress(OutOfTime):
            for number in np.repeat(range(len(chosen)), _NEIGHBOURS):
                deadline.share(_VARIED_BY)(f"piece {number + 1} of {len(chosen)} is varied")
                other = pieces.vary(chosen[number][0])
                if other is None:
                    continue
                varied = [*chosen[:number], (other, outlook.told(other.motion)), *chosen[number + 1 :]]
                fits = sum(piece.duration for piece, _ in varied) <= longest
                if fits and _utility(outlook, varied, wanted) > _utility(outlook, chosen, wanted):
                    chosen = varied
        return [piece for piece, _ in chosen]

    def chances_after(design: Sequence[Piece]) -> np.ndarray:
        return outlook.chances(sum((outlook.told(piece.motion) for piece in design), outlook.nothing))

    rivals = np.array([bool(pair.second.forms) for pair in pairs])
    of_cause = sides & (np.array([[pair.first is pairs[0].first] for pair in pairs]) & rivals[:, None])
    questions = [designed(one, _ASKED * longest) for one in _different(sides, of_cause)]
    pick, drawn = _d_optimal(found, pool), [piece for piece, _ in pool]
    if doubtful.any():
        questions.append(together(_loudest(outlook, pairs[0].first, pool), drawn, _ASKED * longest))
    loops = [piece for piece in drawn if piece.draw.kind == "loop"]
    designs = [together(pick, drawn, longest, begun) for begun in (*questions, [])]
    designs += [together(pick, loops, longest), *([designed(sides, longest)] if sides.any() else [])]
    designs = [design for design in map(partial(_runnable, runnable), designs) if design]
    best: list[Piece] = []
    if rivals.any() and designs:
        rehearsing = deadline.share(_REHEARSED_BY)
        best = best_rehearsed(designs, partial(settled, found, pairs, problem, rehearsing), seed, rehearsing)
    elif designs:  # what fills the time may hide what is asked about, as all of it counts
        best = next((one for one in designs if np.any(chances_after(one)[sides] > _WITHIN_REACH)), designs[-1])
    while best and not runnable(best):  # what runs last is what is taken
        best = best[:-1]
    added = sum((outlook.told(piece.motion) for piece in best), outlook.nothing)
    after_if, detectable = outlook.chances(added), outlook.minimum_detectable_sizes(added)
    if best and rivals.any():
        with suppress(OutOfTime):  # else what is expected is what the criterion says of it
            before_if, after_if = rehearsed(found, pairs, best, problem, seed + 2, deadline)
    expected = tuple(
        Expected(
            pairs[k], _mean(before_if[k]), _mean(after_if[k]), _known(before_if[k]), _known(after_if[k]), detectable[k]
        )
        for k in map(int, np.flatnonzero(asked | _named(found, pairs)))
    )
    return Experiment(tuple(best), expected, len(pool), cut_short)


def _named(found: Diagnosis, pairs: Sequence[OpenPair]) -> np.ndarray:
    """(pairs,) whether the verdict itself names the two as equals: what a motion tells of them is said."""
    names, classes = found.dataset.robot.joint_names, said_by(found.finding).classes
    return np.array(
        [
            any({pair.first.place(names), pair.second.place(names)} <= set(one) for one in classes)
            if pair.second.forms
            else False
            for pair in pairs
        ],
        dtype=bool,
    )


def _doubtful(found: Diagnosis, pairs: Sequence[OpenPair], before_if: np.ndarray) -> np.ndarray:
    """(pairs,) whether the criterion tells the cause from its rival on these logs already and the verdict does not.

    It may leave too much of the gap, as the model's error is as large as the effect there, or a fuller law may do
    better by too little. A motion tells that shows more of the effect.
    """
    names, now = found.dataset.robot.joint_names, said_by(found.finding)
    return np.array(
        [
            pair.first is pairs[0].first
            and bool(pair.second.forms)
            and bool(before_if[k, 0] > _KNOWN)
            and not now.names(pair.first.place(names), pair.second.place(names))
            for k, pair in enumerate(pairs)
        ]
    )


def _different(sides: np.ndarray, of_cause: np.ndarray) -> Iterator[np.ndarray]:
    """What to ask about: all (pairs, 2) that are open, and the named cause alone, where there is any and it differs."""
    if sides.any():
        yield sides
    if 0 < of_cause.sum() < sides.sum():
        yield of_cause


def _loudest(outlook: Outlook, cause: Hypothesis, pool: Sequence[tuple[Piece, Told]]) -> Pick:
    """The piece on which the cause is largest over the model's error."""
    energy = {piece: outlook.energy(told, cause.truths[0]) for piece, told in pool}
    return lambda chosen, options: max(options, key=energy.__getitem__)


def _runnable(runs: Callable[[Sequence[Piece]], bool], design: Sequence[Piece]) -> list[Piece]:
    """Without the last pieces, while they cannot be run."""
    left = list(design)
    while left and not runs(left):
        left.pop()
    return left


def _d_optimal(found: Diagnosis, pool: Sequence[tuple[Piece, Told]]) -> Pick:
    """What says most of everything: it fills the time that a design leaves, and is one itself."""
    model = len(found.dataset.fit.precision)
    told = {piece: more.moments[:model, :model] for piece, more in pool}
    return d_optimal(
        found.dataset,
        lambda piece: told[piece] if piece in told else Outlook(found.dataset, ()).information(piece.motion),
    )


def _mean(chances: np.ndarray) -> float:
    known = chances[np.isfinite(chances)]
    return float(known.mean()) if len(known) else 0.0


def _known(chances: np.ndarray) -> tuple[float | None, float | None]:
    first, second = (float(chance) if np.isfinite(chance) else None for chance in chances)
    return first, second


def _joints(found: Diagnosis, pairs: Sequence[OpenPair]) -> list[int]:
    """Joints that the hypotheses sit on; all of them where every one is of the whole arm."""
    names = found.dataset.robot.joint_names
    sides = [side for pair in pairs for side in (pair.first, pair.second) if side.forms]
    return sorted({names.index(joint) for side in sides for joint in side.joints}) or list(range(len(names)))


def _greedy(
    outlook: Outlook, pool: Sequence[tuple[Piece, Told]], seconds: float, sides: np.ndarray
) -> list[tuple[Piece, Told]]:
    chosen: list[tuple[Piece, Told]] = []
    now = _utility(outlook, chosen, sides)
    while len(chosen) < _MOST_PIECES:
        left = seconds - sum(piece.duration for piece, _ in chosen)
        options = [entry for entry in pool if entry[0].duration <= left and all(entry[0] is not c[0] for c in chosen)]
        if not options:
            break
        worth = [_utility(outlook, [*chosen, entry], sides) for entry in options]
        best = int(np.argmax(worth))
        if worth[best] - now < _LEAST_IMPROVEMENT:
            break
        chosen, now = [*chosen, options[best]], worth[best]
        if outlook.chances(_sum(outlook, chosen))[sides].min() > _SURE:
            break
    return chosen


def _at_best(outlook: Outlook, pool: Sequence[tuple[Piece, Told]], seconds: float) -> np.ndarray:
    """(pairs, 2) right answers after all pieces, or after the best ones for each side: more motion of the wrong kind
    only adds to the margin."""
    alone = np.array([outlook.chances(outlook.nothing + told) for _, told in pool])
    best = np.fmax(outlook.chances(_sum(outlook, pool)), np.fmax.reduce(alone, axis=0, initial=0.0))
    for side in np.argwhere(np.isfinite(outlook.chances(outlook.nothing))):
        together: list[tuple[Piece, Told]] = []
        for number in np.argsort(-alone[(slice(None), *side)]) if pool else ():
            if sum(piece.duration for piece, _ in together) + pool[number][0].duration <= seconds:
                together.append(pool[number])
                best = np.fmax(best, outlook.chances(_sum(outlook, together)))
            if len(together) == _MOST_PIECES:
                break
    return best


def _sum(outlook: Outlook, chosen: Sequence[tuple[Piece, Told]]) -> Told:
    return sum((told for _, told in chosen), outlook.nothing)


def _utility(outlook: Outlook, chosen: Sequence[tuple[Piece, Told]], sides: np.ndarray) -> float:
    """Log odds of what is within reach, the worst first, then the others."""
    chance = np.clip(outlook.chances(_sum(outlook, chosen))[sides], 1e-300, 1 - 1e-9)
    odds = np.minimum(np.log(chance / (1 - chance)), 4)
    return float(odds.min() + 0.3 * odds.mean())
