"""Baselines of an experiment with the same motion time: random and D-optimal motions.

They are loops through via-points of the sub-region at several speeds, as an excitation or a validation is, or pieces of
all the kinds that an experiment is put together from: what its kinds are worth, and what choosing them is.

D-optimal (Kiefer and Wolfowitz, Canadian J. Mathematics 12, 1960): the pieces that, with all earlier motions, make the
determinant of the information on the model's own parameters largest. That is what an excitation loop is chosen for; it
knows nothing of rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from agent.diagnosis import Dataset
from agent.excitation import LoopProblem
from agent.experiment.pieces import KINDS, GridMotion, Piece, Pieces

#: Pieces that are drawn, to choose from.
_POOL = 80

#: Of the pieces that still fit (the second) the one that comes after those that are chosen (the first).
Pick = Callable[[Sequence[Piece], Sequence[Piece]], Piece]


def pieces_otherwise(
    pick: Pick,
    problem: LoopProblem,
    seconds: float,
    seed: int,
    runnable: Callable[[Sequence[Piece]], bool],
    kinds: Mapping[str, float] = KINDS,
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
        kinds: of pieces, and how often each is drawn.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """
    pieces = Pieces(problem, range(problem.robot.dof), seconds, np.random.default_rng(seed), kinds)
    pool = [piece for piece in (pieces.draw() for _ in range(_POOL)) if piece is not None]
    chosen = together(pick, pool, seconds)
    while chosen and not runnable(chosen):
        chosen.pop()
    return tuple(chosen)


def together(pick: Pick, pool: Sequence[Piece], seconds: float, begun: Sequence[Piece] = ()) -> list[Piece]:
    """Pieces picked one after the other while one fits into the time, after those that it begins with."""
    chosen = list(begun)
    remaining = seconds - sum(piece.duration for piece in chosen)
    while True:
        options = [
            piece for piece in pool if piece.duration <= remaining and all(piece is not other for other in chosen)
        ]
        if not options:
            return chosen
        chosen.append(pick(chosen, options))
        remaining -= chosen[-1].duration


def as_drawn(chosen: Sequence[Piece], options: Sequence[Piece]) -> Piece:
    """Pieces at random."""
    return options[0]


def d_optimal(dataset: Dataset, information_of: Callable[[GridMotion], np.ndarray]) -> Pick:
    """Return the choice of the piece that raises the determinant most, with the logs of a diagnosis.

    `information_of` says what a motion adds (p, p) to what is known of the model's parameters.
    """
    fit = dataset.fit
    model = len(fit.precision)
    known = fit.gram.sum(axis=0)[:model, :model] / fit.repeat + fit.precision
    scale = 1 / np.sqrt(np.diag(known))
    added: dict[Piece, np.ndarray] = {}

    def information(piece: Piece) -> np.ndarray:
        if piece not in added:
            added[piece] = information_of(piece.motion)
        return added[piece]

    def pick(chosen: Sequence[Piece], options: Sequence[Piece]) -> Piece:
        now = known + sum((information(piece) for piece in chosen), np.zeros_like(known))
        return max(
            options,
            key=lambda piece: float(np.linalg.slogdet((now + information(piece)) * np.outer(scale, scale))[1]),
        )

    return pick
