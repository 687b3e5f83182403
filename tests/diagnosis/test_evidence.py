"""What is said about chance and about the smallest effect, against runs in which signs and effects are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from agent.diagnosis.candidate import Candidate
from agent.diagnosis.evidence import Null, null_gains, practical_parameters, share_intervals
from agent.diagnosis.fit import Fit
from agent.diagnosis.limits import LIMITS
from agent.model.effects import CATALOGUE

WATCHED = (("friction_change", (1,)), ("stribeck", (1,)), ("gravity_spring", (2,)), ("torque_constant", (0,)))


@pytest.fixture(scope="module")
def fit(diagnosed) -> Fit:
    """Of the run without an effect."""
    return diagnosed(0).dataset.fit


@pytest.fixture(scope="module")
def candidates(fit) -> list[Candidate]:
    return fit.candidates(
        [
            (CATALOGUE[name], joints, settings)
            for name, joints in WATCHED
            for settings in CATALOGUE[name].settings(fit, joints)
        ]
    )


def redrawn(fit: Fit, rng: np.random.Generator, candidate: Candidate | None = None, values: float | np.ndarray = 0.0):
    """The fit to a background of other signs, with an effect added."""
    error = np.nan_to_num(fit.out_of_fold() / fit.sigma)
    error /= np.maximum(np.sqrt(np.mean(error**2, axis=0)), 1.0)
    error *= rng.choice((-1.0, 1.0), int(fit.block.max()) + 1)[fit.block][:, None]
    for joint, block in candidate.blocks.items() if candidate else ():
        error[:, joint] += block @ values
    rows = [np.column_stack([part[:, :-1], error[:, joint]]) for joint, part in enumerate(fit.rows)]
    return Fit(
        fit.reference, fit.signals, rows, fit.index, fit.sigma, fit.precision, fit.shift,
        fit.cell, fit.block, fit.folds, fit.single,
    )  # fmt: skip


def test_a_gain_under_drawn_signs_is_the_gain_that_a_fit_to_them_has(fit, candidates):
    null = null_gains(fit, candidates)
    other = redrawn(fit, np.random.default_rng(5))
    again = null_gains(other, candidates)
    for candidate in candidates:
        low, high = np.quantile(null.own[candidate], (0.0, 1.0))
        spread = high - low
        (score,) = other.score([other.candidate(candidate.effect, candidate.joints, candidate.settings)])
        assert low - spread < score.gain < high + spread
        assert np.median(again.own[candidate]) == pytest.approx(np.median(null.own[candidate]), abs=spread)


def test_chance_falls_with_the_gain_and_never_reaches_nought(fit, candidates):
    null = null_gains(fit, candidates)
    chances = [null.p_value(gain) for gain in (-np.inf, 0.5 * null.threshold, null.threshold, 1e9)]
    assert chances[0] == 1.0
    assert chances == sorted(chances, reverse=True)
    assert 0 < chances[-1] <= LIMITS.false_alarms
    assert chances[-2] <= LIMITS.false_alarms + 1 / len(null.highest)


def test_p_values_are_uniform_where_gain_and_draws_are_exchangeable():
    """Of 100 equal draws, each against the other 99: every multiple of 1 % once, the largest gain the smallest."""
    gains = np.random.default_rng(0).gamma(2.0, size=100)
    found = [Null(np.delete(gains, k), {}, {}, {}).p_value(gain) for k, gain in enumerate(gains)]
    assert np.sort(found) == pytest.approx(np.arange(1, 101) / 100)
    assert np.argmin(found) == np.argmax(gains)


def test_a_smaller_threshold_is_passed_by_a_smaller_effect(fit, candidates):
    null = null_gains(fit, candidates)
    for candidate in candidates:
        sizes = [null.minimum_detectable_size(candidate, factor * null.threshold) for factor in (1, 4, 16)]
        assert sizes == sorted(sizes)
        assert sizes[2] == pytest.approx(4 * sizes[0], rel=0.8)


def test_the_interval_of_a_share_holds_it_and_closes_where_one_joint_has_all():
    rng = np.random.default_rng(1)
    rows = rng.normal(size=(3000, 3)) * [3.0, 1.0, 1.0]
    block = np.arange(3000) // 100
    interval = share_intervals(rows, np.zeros(3), block)
    share = np.mean(rows**2, axis=0) / np.mean(rows**2, axis=0).sum()
    assert np.all((interval[:, 0] <= share) & (share <= interval[:, 1]))
    alone = share_intervals(rows * [1.0, 0.0, 0.0], np.zeros(3), block)
    assert alone[0] == pytest.approx([1.0, 1.0])


@pytest.mark.verify
def test_the_smallest_size_is_found_as_often_as_is_said(fit, candidates, measured):
    null = null_gains(fit, candidates)
    rng = np.random.default_rng(8)
    for name, joints in WATCHED:
        mine = [c for c in candidates if c.place == (name, joints)]
        candidate = min(mine, key=lambda c: null.minimum_detectable_size(c, null.threshold))
        values = null.minimum_detectable_size(candidate, null.threshold) * practical_parameters(fit, candidate)
        draws = 60
        found = 0
        for _ in range(draws):
            other = redrawn(fit, rng, candidate, values)
            (score,) = other.score([other.candidate(candidate.effect, joints, candidate.settings)])
            found += score.gain > null.threshold
        share = found / draws
        ok = abs(share - LIMITS.power) < 0.16
        measured(f"{name}: the smallest size is found", share, "", f"about {LIMITS.power:g}", ok)
        assert ok


@pytest.mark.verify
def test_nothing_is_found_in_nothing_more_often_than_is_said(fit, candidates, measured):
    null = null_gains(fit, candidates)
    rng = np.random.default_rng(9)
    draws = 150
    alarms = 0
    for _ in range(draws):
        other = redrawn(fit, rng)
        tried = other.candidates([(c.effect, c.joints, c.settings) for c in candidates])
        alarms += max(score.gain for score in other.score(tried)) > null.threshold
    ok = alarms <= 6
    measured("gains above the threshold where there is nothing", alarms / draws, "", "about 0.01", ok)
    assert ok
