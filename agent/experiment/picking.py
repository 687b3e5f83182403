"""Pieces that are picked one after the other, and the pick that determines the model's own parameters best.

D-optimal (Kiefer and Wolfowitz, Canadian J. Mathematics 12, 1960): the pieces that, with all earlier motions, make the
determinant of the information on the model's own parameters largest. That is what an excitation loop is chosen for; it
knows nothing of rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from agent.diagnosis import Dataset
from agent.experiment.pieces import GridMotion, Piece

#: Of the pieces that still fit (the second) the one that comes after those that are chosen (the first).
Pick = Callable[[Sequence[Piece], Sequence[Piece]], Piece]


def fill_time(pick: Pick, pool: Sequence[Piece], seconds: float, begun: Sequence[Piece] = ()) -> list[Piece]:
    """Pieces picked one after the other while one fits into the time.

    Args:
        pick: chooses the next of the pieces that fit.
        pool: pieces to choose from.
        seconds: of all pieces together [s].
        begun: pieces that it begins with.
    """
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


def d_optimal(dataset: Dataset, information_of: Callable[[GridMotion], np.ndarray]) -> Pick:
    """Return the choice of the piece that raises the determinant most, with the logs of a diagnosis.

    `information_of` says what a motion adds (p, p) to what is known of the model's parameters.
    """
    fit = dataset.fit
    model = len(fit.precision)
    current = fit.gram.sum(axis=0)[:model, :model] / fit.rows_per_independent + fit.precision
    scale = 1 / np.sqrt(np.diag(current))
    added: dict[Piece, np.ndarray] = {}

    def information(piece: Piece) -> np.ndarray:
        if piece not in added:
            added[piece] = information_of(piece.motion)
        return added[piece]

    def pick(chosen: Sequence[Piece], options: Sequence[Piece]) -> Piece:
        now = current + sum((information(piece) for piece in chosen), np.zeros_like(current))
        return max(
            options,
            key=lambda piece: float(np.linalg.slogdet((now + information(piece)) * np.outer(scale, scale))[1]),
        )

    return pick
