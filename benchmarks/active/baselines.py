"""Baselines of an experiment with the same motion time: random and D-optimal motions.

They are loops through via-points of the sub-region at several speeds, as an excitation or a validation is, or pieces of
all the kinds that an experiment is put together from: what its kinds are worth, and what choosing them is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.excitation import LoopProblem
from agent.experiment import KINDS, Pick, Piece, Pieces, fill_time

#: Pieces that are drawn, to choose from.
_POOL = 80


def pieces_otherwise(
    pick: Pick,
    problem: LoopProblem,
    seconds: float,
    seed: int,
    runnable: Callable[[Sequence[Piece]], bool],
    kinds: Sequence[str] = KINDS,
) -> tuple[Piece, ...]:
    """Of drawn pieces one after the other while one fits into the time; the last left out while they cannot be run.

    As many as the time takes: every use of it is to have the same. How long the ways between them take is up to
    `runnable`.

    Args:
        pick: chooses the next of the pieces that fit.
        problem: sub-region and limits of the motion.
        seconds: longest motion [s].
        seed: of the draw.
        runnable: whether pieces can run one after the other.
        kinds: of pieces that are drawn.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    pieces = Pieces(problem, range(problem.robot.dof), seconds, np.random.default_rng(seed), kinds)
    pool = [piece for piece in (pieces.draw() for _ in range(_POOL)) if piece is not None]
    chosen = fill_time(pick, pool, seconds)
    while chosen and not runnable(chosen):
        chosen.pop()
    return tuple(chosen)


def as_drawn(chosen: Sequence[Piece], options: Sequence[Piece]) -> Piece:
    """Pieces at random."""
    return options[0]
