"""Smoothing, differentiation and the zero-phase filter."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.estimation import FilterSettings, motions, smooth_and_differentiate
from agent.estimation.identification import observe_predictable
from agent.estimation.signals import filtering
from agent.robot.bodies import rigid_bodies


def _motions(log, cutoff=None, reduce=True):
    return list(motions(log, FilterSettings(cutoff), reduce))


@settings(max_examples=30, deadline=None)
@given(
    rate=st.sampled_from([100.0, 250.0, 500.0, 1000.0, 5000.0]), share=st.floats(0.02, 1.1), phase=st.floats(0, 6.28)
)
def test_derivatives_of_a_sine_are_exact_beyond_the_cutoff(arm, make_log, rate, share, phase):
    omega = 2 * np.pi * 30.0 * share
    t = np.arange(int(8 * rate)) / rate
    motion = _motions(make_log(arm(1), t, np.sin(omega * t + phase)[:, None], None), 30.0)[0]
    inside = slice(2 * motion.edge, -2 * motion.edge)
    angle = omega * motion.time[inside] + phase
    assert np.abs(motion.q[inside, 0] - np.sin(angle)).max() < 2e-4
    assert np.abs(motion.qd[inside, 0] - omega * np.cos(angle)).max() < 2e-4 * omega
    assert np.abs(motion.qdd[inside, 0] + omega**2 * np.sin(angle)).max() < 2e-4 * omega**2


def test_the_filter_is_the_butterworth_run_forward_and_backward(arm, make_log):
    from scipy.signal import butter, sosfiltfilt

    robot = arm(2)
    walk = np.cumsum(np.random.default_rng(0).normal(size=(4000, 2)), axis=0)
    motion = _motions(make_log(robot, np.arange(4000) / 500, walk, walk), 30.0)[0]
    expected = sosfiltfilt(butter(8, 30, fs=500, output="sos"), walk, axis=0)[motion.kept]
    difference = np.abs(motion.low_pass(walk) - expected)
    assert difference[20:-20].max() < 1e-5 * walk.std()
    assert difference.max() < 1e-3 * walk.std()


def test_it_halves_the_amplitude_at_the_cutoff_without_moving_it(arm, make_log):
    t = np.arange(5000) / 500
    wave = np.sin(2 * np.pi * 30 * t)[:, None]
    motion = _motions(make_log(arm(1), t, wave, wave), 30.0, reduce=False)[0]
    assert np.abs(motion.low_pass(wave) - 0.5 * wave[motion.kept]).max() < 1e-3


def test_a_cutoff_far_below_the_sampling_rate_overflows_nothing(arm, make_log):
    """Twice the order of 8 as a power of the warped frequency, at 1/7000 of the rate."""
    t = np.arange(160_000) / 20_000
    wave = np.sin(2 * np.pi * 0.3 * t)[:, None]
    motion = _motions(make_log(arm(1), t, wave, wave), 3.0, reduce=False)[0]
    with np.errstate(over="raise", invalid="raise"):
        found = motion.low_pass(wave)
    assert np.abs(found - wave[motion.kept]).max() < 0.01


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), columns=st.integers(1, 12))
def test_filtering_commutes_with_a_linear_model(arm, make_log, seed, columns):
    rng = np.random.default_rng(seed)
    block = np.cumsum(rng.normal(size=(2000, columns)), axis=0)
    parameters = rng.normal(size=columns)
    motion = _motions(make_log(arm(1), np.arange(2000) / 500, block[:, :1], block[:, :1]), 30.0)[0]
    together = motion.low_pass((block @ parameters)[:, None])[:, 0]
    assert np.allclose(motion.low_pass(block) @ parameters, together, atol=1e-9 * np.abs(together).max())


def test_filtering_stops_at_gaps_and_drops_their_edges(arm, make_log):
    t = np.concatenate([np.arange(2000), np.arange(2500, 4500)]) / 500
    q = np.sin(t)[:, None]
    parts = ((0, 2000), (2000, 4000))
    first, second = _motions(make_log(arm(1), t, q, q, segments=parts, rate=500.0))
    knocked = np.where(t[:, None] > 4.5, q + 100, q)
    again, _ = _motions(make_log(arm(1), t, knocked, knocked, segments=parts, rate=500.0))
    assert np.array_equal(first.qdd, again.qdd)
    assert np.array_equal(first.low_pass(first.torque), again.low_pass(again.torque))
    kept = np.concatenate([motion.time[motion.kept] for motion in (first, second)])
    for border in (0.0, 3.998, 5.0, 8.998):
        assert np.abs(kept - border).min() >= 4 / 30


def test_a_long_stretch_keeps_every_sample_once(arm, make_log):
    t = np.arange(70_000) / 500
    q = np.sin(t)[:, None]
    pieces = _motions(make_log(arm(1), t, q, q), 30.0, reduce=False)
    kept = np.concatenate([motion.time[motion.kept] for motion in pieces])
    assert len(pieces) > 1
    assert np.allclose(np.diff(kept), 1 / 500, atol=1e-9)
    assert len(kept) == len(t) - 2 * pieces[0].edge


@pytest.mark.parametrize("late", ["stamp", "sample"])
def test_distinguishes_late_stamps_from_uneven_sampling(arm, make_log, late):
    """Either the stamp is late and the sample is not, or the sample was taken at that time."""
    even = np.arange(4000) / 500
    stamps = even + np.random.default_rng(0).uniform(-4e-4, 4e-4, 4000)
    taken = even if late == "stamp" else stamps
    motion = _motions(make_log(arm(1), stamps, np.sin(3 * taken)[:, None], None, rate=500.0))[0]
    kept = motion.kept
    error = motion.qdd[kept, 0] + 9 * np.sin(3 * motion.time[kept])
    assert np.abs(error).max() < 0.01


def test_single_missing_samples_are_filled_in(arm, make_log):
    t = np.delete(np.arange(4000) / 500, [700, 1500, 1501, 3000])
    motion = _motions(make_log(arm(1), t, np.sin(3 * t)[:, None], np.cos(3 * t)[:, None], rate=500.0))[0]
    assert len(motion.time) == 4000
    assert np.abs(motion.qdd + 9 * np.sin(3 * motion.time)[:, None])[motion.kept].max() < 1e-3
    assert np.abs(motion.torque - np.cos(3 * motion.time)[:, None]).max() < 1e-3


def test_a_log_that_is_too_short_says_how_long_it_should_be(arm, make_log):
    t = np.arange(100) / 500
    with pytest.raises(InputError, match=r"short\.mcap.*0\.20 s.*30 Hz needs 0\.5"):
        _motions(make_log(arm(1), t, t[:, None], t[:, None], name="short.mcap"))


def test_a_cutoff_beyond_the_sampling_rate_says_what_is_possible(arm, make_log):
    t = np.arange(500) / 50
    log = make_log(arm(1), t, t[:, None], t[:, None], name="slow.mcap")
    with pytest.raises(InputError, match=r"slow\.mcap.*30 Hz.*50 Hz.*17\.5 Hz"):
        _motions(log, 30.0)
    assert _motions(log)[0].cutoff == pytest.approx(15.0)


def test_reducing_the_rate_changes_nothing_that_the_filter_passes(arm, make_log):
    t = np.arange(40_000) / 5000
    q = np.sin(2 * np.pi * 3 * t)[:, None]
    log = make_log(arm(1), t, q, q**3)
    full, reduced = _motions(log, 20.0, reduce=False)[0], _motions(log, 20.0)[0]
    assert reduced.rate <= 500
    at = np.searchsorted(full.time[full.kept], reduced.time[reduced.kept] - 1e-9)
    inside = (at > 0) & (at < len(full.time[full.kept]))
    difference = full.low_pass(full.torque)[at[inside]] - reduced.low_pass(reduced.torque)[inside]
    assert np.abs(difference).max() < 2e-5


def test_smoothing_removes_what_lies_beyond_its_band():
    t = np.arange(5000) / 500
    slow, fast = np.sin(2 * np.pi * 5 * t), np.sin(2 * np.pi * 180 * t)
    smooth, _, second = smooth_and_differentiate((slow + fast)[:, None], 500.0, 90.0, 135.0)
    inside = slice(200, -200)
    assert np.abs(smooth[inside, 0] - slow[inside]).max() < 1e-5
    assert np.abs(second[inside, 0] + (10 * np.pi) ** 2 * slow[inside]).max() < 1e-2


def test_a_stretch_in_pieces_gives_the_same_columns(arm, multisine, make_log, monkeypatch):
    robot = arm(2)
    t = np.arange(0, 40, 1 / 500) + np.random.default_rng(0).uniform(-4e-4, 4e-4, 20_000)
    q, qd, _ = multisine(2, t)
    log = make_log(robot, t, q, qd, rate=500.0)
    (whole,) = _motions(log)
    monkeypatch.setattr(filtering, "_PIECE", 4000)
    pieces = _motions(log)
    assert len(pieces) > 3
    for name in ("q", "qd", "qdd", "torque"):
        expected = whole.low_pass(getattr(whole, name))
        found = np.concatenate([piece.low_pass(getattr(piece, name)) for piece in pieces])
        assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize(("rate", "cutoff"), [(500.0, 30.0), (1000.0, 30.0), (5000.0, 20.0), (100.0, None)])
def test_smooth_signals_may_be_thinned_before_the_filter(arm, make_log, rate, cutoff):
    t = np.arange(int(10 * rate)) / rate
    q = np.sin(2 * np.pi * 4 * t)[:, None]
    (motion,) = _motions(make_log(arm(1), t, q, None), cutoff)
    every = motion.fewest
    column = motion.qdd * np.cos(motion.q)
    thinned = motion.low_pass(column[motion.thinned(every)], every)
    expected = motion.low_pass(column)
    assert thinned.shape == expected.shape
    assert np.abs(thinned - expected).max() < 1e-3 * np.abs(expected).max()
    assert every == (1 if rate == 100 else 2)


def test_noise_of_the_positions_lowers_the_cutoff_unless_it_is_given(arm, multisine, make_log):
    """Without noise 30 Hz; with it, one up to which the positions predict torque, whatever the description says."""
    robot = arm(2)
    rigid = rigid_bodies(robot)
    t = np.arange(10_000) / 500
    q, qd, qdd = multisine(2, t)
    torque = rigid.dynamics.inverse_dynamics(q, qd, qdd) + 3 * np.sign(qd)
    noisy = q + 5e-4 * np.random.default_rng(0).normal(size=q.shape)

    def chosen(position, cutoff=None, description=robot):
        bodies = rigid_bodies(description)
        log = make_log(robot, t, position, torque)
        return observe_predictable(bodies, [log], FilterSettings(cutoff)).segments[0].motion

    assert chosen(q).cutoff == 30
    assert chosen(noisy, 30.0).cutoff == 30
    motion = chosen(noisy)
    assert 10 <= motion.cutoff < 25
    heavy = replace(robot, urdf=re.sub('mass value="[0-9.]*"', 'mass value="300"', robot.urdf))
    assert chosen(noisy, description=heavy).cutoff == pytest.approx(motion.cutoff, rel=0.2)

    def noise(at):  # torque that only noise of the positions makes, over the measured torque
        exact = chosen(q, at.cutoff)
        with_noise, without = (m.low_pass(rigid.dynamics.inverse_dynamics(m.q, m.qd, m.qdd)) for m in (at, exact))
        return np.std(with_noise - without, axis=0) / np.sqrt(np.mean(torque**2, axis=0))

    assert noise(motion).max() < 0.6 * noise(chosen(noisy, 30.0)).max()


@pytest.mark.parametrize("jitter", ["late", "either way"])
@pytest.mark.parametrize(("short", "long"), [(0.010, 0.012), (0.010, 0.010)])
def test_velocities_tell_when_samples_were_taken(arm, multisine, make_log, jitter, short, long):
    """Sampled every 10 or 12 ms by turns, or evenly, with stamps that hide which."""
    rng = np.random.default_rng(3)
    true = np.cumsum(np.where(rng.random(3000) < 1 / 3, long, short))
    q, qd, _ = multisine(3, true)
    late = rng.exponential(0.003, 3000) if jitter == "late" else rng.uniform(-0.003, 0.003, 3000)
    stamps = np.maximum.accumulate(true + late) + 1e-8 * np.arange(3000)
    position, velocity = np.round(q, 5), qd + 1e-3 * rng.normal(size=qd.shape)
    log = make_log(arm(3), stamps - stamps[0], position, None, velocity=velocity, rate=2999 / (true[-1] - true[0]))
    (motion,) = _motions(log, 10.0, reduce=False)
    middle = motion.time[motion.kept]
    delay = np.mean(stamps - true)
    expected = multisine(3, middle + stamps[0] - delay)[1]
    error = np.sqrt(np.mean((motion.qd[motion.kept] - expected) ** 2))
    assert error < 0.01
    if long > short:
        (without,) = _motions(replace(log, velocity=None), 10.0, reduce=False)
        expected = multisine(3, without.time[without.kept] + stamps[0] - delay)[1]
        assert error < 0.5 * np.sqrt(np.mean((without.qd[without.kept] - expected) ** 2))


# Velocity of rounded positions, as many recorders leave them

_RATE = 500.0


def _move_and_creep(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, position and velocity (S, 1): moves of up to 1 rad/s, between which the joint creeps."""
    from scipy.integrate import cumulative_trapezoid
    from scipy.ndimage import gaussian_filter1d

    rng = np.random.default_rng(seed)
    t = np.arange(int(20 * _RATE)) / _RATE
    steps = np.repeat(rng.uniform(-1, 1, 20) * (np.arange(20) % 2 == 0), int(_RATE))
    speed = gaussian_filter1d(steps, 0.05 * _RATE) + 5e-4 * np.sin(2 * np.pi * 0.2 * t)
    return t, cumulative_trapezoid(speed, t, initial=0.0)[:, None], speed[:, None]


def _error(log, speed: np.ndarray, settings: FilterSettings) -> tuple[np.ndarray, np.ndarray]:
    """Error of the velocity where the joint creeps, and where it moves."""
    (motion,) = motions(log, settings, reduce=False)
    inside = slice(2 * motion.edge, -2 * motion.edge)
    at = np.searchsorted(log.t, motion.time[inside] - 1e-9)
    error, moves = (motion.qd[inside] - speed[at])[:, 0], np.abs(speed[at, 0]) > 0.05
    return error[~moves], error[moves]


def test_a_creeping_joint_is_smooth_despite_rounded_positions(arm, make_log, monkeypatch):
    t, position, speed = _move_and_creep()
    log = make_log(arm(1), t, np.round(position, 4), None)
    quiet, moving = _error(log, speed, FilterSettings(10.0))
    monkeypatch.setattr("agent.estimation.signals.filtering._AUDIBLE", np.inf)
    plain, moving_plain = _error(log, speed, FilterSettings(10.0))
    assert np.std(quiet) < 0.65 * np.std(plain)
    assert np.std(moving) < 1.1 * np.std(moving_plain)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), cutoff=st.sampled_from([10.0, 20.0, 30.0]))
def test_exact_positions_keep_their_velocity(arm, make_log, seed, cutoff):
    t, position, speed = _move_and_creep(seed)
    error = np.concatenate(_error(make_log(arm(1), t, position, None), speed, FilterSettings(cutoff)))
    assert np.abs(error).max() < 2e-4  # of 1 rad/s: what the trapezoids leave


@pytest.mark.parametrize("digits", [3, 4, 5])
def test_rounding_never_makes_a_velocity_worse_than_its_noise(arm, make_log, digits):
    t, position, speed = _move_and_creep(1)
    creeping, moving = _error(make_log(arm(1), t, np.round(position, digits), None), speed, FilterSettings(10.0))
    noise = 10.0**-digits / np.sqrt(12) * np.sqrt(8 * np.pi**2 / 3 * 45.0**3 / _RATE)
    assert np.std(np.concatenate([creeping, moving])) < 1.2 * noise + 1e-3
