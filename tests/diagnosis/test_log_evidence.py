"""Log evidence by second moments and Schur complements, against normal densities of all rows written out."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest

from agent.diagnosis.hypotheses import noise_model, pool
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.hypotheses.noise_model import HealthyForm, NoiseModel, smooth_columns
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.fit import Fit
from agent.model import CATALOGUE
from tests.synthetic_fit import NOMINAL, PERIOD, shape, synthetic_fit, synthetic_form, written_out

STEP, ROWS = 2, 110  # of 16 ms one row is kept
WEIGHT = 0.4  # independent rows, of those kept
THE_LAW = replace(LAW, error_correlation_time=STEP * PERIOD / WEIGHT)
FORMS = (
    (shape("offset"), (1,)),
    (shape("ripple", nonlinear=2), (0,), 3),
    (shape("payload", nonlinear=1), (), 2, np.array([[3.0, 1.0], [1.0, 2.0]])),
    (shape("spring", usual=True), (1,), 2),
    (shape("contact", transient=True), ()),
    (shape("tilt", usual=True), (), 2),  # whose second column acts on the first joint alone
)
#: Effects, and joints with something else and its size.
HYPOTHESES = (
    *(((0,), {}), ((1,), {}), ((3, 0), {0: 0.06}), ((1, 2), {1: 0.02})),
    *(((5, 4), {}), ((), {0: 0.06}), ((2, 4, 0), {})),
)


class Written:
    """All rows of the first joint and then of the second, and what model, noise model and forms have on them."""

    def __init__(self, fit: Fit, forms: Sequence[Candidate], healthy: Sequence[HealthyForm] | None):
        self.fit, self.forms, self.sigma = fit, forms, fit.sigma[::STEP].T
        whole, spans = written_out(fit, forms)
        whole = whole[:, ::STEP]
        self.log, self.base = np.repeat([0, 1], [60, 50]), self.sigma.min(axis=1)
        self.columns, self.effects = whole[..., :5].reshape(-1, 5), [whole[..., span] for span in spans]
        self.size = [np.sqrt(np.mean((one * self.sigma[..., None]) ** 2, axis=1)) for one in self.effects]  # N·m
        self.learned = learned = fit.keeps_parameters and not fit.reference.model.of_file
        covariance = np.linalg.inv(fit.precision)
        self.friction = [2] if learned else []  # not the offset, and not what is zero
        self.prior = covariance.copy()
        self.prior[self.friction, self.friction] += (THE_LAW.daily * fit.reference.model.values[self.friction]) ** 2
        self.start = self.prior @ fit.prior_information
        self.rest = whole[..., -1].ravel() - self.columns @ self.start
        parts = [[getattr(s, name)[s.kept] for s in fit.signals] for name in ("time", "q", "qd", "qdd")]
        time, *motion = (np.concatenate(part)[::STEP] for part in parts)
        self.common, self.of_log, self.share = [], [], []
        for j, sigma in enumerate(self.sigma):
            smooth = smooth_columns(*(part[:, j] for part in motion), time, self.log) * (self.base[j] / sigma)[:, None]
            usual = [k for k, form in enumerate(forms) if form.effect.usual and healthy is None]
            self.common.append(np.hstack([smooth, *(self.base[j] * self.alike(k, j) for k in usual)]))
            alone = learned * whole[j, :, :5] @ covariance @ whole[j, :, :5].T
            blocks = [self.effects[forms.index(one.candidate)][j] * one.amount for one in healthy or ()]
            energy = [np.sum(block**2) for block in blocks]  # of what they have together, no more than the largest
            self.share.append(np.sqrt(max(energy, default=0) / max(sum(energy), 1e-9)))
            alone = alone + sum(block @ block.T for block in blocks) * self.share[j] ** 2
            self.of_log.append(alone * (self.log[:, None] == self.log))

    def alike(self, number: int, joint: int) -> np.ndarray:
        """(S, k) columns of a form that are not zero, each with a root mean square of 1 N·m."""
        size = self.size[number][joint]
        return self.effects[number][joint][:, size > 0] / size[size > 0]

    def effect(self, number: int) -> np.ndarray:
        """(2 S, k) columns of a form."""
        return self.effects[number].reshape(2 * ROWS, -1)

    def over_noise(self, torque: np.ndarray) -> np.ndarray:
        """(2,) root mean square of torque over σ (2 S,)."""
        return np.sqrt(np.mean(torque.reshape(2, -1) ** 2, axis=1))

    def rms(self, number: int) -> np.ndarray:
        """(k,) torque over nominal of each column, on the joint with most."""
        return (self.size[number] / NOMINAL[:, None]).max(axis=0)

    def spread(self, number: int, size: float) -> np.ndarray:
        """(k, k) prior covariance of the parameters of a form."""
        prior = self.forms[number].prior
        return np.linalg.inv(np.diag((self.rms(number) / size) ** 2) + (0 if prior is None else prior))

    def noise(self, scales, free=None, form=(0.0, 0.0)) -> np.ndarray:
        """(2 S, 2 S) covariance of errors and noise model."""
        unit, found = NOMINAL / self.base, np.zeros((2, ROWS, 2, ROWS))
        for j, (common, of_log) in enumerate(zip(self.common, self.of_log, strict=True)):
            known = max(scales[j], self.fit.reference.model.noise_share[j]) if self.learned else scales[j]
            variance = known * THE_LAW.systematic**2 + (THE_LAW.drift * unit[j]) ** 2
            variance += THE_LAW.form_error**2 * form[j]
            variance += ((free or {}).get(j, 0.0) * unit[j]) ** 2
            found[j, :, j] = variance * common @ common.T + of_log + scales[j] / WEIGHT * np.eye(ROWS)
        return found.reshape(2 * ROWS, -1)

    def density(self, covariance: np.ndarray) -> float:
        """Log of the residual's normal density, but for π."""
        return -0.5 * float(self.rest @ np.linalg.solve(covariance, self.rest) + np.linalg.slogdet(covariance)[1])

    def cost(self, number: int) -> float:
        return 0.5 * np.log(WEIGHT * ROWS) * self.forms[number].effect.nonlinear

    def evaluate(self, effects, free, scales=(1.0, 1.0), refit=True, nothing=True) -> SimpleNamespace:
        """As `Evidence.evaluate`; `nothing`: whether the hypothesis without effects is known already."""
        law, scales, form, sizes = THE_LAW, np.array(scales), np.zeros(2), [LAW.sizes[1]] * len(effects)
        columns, count = [self.effect(k) for k in effects], WEIGHT * ROWS
        touched = sorted({j for k in effects for j in self.forms[k].blocks} | set(free))
        if refit and nothing:
            scales[touched] = np.minimum(scales[touched], 1)
        for fitting in [True] * (3 if nothing else 4) + [False]:
            spreads = [self.spread(k, size) for k, size in zip(effects, sizes, strict=True)]
            own = self.columns @ self.prior @ self.columns.T
            told = sum((z @ spread @ z.T for z, spread in zip(columns, spreads, strict=True)), own)
            plain = np.diag(np.repeat(scales, ROWS)) / WEIGHT
            whole = self.noise(scales, free, form) + told
            pull, alone = np.linalg.solve(whole, self.rest), np.linalg.solve(plain + told, self.rest)
            change = self.prior @ self.columns.T @ pull
            values = [spread @ z.T @ pull for z, spread in zip(columns, spreads, strict=True)]
            torque = [z @ value for z, value in zip(columns, values, strict=True)]
            if not fitting:
                break
            each = [(self.over_noise(one) * self.base / NOMINAL).max() for one in torque]
            sizes = [min(law.sizes, key=lambda size, one=one: abs(np.log(size / one))) for one in each]
            moved = self.over_noise(self.columns[:, self.friction] @ (self.start + change)[self.friction]) ** 2
            form = sum((self.over_noise(one) ** 2 for one in torque), moved)
            error = self.over_noise(plain @ pull) ** 2
            for j in (touched if nothing else (0, 1)) if refit else ():
                scales[j] = max((law.nu + count * error[j]) / (law.nu + count), 0.2)
        log = self.density(whole) + 0.5 * self.start @ self.fit.prior_information  # as the prior's own is left out
        log += 0.5 * (1 - WEIGHT) * ROWS * np.sum(np.log(scales)) - ROWS * np.log(WEIGHT)
        log -= 0.5 * np.sum((law.nu + 2) * np.log(scales) + law.nu / scales)
        usual = np.diag(self.noise((1, 1))).reshape(2, -1).mean(axis=1) + 1 - 1 / WEIGHT
        remains = self.over_noise(sum(torque, self.columns @ change) - self.rest) ** 2
        return SimpleNamespace(
            log=log - sum(map(self.cost, effects)) - np.log(3) * len(free),
            scales=scales,
            mean=np.concatenate([self.start + change, *values]),
            torque=[self.lasting(k, z @ s @ z.T @ alone) for k, z, s in zip(effects, columns, spreads, strict=True)],
            unexplained=np.maximum(remains - usual, 0) * (self.base / NOMINAL) ** 2,
            whole=whole,
            of=(effects, free),
        )

    def lasting(self, number: int, torque: np.ndarray) -> dict[int, float]:
        """Torque over nominal, in the log with most of it, while it lasts, from that over σ (2 S,)."""
        torque = torque.reshape(2, -1) * self.sigma / NOMINAL[:, None]
        lasts = np.any(self.effects[number] != 0, axis=2) | (not self.forms[number].transient)
        each = {j: [torque[j][lasts[j] & (self.log == log)] for log in (0, 1)] for j in self.forms[number].blocks}
        return {j: max(np.sqrt(np.mean(one**2)) for one in parts if len(one)) for j, parts in each.items()}


@pytest.fixture(params=["healthy", "drawn", "file"])
def case(request):
    """Evidence on a model whose healthy arm is known, on one fitted to the same data, and on a simulator's file."""
    fit = synthetic_fit(request.param != "drawn", request.param == "file")
    forms = [synthetic_form(fit, *form) for form in FORMS]
    forms[5].blocks[1][:, 1] = 0
    forms[3].blocks[1] *= 1e-3 * (np.arange(len(fit.cell_of_row)) % 40 > 10)[:, None]
    left = [rows[:, -1] + 3 * rows[:, 1:3].sum(axis=1) for rows in fit.rows]  # also of friction on another day
    for number, size in ((0, 1.0), (2, 0.6), (4, 2.5)):
        for joint, block in forms[number].blocks.items():
            left[joint] += size * block.sum(axis=1)
    fit = fit.with_residual(np.stack(left, axis=1) * ([1, 0.05] if request.param == "file" else 1))
    each = {k: np.linspace(0.05, 0.1, len(forms[k].names)) for k in (1, 4, 5)}
    amounts = [HealthyForm(forms[k], amount, 0 * amount, amount) for k, amount in each.items()]
    healthy = {"healthy": amounts, "drawn": None, "file": ()}
    with patch.object(pool, "_AT_ONCE", 1):
        evidence = Evidence(fit, forms, healthy[request.param], THE_LAW)
    return evidence, Written(fit, forms, healthy[request.param])


def same(seen, written) -> None:
    assert (seen.effects, seen.uncatalogued_sizes) == written.of
    assert seen.log_evidence == pytest.approx(written.log, abs=5e-4)
    np.testing.assert_allclose(seen.scales, written.scales, rtol=1e-5)
    np.testing.assert_allclose(seen.mean, written.mean, rtol=1e-4, atol=5e-3)
    np.testing.assert_allclose(np.concatenate([*seen.values, [0]]), [*written.mean[5:], 0], rtol=1e-4, atol=1e-6)
    assert list(seen.torque_per_joint) == [pytest.approx(one, rel=1e-3) for one in written.torque]
    assert seen.largest_torque == pytest.approx([max(one.values()) for one in written.torque], rel=1e-3)
    assert seen.unexplained == pytest.approx(written.unexplained, rel=1e-4, abs=1e-9)


@pytest.mark.parametrize(("effects", "free"), [((), {}), *HYPOTHESES])
def test_log_evidence_is_the_density_of_all_rows(case, effects, free):
    """With scales that are fitted, or kept, or none above that of the noise model."""
    evidence, written = case
    scales = evidence.null_hypothesis.scales
    same(evidence.null_hypothesis, written.evaluate((), {}, nothing=False))
    assert evidence.evaluate(()).log_evidence == pytest.approx(evidence.null_hypothesis.log_evidence)
    same(evidence.evaluate(effects, free), written.evaluate(effects, free, evidence.null_hypothesis.scales))
    same(evidence.evaluate(effects, free, scales), written.evaluate(effects, free, scales))
    for given in (scales, np.array([1.2, 1.5]), np.array([3.0, 0.7])):
        seen = evidence.evaluate(effects, free, given, refit=False)
        same(seen, written.evaluate(effects, free, given, refit=False))
        below = evidence.as_expected(seen)
        same(below, written.evaluate(effects, free, np.minimum(given, 1), refit=False))
        assert evidence.as_expected(below) is below


@pytest.mark.parametrize(("effects", "free"), HYPOTHESES)
def test_what_a_form_adds_is_the_ratio_of_two_densities(case, effects, free):
    """At its likeliest size, with a hypothesis as it is; forms that were added since count as well."""
    evidence, written = case
    scales = evidence.null_hypothesis.scales
    seen, base = evidence.evaluate(effects, free), written.evaluate(effects, free, scales)
    for _ in range(2):
        gains, values = evidence.shortlist_gains(seen)
        for k in set(range(len(FORMS))) - set(effects):
            added = {}
            for size in evidence.sizes:
                part = written.spread(k, size) @ written.effect(k).T
                whole = base.whole + written.effect(k) @ part
                gain = written.density(whole) - written.density(base.whole) - written.cost(k)
                added[gain] = part @ np.linalg.solve(whole, written.rest)
            assert gains[k] == pytest.approx(max(added), abs=1e-4)
            np.testing.assert_allclose(values[k], added[max(added)], rtol=1e-3, atol=1e-5)
    evidence.pool.add([synthetic_form(written.fit, *FORMS[0])])
    assert evidence.shortlist_gains(seen)[0][-1] == pytest.approx(gains[0], abs=1e-4)


def test_information_is_that_of_all_rows_under_the_noise_model(case):
    evidence, written = case
    chosen, scales = (2, 0, 4), np.minimum(evidence.null_hypothesis.scales, 1)
    total, prior, ends = evidence.information([written.forms[k] for k in chosen])
    whole = np.hstack([written.columns, *map(written.effect, chosen)])
    expected = whole.T @ np.linalg.solve(written.noise(scales), whole)
    np.testing.assert_allclose(total, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
    assert ends.tolist() == [5, 7, 8, 9]
    spreads = [written.prior, *(written.spread(k, LAW.sizes[-1]) for k in chosen)]
    for spread, (a, b) in zip(spreads, pairwise([0, *ends]), strict=True):
        np.testing.assert_allclose(np.linalg.inv(prior[a:b, a:b]), spread, rtol=1e-5)
        assert not prior[a:b, :a].any()
    rows, free = np.random.default_rng(3).normal(size=(2, 30, 3))
    weight, variance = 0.1 / THE_LAW.error_correlation_time, evidence.noise.variance(1, scales[1], 0.0, {})
    errors = scales[1] / weight * np.eye(30) + variance * free @ free.T
    np.testing.assert_allclose(evidence.information_of_rows(1, rows, free, 0.1), rows.T @ np.linalg.solve(errors, rows))


def test_the_smallest_size_that_would_be_named_outweighs_the_prior(case):
    evidence, written = case
    sure, prior = LAW.sure / LAW.confidence, (1 - LAW.unlikely) / len(CATALOGUE) / 2
    assert evidence.naming_threshold(True) == pytest.approx(np.log(sure / (1 - sure) / prior))
    assert evidence.naming_threshold(False) == pytest.approx(np.log(10))
    base = written.evaluate((), {}, np.minimum(evidence.null_hypothesis.scales, 1), refit=False)
    idle = evidence.pool.numbers([replace(written.forms[4], blocks=one) for one in ({}, {0: np.zeros((2 * ROWS, 1))})])
    *sizes, one, other = evidence.smallest_sizes()
    assert (min(one, other) > 1e5, len(sizes)) == (True, len(FORMS))
    assert [evidence.evaluate([k]).largest_torque for k in idle] == [(0.0,), (0.0,)]
    for k, size in enumerate(sizes):
        unit = written.effect(k) / written.rms(k)  # of nominal torque each
        information = unit.T @ np.linalg.solve(base.whole, unit)
        more, count = np.linalg.slogdet(np.eye(len(information)) + LAW.sizes[1] ** 2 * information)[1], len(information)
        power = 0.8416212 + np.sqrt(2 * (written.cost(k) + evidence.naming_threshold(True)) + more)
        assert size == pytest.approx(power / np.sqrt(information.sum() / count), rel=1e-4)


def test_forms_are_known_by_number(case):
    evidence, written = case
    known, size = evidence.pool, evidence.pool.size
    other = synthetic_form(written.fit, shape("hose"), (0,), 2)
    assert known.numbers([written.forms[3], written.forms[1], other]) == [3, 1, size]
    assert (known.size, known.candidate(size)) == (size + 1, other)
    count = known.count_parameterisations
    assert [count(place) for place in (("hose", (0,)), ("hose", (1,)), ("offset", (1,)))] == [1, 0, 1]
    np.testing.assert_allclose(known.unit_torque(other) * known.rms(size), 1 / np.sqrt(2))
    for values, fine in (((0.5, 9.0), True), ((1.5, 0.0), False), ((-2.0, 0.0), False)):
        assert evidence.possible(size, np.array(values)) == fine


def test_how_far_an_effect_is_from_the_baselines():
    """In torque on the joint with most of the difference, next to what both parameters leave open."""
    fit = synthetic_fit()
    forms = [synthetic_form(fit, *form) for form in FORMS]
    known = HealthyForm(forms[5], np.full(2, 0.01), np.array([0.3, -0.1]), np.array([0.02, 0.05]))
    evidence = Evidence(fit, forms, [known, HealthyForm(forms[1], np.full(3, 0.01))], THE_LAW)
    one = evidence.evaluate((0, 5), {})
    own = np.linalg.inv(one.precision)[-2:, -2:] + np.diag(known.deviation**2)
    found = []
    for j in forms[5].blocks:
        columns = evidence.noise.thinned(forms[5], j).astype(float) * (fit.sigma[::STEP, j] / NOMINAL[j])[:, None]
        weights = fit.sigma[::STEP, j].min() / fit.sigma[::STEP, j]
        columns = columns * weights[:, None]
        away = np.sqrt(np.mean((columns @ (one.values[1] - known.mean)) ** 2))
        found.append((away, np.sqrt(np.trace(own @ columns.T @ columns) / len(columns))))
    assert evidence.distance_from_baseline(one, 1) == pytest.approx(max(found), rel=1e-3)
    assert evidence.distance_from_baseline(one, 0) is None
    assert evidence.distance_from_baseline(evidence.evaluate((1,), {}), 0) is None


def test_a_large_gap_adds_its_own_size_to_the_usual_ones(case):
    evidence, written = case
    for place, size in evidence.usual.items():
        (k,) = (k for k, form in enumerate(written.forms) if form.key == place)
        amount = np.linspace(0.05, 0.1, written.size[k].shape[1])
        torque = np.linalg.norm(amount * written.size[k], axis=1) / NOMINAL * written.share
        assert size == pytest.approx(np.max(torque), rel=1e-4)
    left = np.stack([rows[:, -1] for rows in written.fit.rows], axis=1)
    rows = written_out(written.fit, ())[0][:, ::STEP, -1] * written.sigma / NOMINAL[:, None]
    left = left / np.sqrt(np.mean(rows**2, axis=1)).max()
    for size, more in ((0.19, ()), (0.21, (pytest.approx(0.21, rel=1e-5),))):
        with patch.object(written.fit.reference.model, "values", np.zeros(5)):  # without friction
            none = Evidence(written.fit.with_residual(size * left), [], (), THE_LAW)
        assert none.sizes == (*LAW.sizes, *more)
        assert [len(found) for found in none.shortlist_gains(none.null_hypothesis)] == [0, 0]


def test_the_noise_model_trusts_no_form_beyond_a_limit_and_has_no_columns_that_the_logs_hardly_notice(case):
    written, fit = case[1], synthetic_fit(of_file=True)
    energy = WEIGHT * np.sum((written.alike(0, 1) * NOMINAL[1]) ** 2)
    amounts = np.sqrt(np.array([0, 0.0099, 0.0101]) / energy) * NOMINAL[1] / written.size[0][1]
    plain, less, more = (NoiseModel(fit, [], [HealthyForm(written.forms[0], one)], THE_LAW) for one in amounts)
    counts = [[noise.column_counts(j)[1] for j in range(2)] for noise in (plain, less, more)]
    assert [np.subtract(each, counts[0]).tolist() for each in counts[1:]] == [[0, 0], [0, 2]]
    with patch.object(noise_model, "ROW_SPACING", PERIOD):
        assert NoiseModel(fit, [], (), THE_LAW).rows == len(fit.cell_of_row)
    form = [plain.variance(1, 2.0, form, {}) - plain.variance(1, 2.0, 0.0, {}) for form in (39_000.0, 41_000.0)]
    assert form == pytest.approx([97.5, 100.0])


def test_smooth_columns_are_straight_between_nodes():
    """Of position, speed, acceleration, direction, and time of each log: a node each three seconds, three at least."""
    time, log = np.concatenate([np.linspace(0, 10.5, 200), np.linspace(5, 8, 90)]), np.repeat([0, 3], [200, 90])
    q, qd, qdd = np.cumsum(np.random.default_rng(2).normal(size=(3, 290)), axis=1) / 100
    top, logs = np.abs(qd).max(), np.stack([log == 0, log == 3], axis=1)
    turns = np.tanh(qd / (0.03 * top))[:, None]

    def hats(x: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
        nodes = np.linspace(low, high, count)
        return np.stack([np.interp(x, nodes, one) for one in np.eye(count)], axis=1)

    expected = [
        *(hats(q, q.min(), q.max(), 8), turns * hats(q, q.min(), q.max(), 5)),
        *(turns * hats(np.abs(qd), 0, top, 5), hats(np.abs(qd), 0, top, 4)),
        *(hats(qdd, qdd.min(), qdd.max(), 5), logs, turns * logs),
        *(hats(time, 0, 10.5, 4) * logs[:, :1], hats(time, 5, 8, 3) * logs[:, 1:]),
    ]
    np.testing.assert_allclose(smooth_columns(q, qd, qdd, time, log), np.hstack(expected), atol=1e-9)
    still = smooth_columns(np.ones(290), np.zeros(290), np.zeros(290), time, log)
    assert np.isfinite(still).all()
    assert still.shape == (290, 1 + 1 + 1 + 2 + 4 + 3)


def test_products_that_round_off_makes_indefinite_still_have_a_factor():
    """Of an effect far beyond the nominal torque, noise explains nearly all of a column."""
    size = np.array([1.0, 1e3, 1e9])
    alike = np.array([[1.0, 0.3, 1.0 + 1e-5], [0.3, 1.0, 0.3], [1.0 + 1e-5, 0.3, 1.0]])
    assert np.linalg.eigvalsh(alike)[0] < -1e-6
    lower = noise_model.scaled_cholesky(alike * np.outer(size, size), 1 / size)
    assert np.allclose(lower @ lower.T, alike, atol=1e-4)
