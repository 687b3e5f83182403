"""Linear algebra that a library leaves undone."""

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
