"""Other ways to spend the time of an experiment, to compare it with: pieces at random, and the D-optimal pieces.

D-optimal (Kiefer and Wolfowitz, Canadian J. Mathematics 12, 1960): the pieces that, with all earlier motions, make the
determinant of the information on the model's own parameters largest. That is what an excitation loop is chosen for; it
knows nothing of rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.diagnosis import Diagnosis
from agent.excitation import LoopProblem
from agent.experiment.outlook import Outlook
from agent.experiment.pieces import Piece, Pieces

#: Pieces that are drawn for the D-optimal choice.
_POOL = 80
#: Of the time so much goes into the ways between the pieces.
_WAYS = 0.15
_MOST_PIECES = 5

#: Pieces of at most so many seconds, of a diagnosis and a problem, that can be run (see `plan_experiment`).
Choice = Callable[[Diagnosis, LoopProblem, float, int, Callable[[Sequence[Piece]], bool]], "tuple[Piece, ...]"]


def random_pieces(
    found: Diagnosis,
    problem: LoopProblem,
    seconds: float,
    seed: int,
    runnable: Callable[[Sequence[Piece]], bool],
) -> tuple[Piece, ...]:
    """Pieces as they are drawn, until the time is used; none where no drawn piece fits.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    pool = _pool(problem, seconds, seed, _MOST_PIECES * 4)
    return _together(pool, seconds, runnable, lambda chosen, options: options[0])


def d_optimal_pieces(
    found: Diagnosis,
    problem: LoopProblem,
    seconds: float,
    seed: int,
    runnable: Callable[[Sequence[Piece]], bool],
) -> tuple[Piece, ...]:
    """Of a pool of drawn pieces, one after the other that which raises the determinant most.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    outlook, fit = Outlook(found.dataset, ()), found.dataset.fit
    model = len(fit.precision)
    known = fit.gram.sum(axis=0)[:model, :model] / fit.repeat + fit.precision
    pool = _pool(problem, seconds, seed, _POOL)
    added = {id(piece): outlook.information(piece.motion) for piece in pool}
    scale = 1 / np.sqrt(np.diag(known))

    def best(chosen: Sequence[Piece], options: Sequence[Piece]) -> Piece:
        now = known + sum((added[id(piece)] for piece in chosen), np.zeros_like(known))

        def worth(piece: Piece) -> float:
            return float(np.linalg.slogdet((now + added[id(piece)]) * np.outer(scale, scale))[1])

        return max(options, key=worth)

    return _together(pool, seconds, runnable, best)


def _pool(problem: LoopProblem, seconds: float, seed: int, count: int) -> list[Piece]:
    pieces = Pieces(problem, range(problem.robot.dof), (1 - _WAYS) * seconds, np.random.default_rng(seed))
    return [piece for piece in (pieces.draw() for _ in range(count)) if piece is not None]


def _together(
    pool: Sequence[Piece],
    seconds: float,
    runnable: Callable[[Sequence[Piece]], bool],
    pick: Callable[[Sequence[Piece], Sequence[Piece]], Piece],
) -> tuple[Piece, ...]:
    """Pieces picked one after the other while one fits into the time; the last left out while they cannot be run."""
    chosen: list[Piece] = []
    left = (1 - _WAYS) * seconds
    while len(chosen) < _MOST_PIECES:
        options = [piece for piece in pool if piece.duration <= left and all(piece is not one for one in chosen)]
        if not options:
            break
        chosen.append(pick(chosen, options))
        left -= chosen[-1].duration
    while chosen and not runnable(chosen):
        chosen.pop()
    return tuple(chosen)
