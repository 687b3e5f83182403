"""Sampling rate, gaps and jitter from stamps."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.estimation.signals.filtering import FilterSettings, motions, used_text
from agent.recording import read_log, sample_numbers, settled


@pytest.fixture
def log_at(tools, tmp_path):
    """A log with samples of one joint at given times [s]; position is a sine of time unless given."""

    def make(times, position=None):
        q = np.sin(np.asarray(times)) if position is None else position
        messages = [{"time": t, "names": ["a"], "position": [x], "effort": [x]} for t, x in zip(times, q, strict=True)]
        return read_log(tools.write_foreign(tmp_path / "log.mcap", messages))

    return make


def repair(log, beginning):
    return next(r for r in log.repairs if r.kind.startswith(beginning))


def test_a_gap_cuts_the_log_in_two(log_at):
    times = np.delete(np.arange(1000) / 500, slice(400, 450))
    log = log_at(times)
    assert log.segments == ((0, 400), (400, 950))
    assert log.sample_rate == pytest.approx(500)
    found = repair(log, "gap")
    assert found.count == 50
    assert found.time == pytest.approx(399 / 500)


def test_a_few_lost_samples_do_not_cut_the_log(log_at):
    times = np.delete(np.arange(1000) / 500, [100, 200, 201, 202, 500])
    log = log_at(times)
    assert log.segments == ((0, 995),)
    assert log.sample_rate == pytest.approx(500)
    assert sum(r.count for r in log.repairs if r.kind.startswith("missing samples")) == 5


def test_many_gaps_are_reported_in_one_line(log_at):
    lost = np.arange(20, 1000, 25)
    log = log_at(np.delete(np.arange(1000) / 500, lost))
    assert len(log.repairs) == 1
    assert log.repairs[0].count == len(lost)
    assert f"in {len(lost)} places" in log.repairs[0].kind


@pytest.mark.parametrize("rate", [50.0, 100.0, 500.0, 1000.0, 5000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.05, 0.3])
def test_the_rate_is_found_through_jitter_and_loss(log_at, rate, jitter):
    rng = np.random.default_rng(3)
    times = 1 + (np.arange(3000) + jitter * rng.uniform(-0.5, 0.5, 3000)) / rate
    log = log_at(np.delete(times, rng.choice(np.arange(1, 2999), 30, replace=False)))
    assert log.sample_rate == pytest.approx(rate, rel=1e-3)
    assert len(log.segments) == 1


def test_uneven_sampling_is_kept_and_reported(log_at):
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.001, 0.003, 2000))
    log = log_at(times)
    np.testing.assert_allclose(log.t, times - times[0], atol=1e-9)
    assert log.sample_rate == pytest.approx(500, rel=0.02)
    assert len(log.segments) == 1
    assert repair(log, "uneven intervals").count > 1000


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.verify) for seed in range(2, 6))])
@pytest.mark.parametrize("rate", [250.0, 800.0, 2000.0])
def test_keeps_plausible_uneven_stamps_with_rounded_positions(log_at, rate, seed):
    """Correlated intervals of 0.7 to 2.1 periods, counted in tenths, keep no grid though they vary about one value."""
    rng = np.random.default_rng(seed)
    slow = np.convolve(rng.normal(size=8010), [0.5, 0.3, 0.2], "valid")[:8000]
    interval = np.round(np.clip(1 + 0.35 * slow + rng.exponential(0.1, 8000), 0.7, 2.1), 1) / rate
    times = np.cumsum(interval)
    log = log_at(1 + times, np.round(0.5 * np.sin(0.005 * rate * times), 4))
    assert log.sample_rate == pytest.approx(1 / np.median(interval))
    assert not [r for r in log.repairs if "missing" in r.kind]
    (motion,) = motions(log, FilterSettings(0.01 * rate), reduce=False)
    true = -0.5 * (0.005 * rate) ** 2 * np.sin(0.005 * rate * (motion.time[motion.kept] + times[0]))
    assert np.std(motion.low_pass(motion.qdd)[:, 0] - true) < 0.01 * np.std(true)


def test_stamps_rounded_to_milliseconds_are_not_gaps(log_at):
    log = log_at(np.round(np.arange(2000) / 700, 3))
    assert log.sample_rate == pytest.approx(700, rel=1e-3)
    assert len(log.segments) == 1


def test_samples_that_share_a_coarse_stamp_are_spread(log_at):
    true = np.arange(5000) / 5000
    log = log_at(np.floor(true * 1000) / 1000, position=np.sin(40 * true))
    np.testing.assert_allclose(log.t, true, atol=1e-8)
    assert log.sample_rate == pytest.approx(5000)
    assert repair(log, "samples share a stamp").count == 4000


def test_refuses_constant_stamps(log_at):
    with pytest.raises(InputError, match=r"log.mcap: the stamps stand still at 7.000000 s \(100 samples\)"):
        log_at(np.full(100, 7.0), position=np.arange(100))


def test_refuses_two_recordings_in_one_log(log_at):
    times = np.arange(1000) / 500
    q = np.concatenate([np.arange(1000), 5000 + np.arange(600)])
    with pytest.raises(InputError, match=r"log.mcap: the controller's clock was set back.*sample 1000 on"):
        log_at(np.concatenate([times, times[:600] + 0.0005]), position=q)


@pytest.mark.parametrize("lag", [0.1, 1.0, 50.0])
def test_a_clock_that_is_set_back_once_is_a_cut(log_at, lag):
    true = 200 + np.arange(1500) / 500
    log = log_at(np.where(true < 202, true, true - lag), position=np.sin(true))
    assert log.segments == ((0, 1000), (1000, 1500))
    np.testing.assert_array_equal(log.position[:, 0], np.sin(true))
    assert repair(log, f"the clock was set back by {lag - 0.002:.6g} s, cut there").time == pytest.approx(1.998)


@pytest.mark.parametrize("whole", [2.0**32 * 1e-6, 2.0**16 * 1e-3, 86_400.0, 3_600.0])
@pytest.mark.parametrize("lost", [0, 3])
def test_a_clock_that_wraps_goes_on(log_at, whole, lost):
    true = whole - 5 + np.arange(1000) / 100
    kept = np.delete(np.arange(1000), np.arange(500, 500 + lost))
    log = log_at(true[kept] % whole, position=np.sin(true)[kept])
    np.testing.assert_allclose(log.t, true[kept] - true[0], atol=1e-6)
    np.testing.assert_array_equal(log.position[:, 0], np.sin(true)[kept])
    assert repair(log, "stamps that start again").count == 1


@pytest.mark.parametrize("size", [5, 10, 40])
def test_stamps_of_arrival_are_spread_evenly(log_at, size):
    rng = np.random.default_rng(1)
    true = np.arange(2000) / 200
    burst = np.arange(2000) // size
    arrival = (
        (burst + 1) * size / 200
        + rng.uniform(0, 0.02, 2000 // size)[burst] * size / 200
        + np.arange(2000) % size * 1e-4
    )
    begun = 4 * size // 5  # the recorder is started in the middle of a burst
    log = log_at(arrival[begun:], position=np.sin(true)[begun:])
    assert log.sample_rate == pytest.approx(200, rel=2e-3)
    assert len(log.segments) == 1
    assert repair(log, f"stamps of arrival, {size} at a time every {size / 200:.3g} s").count == 2000 - begun


def test_bursts_that_were_sampled_as_bursts_stay(log_at):
    """Ten samples at 2 kHz every 0.1 s: the arm stands still between neither of them."""
    true = np.arange(200).repeat(10) * 0.1 + np.tile(np.arange(10), 200) * 5e-4
    log = log_at(true, position=np.sin(true))
    np.testing.assert_allclose(log.t, true, atol=1e-8)


def test_halves_in_the_wrong_order_are_sorted(log_at):
    times = np.arange(1000) / 500
    log = log_at(np.roll(times, 500))
    np.testing.assert_allclose(log.t, times, atol=1e-9)
    assert repair(log, "stamps out of order").count == 1


def test_a_stamp_of_another_clock_is_dropped(log_at):
    times = 1.7e9 + np.arange(1000) / 500
    times[0] = 0.0
    log = log_at(times)
    assert len(log.t) == 999
    assert log.t[-1] == pytest.approx(1.996)
    assert repair(log, "samples with stamps far off").count == 1


@settings(max_examples=100, deadline=None)
@given(
    st.floats(20, 5000),
    st.lists(st.tuples(st.integers(1, 1999), st.floats(1, 300)), max_size=4, unique_by=lambda gap: gap[0]),
)
def test_segments_cover_the_log_and_hold_no_gap(rate, gaps):
    from agent.recording.repair.stamps import spacing_of

    interval = np.full(1999, 1 / rate)
    for place, factor in gaps:
        interval[place - 1] *= factor
    stamp = np.rint(1e9 * np.concatenate([[0.0], np.cumsum(interval)])).astype(np.int64)
    spacing = spacing_of(stamp)
    assert spacing.rate == pytest.approx(rate, rel=1e-2)
    assert spacing.segments[0][0] == 0
    assert spacing.segments[-1][1] == 2000
    assert all(a[1] == b[0] for a, b in zip(spacing.segments, spacing.segments[1:], strict=False))
    for start, stop in spacing.segments:
        longest = np.max(np.diff(stamp[start:stop]), initial=0) / 1e9
        assert longest <= max(0.010, 3.5 / spacing.rate) * (1 + 1e-6)
    assert len(spacing.segments) == 1 + sum(factor / rate > max(0.010, 3.5 / spacing.rate) for _, factor in gaps)


def jittering(kind, count, period, rng):
    """(S,) stamps [s] of `count` samples that were taken evenly."""
    true = np.arange(count) * period
    if kind == "late":
        return true + rng.exponential(0.3 * period, count)
    if kind == "late, in order":
        return np.maximum.accumulate(true + rng.exponential(0.2 * period, count) + 1e-8 * np.arange(count))
    if kind == "swapped":
        places = rng.choice(count - 2, count // 20)
        for k in places:
            true[[k, k + 1]] = true[[k + 1, k]]
        return true
    if kind == "normal":
        return true + rng.normal(0, 1 / 3, count) * period
    return true + rng.uniform(-1 / 3, 1 / 3, count) * period


@pytest.mark.parametrize(
    ("kind", "lost"),
    [("late", 0.0), ("late", 0.1), ("late, in order", 0.1), ("swapped", 0.0), ("either way", 0.1), ("normal", 0.1)],
)
@pytest.mark.parametrize("rate", [100.0, 500.0])
def test_a_grid_is_found_behind_stamps_that_jitter(log_at, rate, lost, kind):
    rng = np.random.default_rng(5)
    true = np.arange(3000) / rate
    kept = np.flatnonzero(rng.random(3000) >= lost)
    stamps, position = jittering(kind, 3000, 1 / rate, rng)[kept], 0.5 * np.sin(2.5 * true)
    log = log_at(1 + stamps, position[kept])
    assert log.sample_rate == pytest.approx(rate, rel=2e-3)
    (motion,) = motions(log, FilterSettings(10.0), reduce=False)
    middle = motion.kept
    delay = np.mean(stamps - true[kept])
    away = motion.qd[middle, 0] - 1.25 * np.cos(2.5 * (motion.time[middle] + stamps[0] - delay))
    assert np.abs(away).max() < 0.02


@pytest.mark.parametrize("seed", [0, 1, 2, 13])
def test_samples_that_are_missing_near_to_each_other_are_found(seed):
    rng = np.random.default_rng(seed)
    true = np.flatnonzero(rng.random(800) >= 0.1)
    true = true - true[0]
    position = 0.5 * np.sin(true[:, None] / 250 + 0.3 * np.arange(3)) + 1e-6 * rng.normal(size=(len(true), 3))
    place = np.sort(true + rng.normal(0, 1 / 3, len(true)))
    number = settled(sample_numbers(place / 250, 250.0), place, position)
    np.testing.assert_array_equal(number, true)


@pytest.mark.parametrize("seed", [0, 1, 8, 10])
def test_missing_samples_are_found_where_joints_turn_back_within_a_few_dozen_rows(seed):
    """At 1.5 rad/s and 90 rad/s²."""
    rng = np.random.default_rng(seed)
    true = np.flatnonzero(rng.random(4000) >= 0.03)
    true = true - true[0]
    way = 1.5 / 500 * np.cumsum(np.tanh(6 * np.sin(2 * np.pi * np.arange(4000) / 300)))
    position = np.round(way[true, None] * np.array([1.0, -0.6, 0.3]), 4)
    place = np.maximum.accumulate(true + rng.exponential(0.2, len(true)))
    np.testing.assert_array_equal(settled(sample_numbers(place / 500, 500.0), place, position), true)


@given(st.floats(-1e-3, 1e-3))
@settings(max_examples=8, deadline=None)
@pytest.mark.parametrize("late", [0.3, 0.5, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_numbers_do_not_slip_with_stamps_that_come_late(seed, late, off):
    """At a rate that is off by up to 1e-3: of 11000 samples at most two are made up."""
    rng = np.random.default_rng(seed)
    true = np.flatnonzero(rng.random(11_000) >= 0.03)
    true = true - true[0]
    place = np.maximum.accumulate(true + rng.exponential(late, len(true)))
    number = sample_numbers(place / 1000, 1000.0 * (1 + off))
    assert abs(number[-1] - true[-1]) <= 2
    assert np.abs(number - true).max() <= 6


def test_a_missing_sample_is_found_where_the_stamps_are_six_rows_off():
    """Beside another one, which a wrong guess would otherwise be moved to."""
    rng = np.random.default_rng(4)
    true = np.delete(np.arange(300), [140, 150])
    guess = np.delete(np.arange(300), [140, 144])
    position = np.round(0.6 * np.sin(true[:, None] / 100 + np.arange(3)), 4)
    place = np.maximum.accumulate(true + rng.exponential(0.2, len(true)))
    np.testing.assert_array_equal(settled(guess.astype(float), place, position), true)


@pytest.mark.parametrize("seed", range(3))
def test_a_nearly_stationary_joint_does_not_locate_missing_samples(seed):
    """It stays on one count for hundreds of rows, and its step to the next one is no more than that count."""
    rng = np.random.default_rng(seed)
    true = np.flatnonzero(rng.random(4000) >= 0.03).astype(float)
    true -= true[0]
    position = np.round(np.column_stack([0.5 * np.sin(true / 400), 2e-3 * np.cos(true / 900 + seed)]), 4)
    place = np.maximum.accumulate(true + rng.exponential(0.2, len(true)))
    number = settled(sample_numbers(place / 500, 500.0), place, position)
    wrong = np.abs(number - true) * np.abs(np.cos(true / 400))  # where the other one turns back neither tells
    assert np.max(wrong) < 0.2


def test_gaps_that_are_short_for_the_filter_are_bridged(log_at):
    rate = 100.0
    lost = (np.arange(30, 3000, 60)[:, None] + np.arange(5)).ravel()
    times = np.delete(np.arange(3000) / rate, lost)
    log = log_at(times)
    assert len(log.segments) == len(lost) / 5 + 1
    (motion,) = motions(log, FilterSettings(10.0), reduce=False)
    assert np.abs(motion.qd[motion.kept, 0] - np.cos(motion.time[motion.kept])).max() < 1e-3
    assert used_text(log, FilterSettings(10.0)).startswith("log.mcap: 26")
    with pytest.raises(InputError, match="longest segment"):
        next(motions(log, FilterSettings(25.0)))


def test_a_corrupt_row_does_not_affect_the_others(log_at):
    times, position = 5000 + np.arange(1000) / 500, np.sin(np.arange(1000) / 500)
    times[400] -= 3000.0
    position[400] = -1.4e200
    log = log_at(times, position)
    assert len(log.t) == 999
    assert log.t[-1] == pytest.approx(999 / 500)
    assert repair(log, "samples with a position that no arm can have").count == 1
