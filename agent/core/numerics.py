"""Linear algebra and splines that a library leaves undone or is slow to load for, and memory for arrays."""

from __future__ import annotations

import numpy as np


def symmetric_eigen(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (n,), ascending, and eigenvectors (n, n) of a symmetric matrix (n, n).

    NumPy takes LAPACK's divide and conquer, which does not converge on some graded matrices that are quite in order, a
    covariance of a simulator's numbers among them. There it is the slower QR iteration.
    """
    try:
        values, vectors = np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:
        from scipy.linalg import eigh

        values, vectors = eigh(matrix, driver="ev")
    return values, vectors


def cubic_spline(knots: np.ndarray, values: np.ndarray, places: np.ndarray, natural: bool = False) -> np.ndarray:
    """(P, m) at places (P,) of the cubic splines through values (K, m) at ascending knots (K,), four or more.

    Not-a-knot at the ends (one cubic over the first two intervals, and one over the last two): the outer cubics go on
    beyond them. `natural`: no bending at the ends, and straight on beyond them.
    """
    return CubicSplines(knots, values, natural)(places)


class CubicSplines:
    """The splines of `cubic_spline` through values (K, m), to be asked at places more than once."""

    def __init__(self, knots: np.ndarray, values: np.ndarray, natural: bool = False):
        self._knots, self._values, self._natural = knots, values, natural
        self._slope = slope = spline_slopes(knots, values.T, natural).T
        width = np.diff(knots)[:, None]
        secant = np.diff(values, axis=0) / width
        bend = (slope[:-1] + slope[1:] - 2 * secant) / width
        self._cubic, self._square = bend / width, (secant - slope[:-1]) / width - bend

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """(P, m) at places (P,)."""
        knots, slope = self._knots, self._slope
        inside = np.clip(places, knots[0], knots[-1]) if self._natural else places
        at = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
        x = (inside - knots[at])[:, None]
        found = ((self._cubic[at] * x + self._square[at]) * x + slope[at]) * x + self._values[at]
        if self._natural:
            found += (places - inside)[:, None] * np.where((places < knots[0])[:, None], slope[0], slope[-1])
        return np.asarray(found)


def spline_slopes(knots: np.ndarray, rows: np.ndarray, natural: bool = False) -> np.ndarray:
    """(m, K) slopes at ascending knots (K,), four or more, of the cubic splines through rows (m, K).

    From a tridiagonal system (de Boor, A Practical Guide to Splines, 1978, chapter IV); ends as in `cubic_spline`.
    """
    from scipy.linalg.lapack import dgtsv  # heavy to import, needed only once there is something to fit

    h = np.diff(knots)
    chord = np.diff(rows, axis=1) / h
    diagonal = np.concatenate(([h[1]], 2.0 * (h[:-1] + h[1:]), [h[-2]]))
    above, below = np.concatenate(([knots[2] - knots[0]], h[:-1])), np.concatenate((h[1:], [knots[-1] - knots[-3]]))
    right = np.empty_like(rows)
    right[:, 1:-1] = 3.0 * (h[1:] * chord[:, :-1] + h[:-1] * chord[:, 1:])
    for end, inner, wide in ((0, 1, above[0]), (-1, -2, below[-1])):
        bent = (h[end] + 2.0 * wide) * h[inner] * chord[:, end] + h[end] ** 2 * chord[:, inner]
        right[:, end] = 3.0 * chord[:, end] if natural else bent / wide
    if natural:
        diagonal[[0, -1]], above[0], below[-1] = 2.0, 1.0, 1.0
    return np.asarray(dgtsv(below, diagonal, above, right.T, overwrite_b=True)[3].T)


#: Less than glibc's largest threshold (32 MiB), which it would not raise.
_BLOCK = 30_000_000


def keep_freed_memory() -> None:
    """Let the C library keep what arrays give back for the next ones, instead of returning it to the system each time.

    glibc maps blocks above a threshold and hands back free memory above twice that; freeing a mapped block raises the
    threshold to its size (mallopt(3), M_MMAP_THRESHOLD). One block that is never touched does it, and costs nothing.
    Without it a tenth of the time of a search goes into fetching the same pages again. Elsewhere it does nothing.
    """
    bytes(_BLOCK)
