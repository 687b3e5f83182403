"""Linear algebra that NumPy lacks, and memory for arrays."""

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


def keep_freed_memory() -> None:
    """Let the C library keep what arrays give back for the next ones, instead of returning it to the system each time.

    glibc maps blocks above a threshold. Freeing a mapped block raises the threshold to its size (mallopt(3),
    M_MMAP_THRESHOLD): one untouched block is enough. Without it a search spends a tenth of its time fetching the same
    pages again. Elsewhere it does nothing.
    """
    bytes(30_000_000)  # below glibc's largest threshold, 32 MiB
