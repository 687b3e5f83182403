"""Which of several motions is run: the one whose rehearsals name most, and as little of it as they need."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from agent.diagnosis import Diagnosis
from agent.excitation import LoopProblem
from agent.experiment.deadline import OutOfTime
from agent.experiment.pieces import Piece
from agent.experiment.questions import OpenPair
from agent.experiment.rehearsal import Rehearsal, said_by

#: Rehearsals of each rival for every motion, and once more for so many of the best.
_TRIAL_DRAWS, _TRIED_AGAIN, _MORE_DRAWS = 2, 2, 4
#: Rehearsals of each rival to say what is expected, least and most, and about so many of all rivals: each takes time.
_LEAST_DRAWS, _MOST_DRAWS, _DRAWS = 3, 6, 24
#: Motions that differ by less are alike: a rehearsal or so. Of a pair that is told apart beside others that are not, so
#: much counts.
_LIKE, _APART = 0.07, 0.3
#: A motion is chosen by rehearsals of so many hypotheses at most, the most urgent: what is named and equals it.
_TRIED = 3
#: Of a motion that names what is true this often pieces are left out that it does not need, so many at most are tried.
_SURE, _LEFT_OUT = 0.9, 3


def best_rehearsed(
    designs: Sequence[list[Piece]],
    settled: Callable[[Sequence[Piece], int, int], float],
    seed: int,
    progress: Callable[[str], None],
) -> list[Piece]:
    """The design whose rehearsals name most, of those that they cannot tell apart the one that is given first.

    All are rehearsed a little, and the best of them once more: a few rehearsals do not say which of many is best, and
    the highest of many has been lucky (successive halving: Karnin, Koren and Somekh, ICML 2013).
    """
    worth = np.zeros(len(designs))
    try:
        return _raced(designs, worth, settled, seed, progress)
    except OutOfTime:
        return list(designs[int(np.argmax(worth))])


def _raced(
    designs: Sequence[list[Piece]],
    worth: np.ndarray,
    settled: Callable[[Sequence[Piece], int, int], float],
    seed: int,
    progress: Callable[[str], None],
) -> list[Piece]:
    """The best design; what is known of each is in `worth` (designs,) from then on."""
    for number, design in enumerate(designs):
        progress(f"motion {number + 1} of {len(designs)} is rehearsed")
        worth[number] = settled(design, _TRIAL_DRAWS, seed)
    again = sorted(np.argsort(-worth, kind="stable")[:_TRIED_AGAIN].tolist())
    more = {}
    for number in again:
        progress(f"motion {number + 1} of {len(designs)} is rehearsed again")
        more[number] = settled(designs[number], _MORE_DRAWS, seed + 1)
        worth[number] = np.average([worth[number], more[number]], weights=[_TRIAL_DRAWS, _MORE_DRAWS])
    highest = max(worth[again])
    best = next(number for number in again if worth[number] >= highest - _LIKE)
    if worth[best] < _SURE * (1 + _APART):
        return list(designs[best])
    return _shortened(list(designs[best]), more[best], lambda design: settled(design, _MORE_DRAWS, seed + 1), progress)


def _shortened(
    design: list[Piece], worth: float, settled: Callable[[list[Piece]], float], progress: Callable[[str], None]
) -> list[Piece]:
    """Without every piece of which rehearsals name as much without it, the longest first: robot time is dear.

    For a motion that is nearly sure to tell: of others a few rehearsals do not say what less of it would cost.
    """
    with suppress(OutOfTime):
        for piece in sorted(design, key=lambda piece: -piece.duration)[:_LEFT_OUT]:
            without = [other for other in design if other is not piece]
            progress(f"the motion is rehearsed without {piece.duration:.0f} s of it")
            if without and settled(without) >= worth:
                design = without
    return design


def settled(
    found: Diagnosis,
    pairs: Sequence[OpenPair],
    problem: LoopProblem,
    progress: Callable[[str], None],
    design: Sequence[Piece],
    draws: int,
    seed: int,
) -> float:
    """Share of rehearsals that name what is true alone, and with less weight of pairs that are told apart."""
    names = found.dataset.robot.joint_names
    said = Rehearsal(found, pairs, [piece.motion for piece in design], problem.load, progress).said(draws, seed, _TRIED)
    alone = [one.settles(place) for place, answers in said.items() for one in answers]
    open_pairs = [
        (a.place(names), b.place(names)) for p in pairs for a, b in ((p.first, p.second), (p.second, p.first))
    ]
    apart = [one.names(true, rival) for true, rival in open_pairs for one in said.get(true, ())]
    return float(np.mean(alone) + _APART * np.mean(apart)) if alone else 0.0


def rehearsed(
    found: Diagnosis,
    pairs: Sequence[OpenPair],
    design: Sequence[Piece],
    problem: LoopProblem,
    seed: int,
    progress: Callable[[str], None],
) -> tuple[np.ndarray, np.ndarray]:
    """(pairs, 2) right answers of now and after the motion, where the first or the second of a pair is true.

    Those after it are the mean of the posterior under Jeffreys' prior, Beta(1/2, 1/2), as three of three rehearsals are
    no certainty; what the verdict tells already is not doubted so.
    """
    names, now = found.dataset.robot.joint_names, said_by(found.finding)
    rehearsal = Rehearsal(found, pairs, [piece.motion for piece in design], problem.load, progress)
    places = {side.place(names) for pair in pairs if pair.second.forms for side in (pair.first, pair.second)}
    said = rehearsal.said(int(np.clip(_DRAWS // max(len(places), 1), _LEAST_DRAWS, _MOST_DRAWS)), seed)
    before, after = np.full((2, len(pairs), 2), np.nan)
    for number, pair in enumerate(pairs):
        first, second = pair.first.place(names), pair.second.place(names)
        for side, (true, rival) in enumerate(((first, second), (second, first))):
            if said.get(true):
                known = before[number, side] = now.names(true, rival)
                told = [one.names(true, rival) for one in said[true]]
                after[number, side] = (sum(told) + 0.5 + 0.5 * known) / (len(told) + 1)
    return before, after
