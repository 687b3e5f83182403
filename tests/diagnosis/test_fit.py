"""Fits by second moments of cells of rows, against least squares over the rows themselves."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows import moments
from agent.diagnosis.rows.candidate import Candidate, Fold
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE
from tests.synthetic_fit import PERIOD, shape, synthetic_fit, synthetic_form, written_out

REPEAT = 0.1 / PERIOD  # rows to an independent one
FORMS = (
    (shape("offset"), (1,)),
    (shape("ripple"), (0,), 3),
    (shape("payload"), (), 2, np.array([[30.0, 10.0], [10.0, 20.0]])),
    (shape("contact", transient=True), ()),
)
ALL = np.ones(4, dtype=bool)


@pytest.fixture(scope="module", params=[True, False], ids=["given", "drawn"])
def plain(request) -> Iterator[Fit]:
    with patch.object(moments, "_AT_ONCE", 2):
        yield synthetic_fit(request.param)


@pytest.fixture(scope="module", params=[(), (0,), (3,), (2, 0, 1, 3)])
def forms(plain, request) -> list[Candidate]:
    return [synthetic_form(plain, *FORMS[k]) for k in request.param]


def least_squares(fit: Fit, forms: Sequence[Candidate], train: np.ndarray = ALL) -> tuple[np.ndarray, np.ndarray]:
    """Precision (p + k, p + k) and parameters (p + k,) from rows of some cells."""
    rows, spans = written_out(fit, forms)
    rows, cell = rows.reshape(-1, rows.shape[-1]), np.tile(fit.cell_of_row, 2)
    prior = np.diag(1e-7 * np.sum(rows[cell >= 0, :-1] ** 2, axis=0) / REPEAT + 1e-12)
    prior[:5, :5] = fit.precision
    for form, span in zip(forms, spans, strict=True):
        prior[span, span] += 0 if form.prior is None else form.prior
    used = rows[train[cell] & (cell >= 0)]
    matrix = used[:, :-1].T @ used[:, :-1] / REPEAT + prior
    return matrix, np.linalg.solve(
        matrix, used[:, :-1].T @ used[:, -1] / REPEAT + np.append(fit.prior_information, 0 * prior[5:, 0])
    )


def left_by(fit: Fit, forms: Sequence[Candidate], parameters: np.ndarray) -> np.ndarray:
    """(S, 2) [N·m] that parameters leave."""
    return -(written_out(fit, forms, white=False)[0] @ [*parameters, -1]).T * fit.sigma


def held_out_error(fit: Fit, forms: Sequence[Candidate], folds: Sequence[Fold]) -> float:
    """Squared errors over σ of rows that are held out; guards are judged by none."""
    rows, parts = (
        written_out(fit, forms)[0],
        [(fold.test[fit.cell_of_row] & (fit.cell_of_row >= 0), fold.train) for fold in folds],
    )
    return sum(np.sum((rows[:, held] @ [*least_squares(fit, forms, train)[1], -1]) ** 2) for held, train in parts)


def close(seen, expected) -> None:
    np.testing.assert_allclose(seen, expected, rtol=1e-6, atol=1e-8)


def test_fits_are_least_squares_over_the_rows_that_are_not_held_out(plain, forms):
    fit = plain.with_chosen(forms)
    matrix, fitted = least_squares(fit, forms)
    inverse, parameters = fit.solve(ALL)
    np.testing.assert_allclose(inverse @ matrix, np.eye(len(matrix)), atol=1e-6)
    close(parameters, fitted)
    close(np.concatenate([fit.change, *fit.values]), fitted)
    assert [len(values) for values in fit.values] == [len(form.names) for form in forms]
    close(np.concatenate(fit.residuals), left_by(fit, forms, fitted))
    assert [len(part) for part in fit.residuals] == [len(part) for part in fit.sigmas] == [120, 50, 50]
    kept = np.append(fitted[:5] * (not fit.keeps_parameters), fitted[5:])
    close(np.concatenate(fit.residuals_as_given), left_by(fit, forms, kept))
    assert fit.count.tolist() == [2 * np.sum(fit.cell_of_row == k) for k in range(4)]
    assert fit.transient == any(form.transient for form in forms)
    inside = fit.whitening.inside(len(fit.cell_of_row))
    assert np.array_equal(fit.near_rest, inside | (fit.sigma > [0.81, 0.31]))
    assert inside.any()
    with patch("agent.diagnosis.rows.fit.LIMITS", replace(LIMITS, row_correlation_time=1e-3)):
        assert synthetic_fit().rows_per_independent == 1


@pytest.mark.parametrize("by_segments", [False, True])
def test_rows_that_are_held_out_are_judged_by_the_fit_to_the_others(plain, forms, by_segments, monkeypatch):
    fit, taken_out = plain.with_chosen(forms), range(len(forms))
    expected = [np.full(fit.sigma.shape, np.nan) for _ in (None, *taken_out)]
    folds, spans = fit.segment_folds if by_segments else fit.folds, written_out(fit, forms)[1]
    for fold in folds:
        fitted = least_squares(fit, forms, fold.train)[1]
        change, values = fit.fitted(fold)
        close(np.concatenate([change, *values]), fitted)
        held = fold.test[fit.cell_of_row] & (fit.cell_of_row >= 0)
        for left, span in zip(expected, (slice(0, 0), *spans), strict=True):
            some = fitted.copy()
            some[span] = 0
            left[held] = left_by(fit, forms, some)[held]
    monkeypatch.setattr(Fit, "transient", by_segments)
    assert fit.error == pytest.approx(held_out_error(fit, forms, folds))
    for number, left in zip((None, *taken_out), expected, strict=True):
        seen = fit.held_out(without=number)
        close(seen, left)
        assert not seen.flags.writeable


def test_another_residual_or_prior_is_as_if_all_was_made_anew(plain, forms):
    plain.with_chosen(forms[:1])  # whose moments are known
    left = np.random.default_rng(6).normal(size=plain.sigma.shape)
    for residual in (left, 2 * left):
        fit = plain.with_residual(left).with_chosen(forms).with_residual(residual)
        assert np.array_equal([rows[:, -1] for rows in fit.rows], residual.T)
        assert fit.chosen == ()
        chosen = fit.with_chosen(forms)
        close(chosen.error, held_out_error(fit, forms, chosen.test_folds))
        close(fit.with_chosen(forms[::-1]).solve(ALL)[1], least_squares(fit, forms[::-1])[1])
    tight = plain.with_chosen(forms).with_prior(4 * plain.precision)
    close(tight.change, least_squares(tight, ())[1])


def test_a_column_takes_as_much_energy_as_a_fit_with_it(forms):
    fit = synthetic_fit(guard=0).with_chosen(forms)

    def taken(forms: Sequence[Candidate]) -> tuple[float, float]:
        rows, _ = written_out(fit, forms)
        fitted = least_squares(fit, forms)[1]
        return fitted @ np.einsum("jsk,js->k", rows[..., :-1], rows[..., -1]), fitted[-1]

    for joint in range(2):
        columns = 1e-3 * np.random.default_rng(joint).normal(size=(len(fit.cell_of_row), 2))
        for column, *found in zip(columns.T, *fit.energy_taken(joint, columns), strict=True):
            more = {joint: column[:, None] / fit.sigma[:, [joint]]}
            both, factor = taken([*forms, replace(synthetic_form(fit, FORMS[0][0], (joint,)), blocks=more)])
            assert found == pytest.approx([both - taken(forms)[0], factor], rel=1e-4)
        assert np.array_equal(fit.energy_taken(joint, 0 * columns), np.zeros((2, 2))), "no column takes nothing"


def test_columns_are_made_once_and_anew_for_another_reference(plain):
    """A load that a motion carries stays."""
    offset = CATALOGUE["torque_offset"]
    first, second = plain.candidates([(offset, (0,), {}), (offset, (1,), {})])
    close(second.blocks[1] * plain.sigma[:, 1:], 1)
    assert plain.candidate(offset, (1,), {}) is second
    for chosen in ([], [first]):
        alone = plain.with_chosen([*chosen, second]).values[-1]
        assert plain.with_chosen(chosen).fit(offset, (1,), {}) == pytest.approx(alone, rel=1e-9)
    heavy, (one, two, three) = SimpleNamespace(**vars(plain.reference)), plain.signals
    loaded = Fit(replace(plain.data, signals=[one, replace(two, reference=SimpleNamespace(payload="a load")), three]))
    with patch(
        "agent.diagnosis.rows.fit.NominalModel", lambda *given: SimpleNamespace(given=given, coupling=np.eye(2))
    ):
        seen = loaded.with_reference(heavy)
    assert seen.reference is seen.signals[0].reference is heavy
    assert seen.signals[1].reference.given == (heavy.model, "a load")
    assert seen.candidate(offset, (1,), {}) is not second
