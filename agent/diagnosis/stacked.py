"""Arithmetic of many candidates with as many parameters, side by side."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.diagnosis.candidate import Candidate

#: A candidate, and moments (cells, p, k) with what it is added to, and its own (cells, k, k).
WithMoments = tuple[Candidate, tuple[np.ndarray, np.ndarray]]


def side_by_side(found: Sequence[WithMoments]) -> Iterator[tuple[list[int], np.ndarray, np.ndarray]]:
    """Of those that have as many parameters, and happen once or repeat: numbers, and moments of both kinds (N, …)."""
    groups: dict[tuple[int, bool], list[int]] = {}
    for number, (candidate, _) in enumerate(found):
        groups.setdefault((len(candidate.names), candidate.once), []).append(number)
    for numbers in groups.values():
        yield numbers, np.stack([found[k][1][0] for k in numbers]), np.stack([found[k][1][1] for k in numbers])


def solved(matrix: np.ndarray, side: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N, k) solutions of systems (N, k, k) with sides (N, k), unknowns counted over the roots of `size` (N, k)."""
    scale = 1 / np.sqrt(np.maximum(size, 1e-300))
    scaled = matrix * (scale[:, :, None] * scale[:, None]) + 1e-9 * np.eye(matrix.shape[1])
    return np.asarray(scale * np.linalg.solve(scaled, (scale * side)[:, :, None])[:, :, 0])


def products(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """(N,) scalar products of the rows of two (N, k)."""
    return (one[:, None] @ two[:, :, None])[:, 0, 0]


def forms(left: np.ndarray, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N,) bilinear forms of the rows (N, k) and (N, l) with a matrix (k, l), or one each."""
    return products((left[:, None] @ matrix)[:, 0], right)
