"""Linear algebra that NumPy lacks, and threads and memory for it."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from statistics import NormalDist
from typing import Any, ParamSpec, TypeVar

import numpy as np

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

#: Half of a 95 % interval of a normal error, in standard deviations.
NORMAL_95 = NormalDist().inv_cdf(0.975)


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


def one_blas_thread() -> AbstractContextManager[object]:
    """Linear algebra on one thread inside: the last bits depend on how many there are."""
    return _thread_pools().limit(limits=1)


def on_one_blas_thread(work: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Decorator of functions that solve thousands of small systems: threads would take longer to share each of them
    than to solve it, five times as long where other programs run."""

    @functools.wraps(work)
    def on_one_thread(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with one_blas_thread():
            return work(*args, **kwargs)

    return on_one_thread


@functools.cache
def _thread_pools() -> Any:
    # Finding the pools takes milliseconds, limiting them microseconds.
    import scipy.linalg  # noqa: F401  its own BLAS must be loaded to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
