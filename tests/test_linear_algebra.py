"""Eigenvalues of symmetric matrices, also where the usual method gives up, and threads of linear algebra."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from threadpoolctl import threadpool_info, threadpool_limits

from agent.core import InputError, symmetric_eigen
from agent.diagnosis import diagnose
from agent.estimation import estimate
from tests.small_arms import make_arm


@given(st.integers(1, 12), st.integers(0, 2**31), st.floats(0, 8))
def test_eigenvalues_and_eigenvectors_reproduce_the_matrix(size, seed, decades):
    rng = np.random.default_rng(seed)
    turned, _ = np.linalg.qr(rng.normal(size=(size, size)))
    values = np.sort(10.0 ** -rng.uniform(0, decades, size))
    found, vectors = symmetric_eigen((turned * values) @ turned.T)
    assert found == pytest.approx(values, abs=1e-14)
    assert (vectors * found) @ vectors.T == pytest.approx((turned * values) @ turned.T, abs=1e-14)


def test_falls_back_if_a_method_does_not_converge(monkeypatch):
    def gives_up(matrix):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    matrix = np.array([[2.0, 1.0], [1.0, 2.0]])
    monkeypatch.setattr(np.linalg, "eigh", gives_up)
    values, vectors = symmetric_eigen(matrix)
    assert values == pytest.approx([1, 3])
    assert (vectors * values) @ vectors.T == pytest.approx(matrix)


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.mark.parametrize("work", [estimate, diagnose])
def test_calls_from_python_solve_small_systems_on_one_thread_and_leave_threads_as_they_were(work):
    class Logs(list):
        def __len__(self):
            during.append(blas_threads())
            return 0

    during = []
    with threadpool_limits(2, "blas"):
        with pytest.raises(InputError, match="no logs"):
            work(make_arm("RR"), Logs())
        assert blas_threads() == {2}
    assert during == [{1}]
