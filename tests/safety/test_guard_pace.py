"""How long a motion takes: the pace of its plan, rests, losses, and ways that come back on themselves."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from agent.safety.adherence import ALLOWANCE, SHARE
from tests.safety.following import HOME, PERIOD, at, follow, paced, run, watcher


@settings(deadline=None, max_examples=10)
@given(scale=st.floats(0.9, 1.15), lag=st.integers(0, 50), chunk=st.integers(10, 200), set_points=st.booleans())
def test_tolerates_another_interpolator_and_servo_lag(swing, scale, lag, chunk, set_points):
    chain = swing(seconds=3.0)
    assert follow(watcher(chain), paced(chain, scale), lag=lag, servo=0.002, chunk=chunk, given=set_points) is None


@settings(deadline=None, max_examples=15)
@given(scale=st.one_of(st.floats(1.5, 10.0), st.floats(0.1, 0.65)), set_points=st.booleans())
def test_stops_a_motion_at_another_speed(swing, scale, set_points):
    chain = swing(seconds=3.0)
    reason, _ = follow(watcher(chain), paced(chain, scale), given=set_points)
    assert "override is not at 100 %" in reason or "was planned around there" in reason or "off the" in reason


@pytest.mark.parametrize("late", [0.1, 0.2])
def test_returning_along_the_same_path_is_not_a_delay(trajectory_through, late):
    """The controller is a little late, and its blend cuts the turn off."""
    knots = np.tile(HOME, (5, 1))
    knots[:, 0] += np.array([0.0, 0.5, 0.8, 0.5, 0.0])
    chain = trajectory_through(knots, 4.0)
    turn = chain.q[:, 0].max()
    driven = chain.q.copy()
    driven[:, 0] = turn - np.hypot(turn - driven[:, 0], 0.012) + 0.012 * (1 - np.cos(np.pi * chain.t / 4.0)) / 2
    waiting = np.tile(driven[:1], (round(late / PERIOD), 1))
    times = np.arange(0.0, chain.t[-1], PERIOD)
    moved = np.column_stack([np.interp(times, chain.t, column) for column in driven.T])
    assert follow(watcher(chain), waiting, moved, chunk=64) is None


def out_and_back(chain, turn, ramp):
    """The first joint at 1 rad/s and back, as `chain` but turning round at `turn` [s] within `ramp` [s] either side."""
    times = np.arange(0.0, 2 * turn, PERIOD)
    knots = [0.0, 0.3, turn - ramp, turn + ramp, 2 * turn - 0.3, 2 * turn]
    speed = np.outer(np.interp(times, knots, [0.0, 1.0, 1.0, -1.0, -1.0, 0.0]), np.eye(6)[0])
    return replace(chain, t=times, q=HOME - np.eye(6)[0] + PERIOD * np.cumsum(speed, axis=0), qd=speed)


@settings(deadline=None, max_examples=25)
@example(turn=4.2, scale=0.95, cut=0.5)
@given(turn=st.floats(2.0, 4.6), scale=st.floats(0.95, 1.05), cut=st.floats(0.0, 0.7))
def test_a_reversal_cut_short_within_the_margin_is_not_a_delay(swing, turn, scale, cut):
    """Late on the way in, early on the way out, wherever in the turn the pace was last compared."""
    margin, ramp = 0.08, 0.45
    chain = out_and_back(swing(), turn, ramp)
    check = watcher(chain, margin=margin)
    wider = ramp + 2 * cut * margin / check._path.levers[0]
    assert follow(check, paced(out_and_back(chain, turn, wider), scale), chunk=64) is None


def test_detects_half_speed_within_a_second(swing):
    chain = swing()
    _, when = follow(watcher(chain), paced(chain, 2.0))
    # Behind by half of the time, where a share of the planned half is allowed.
    assert when == pytest.approx(ALLOWANCE / (0.5 - 0.5 * SHARE), abs=0.3)


def test_detects_higher_speed_before_the_deviation_grows(swing):
    chain = swing()
    reason, when = follow(watcher(chain), paced(chain, 0.5))
    assert "rad/s, no more than" in reason
    assert "joint_1" in reason
    assert when < 0.7


@pytest.mark.parametrize("chunk", [1, 7, 100, 1000])
def test_detection_does_not_depend_on_block_size(swing, chunk):
    chain = swing(seconds=2.0)
    _, when = follow(watcher(chain), paced(chain, 2.0), chunk=chunk)
    _, exact = follow(watcher(chain), paced(chain, 2.0), chunk=1)
    assert exact - 0.2 <= when < exact + (chunk + 64) * PERIOD
    assert follow(watcher(chain), paced(chain, 1.0), chunk=chunk) is None


@pytest.mark.parametrize(("seconds", "after"), [(8.0, 3.0), (24.0, 20.0)])
def test_detects_an_override_reduced_early_or_late_equally_soon(swing, seconds, after):
    """What went well for long is no credit."""
    chain = swing(seconds=seconds)
    slow = at(chain, after + np.arange(0.0, 8.0, PERIOD) / 4)
    _, when = follow(watcher(chain), paced(chain, 1.0)[: round(after / PERIOD)], slow)
    assert after + 0.5 < when < after + 3.0


def test_pauses_between_stretches_may_have_any_length(swing):
    there, back = swing(seconds=3.0), swing(seconds=3.0, turn=-1.0)
    back = replace(back, q=back.q + (there.q[-1] - back.q[0]))
    for rest in (0.02, 5.0):
        pause = np.repeat(there.q[-1:], round(rest / PERIOD), axis=0)
        pieces = paced(there, 1.0), pause, paced(back, 1.0), paced(there, 1.0)
        assert follow(watcher(there, back, there), *pieces) is None
        assert follow(watcher(there, back, there), *pieces, given=False) is None
        assert follow(watcher(there, back), paced(there, 1.0), pause, paced(back, 2.0)) is not None


def test_a_negligible_approach_is_skipped(swing):
    here, chain = swing(seconds=0.5, turn=1e-4), swing(seconds=3.0, start=1e-4)
    assert follow(watcher(here, chain), paced(chain, 1.0)) is None


def test_tolerates_lost_samples(swing):
    chain = swing(seconds=3.0)
    assert follow(watcher(chain), chain.q, first=600) is None
    check = watcher(chain)
    assert run(check, chain.q[:300], chain.q[:300]) is None
    assert run(check, chain.q, chain.q, first=900) is None


@pytest.mark.parametrize("cycles", [1, 6])
@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_keeps_the_cycle_after_losing_a_cycle_of_samples(trajectory_through, cycles, scale):
    knots = np.tile(HOME, (5, 1))
    knots[:, 0] += np.array([0.0, 0.5, 0.8, 0.5, 0.0])
    cycle = trajectory_through(knots, 2.0)
    driven = np.concatenate([paced(cycle, scale)[:-1]] * 9)
    before = round(0.4 * len(driven) / 9)
    after = before + round(cycles * len(driven) / 9)
    check = watcher(*[cycle] * 9)
    assert run(check, driven[:before], driven[:before]) is None
    assert run(check, driven, driven, first=after) is None
    assert check.remaining_time < 0.1
    short = watcher(*[cycle] * 9)
    until = 8 * len(driven) // 9
    assert run(short, driven[:before], driven[:before]) is None
    assert run(short, driven[:until], driven[:until], first=after) is None
    assert short.remaining_time == pytest.approx(cycle.t[-1], abs=0.1), "an end that is a cycle early shows"


def test_follows_a_path_that_returns_on_itself(trajectory_through):
    knots = np.tile(HOME, (9, 1))
    knots[:, 0] += np.array([0, 1, 0, 1, 0, 1, 0, 1, 0])
    chain = trajectory_through(knots, 8.0)
    check = watcher(chain)
    assert follow(check, paced(chain, 1.05)) is None
    assert check.remaining_time < 0.1
    waits = np.repeat(chain.q[999:1000], 100, axis=0)
    assert follow(watcher(chain), paced(chain, 1.0)[:1000], waits, given=False) is None
