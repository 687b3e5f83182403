"""Linear algebra and splines that NumPy and SciPy lack, and memory for arrays."""

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


class CubicSplines:
    """Cubic splines through values (K, m) at ascending knots (K,), four or more.

    Not-a-knot at the ends (one cubic over the first two intervals, and one over the last two): the outer cubics go on
    beyond them. `natural`: no bending at the ends, and straight on beyond them.
    """

    def __init__(self, knots: np.ndarray, values: np.ndarray, natural: bool = False):
        from scipy.interpolate import CubicSpline  # heavy to import, needed only once there is something to fit

        self._ends, self._natural = (knots[0], knots[-1]), natural
        self._spline = CubicSpline(knots, values, bc_type="natural" if natural else "not-a-knot")

    def __call__(self, places: np.ndarray) -> np.ndarray:
        """(P, m) at points (P,)."""
        if not self._natural:
            return np.asarray(self._spline(places))
        inside = np.clip(places, *self._ends)
        return np.asarray(self._spline(inside) + (places - inside)[:, None] * self._spline(inside, 1))


def keep_freed_memory() -> None:
    """Let the C library keep what arrays give back for the next ones, instead of returning it to the system each time.

    glibc maps blocks above a threshold. Freeing a mapped block raises the threshold to its size (mallopt(3),
    M_MMAP_THRESHOLD): one untouched block is enough. Without it a search spends a tenth of its time fetching the same
    pages again. Elsewhere it does nothing.
    """
    bytes(30_000_000)  # below glibc's largest threshold, 32 MiB
