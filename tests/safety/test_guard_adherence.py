"""The plan is what moves: where the arm is, and how fast each joint goes there."""

import re
from dataclasses import replace

import numpy as np
import pytest

from agent.safety.adherence import BATCH_DURATION, MEASURED, SET_POINTS, Adherence
from agent.safety.planned_program import standstill_plan
from drivers.protocol import SampleBlock
from tests.safety.following import HOME, PERIOD, ROBOT, at, follow, paced, run, watcher


@pytest.mark.parametrize("given", [True, False])
def test_stops_unplanned_motion_where_it_leaves_the_plan(swing, given):
    chain, other = swing(), swing(turn=-1.0)
    reason, when = follow(watcher(chain), paced(other, 1.0), given=given)
    assert "into the motion" in reason
    assert np.abs(at(other, np.array([when])) - HOME).max() < 0.15


def test_stops_motion_after_the_planned_end(swing):
    chain = swing(seconds=3.0)
    again = paced(chain, 1.0) + (chain.q[-1] - chain.q[0])
    reason, when = follow(watcher(chain), paced(chain, 1.0), again)
    assert "joint_1" in reason
    assert 3.0 < when < 3.7


def test_stops_motion_before_the_start(swing):
    chain = swing(seconds=3.0)
    elsewhere = chain.q[:1] + np.linspace(0.0, 0.2, 200)[:, None]
    assert follow(watcher(chain), elsewhere)[1] < 0.4


@pytest.mark.parametrize("joint", range(6))
def test_stops_a_servo_that_does_not_follow(swing, joint):
    chain = swing(seconds=3.0)
    off = np.zeros(6)
    off[joint] = np.radians(40.0)
    reason, _ = follow(watcher(chain), paced(chain, 1.0), servo=off)
    assert f"the position of joint_{joint + 1} is" in reason
    assert "+0.69" in reason


def test_stops_a_servo_that_lags_behind(swing):
    chain = swing(seconds=3.0)
    assert follow(watcher(chain), paced(chain, 1.0), lag=300) is not None


def test_prismatic_joints_are_reported_in_metres(swing):
    sliding = replace(ROBOT, joints=(replace(ROBOT.joints[0], prismatic=True), *ROBOT.joints[1:]))
    check = Adherence([swing(seconds=3.0)], sliding, None, 0.02, PERIOD)
    reason, _ = follow(check, np.tile(HOME + 0.5 * np.eye(6)[0], (20, 1)))
    assert "joint_1 is 0.500 m, +0.500 m off" in reason


@pytest.mark.parametrize("margin", [0.01, 0.05])
def test_tolerates_tool_deviation_up_to_the_checked_margin(margin):
    lever = watcher(standstill_plan(HOME))._path.levers[0]  # from the first axis to the tool

    def beside(metres):
        off = np.array([metres / lever, 0.0, 0.0, 0.0, 0.0, 0.0])
        return follow(watcher(standstill_plan(HOME), margin=margin), np.tile(HOME + off, (50, 1)))

    assert beside(0.99 * margin) is None
    reason, _ = beside(1.02 * margin)
    assert f"{1000 * margin:.0f} mm are allowed, near x" in reason


def test_stops_set_points_above_the_speed_limit(swing):
    chain = swing()
    jump = chain.q[0] + np.outer(10.0 * PERIOD * np.arange(100), np.eye(6)[0])
    _, when = follow(watcher(chain), jump, chunk=1)
    assert BATCH_DURATION - PERIOD < when < 0.02, "a few samples are judged at once: each by itself would cost as much"


def test_judges_samples_even_if_the_clock_is_constant(swing):
    chain = swing(seconds=3.0)
    assert run(watcher(chain), np.tile(HOME - 0.3, (200, 1)), None, period=0.0) is not None


def test_times_count_from_the_start_of_motion(swing):
    chain = swing(seconds=3.0)
    driven = chain.q + np.outer(np.arange(len(chain.q)) >= 500, np.eye(6)[0])
    reason, _ = run(watcher(chain), driven, driven, began=5000.0)
    assert reason.startswith("1.00 s into the motion")
    reason, _ = run(watcher(chain), at(chain, np.arange(0.0, 9.0, PERIOD) / 3), None, began=5000.0)
    assert re.match(r"[01]\.\d\d s into the motion: what was planned to take", reason)


def ramp(seconds):
    """The first joint from rest to 2 rad/s, evenly, and on for half a second; as a plan and as it goes."""
    t = np.arange(0.0, seconds + 0.5, PERIOD)
    speed = np.outer(2.0 * np.minimum(t / seconds, 1.0), np.eye(6)[0])
    return replace(
        standstill_plan(HOME), t=t, q=HOME + PERIOD * np.cumsum(speed, axis=0), qd=speed, move=0 * t.astype(int)
    )


def test_tolerates_slightly_earlier_acceleration():
    plan = ramp(0.3)
    assert follow(watcher(plan, margin=0.005), ramp(0.1).q[:200]) is None
    assert follow(watcher(ramp(0.9), margin=0.005), ramp(0.1).q[:200]) is not None


def slow_move(away, seconds=15.0):
    """A long slow move of the first joint that ends at HOME, from rest to rest, as a quintic."""
    t = np.arange(0.0, seconds + PERIOD / 2, PERIOD)
    s = t / seconds
    q = HOME - away * np.outer(1 - (10 * s**3 - 15 * s**4 + 6 * s**5), np.eye(6)[0])
    return replace(standstill_plan(HOME), t=t, q=q, qd=np.gradient(q, t, axis=0), move=0 * t.astype(int))


@pytest.mark.parametrize("away", [0.3, *(pytest.param(way, marks=pytest.mark.verify) for way in (0.6, 1.2))])
@pytest.mark.parametrize("rest", [0.0, 1.0])
def test_what_is_too_slow_to_be_seen_takes_no_time_that_is_missed(swing, away, rest):
    """Without set-points, the ends of a slow move look like a rest; the next move begins on time nevertheless."""
    move, then = slow_move(away), swing(seconds=3.0)
    pause = np.tile(HOME, (round(rest / PERIOD), 1))
    assert follow(watcher(move, then), move.q, pause, then.q, given=False) is None
    again = then.q[::2]  # twice as fast
    assert follow(watcher(move, then), move.q, pause, again, given=False) is not None


def test_a_nan_speed_limit_allows_no_motion(swing):
    nowhere = replace(ROBOT, joints=tuple(replace(joint, max_velocity=np.nan) for joint in ROBOT.joints))
    reason, _ = follow(Adherence([swing(seconds=3.0)], nowhere, None, 0.02, PERIOD), np.tile(HOME, (20, 1)))
    assert "goes at 0 rad/s" in reason


def test_reports_degrees_in_place_of_radians(swing):
    chain = swing(seconds=3.0, start=0.5)
    for set_points in (chain.q, None):
        reason, _ = run(watcher(chain), np.degrees(chain.q), set_points)
        assert "fits the plan in degrees" in reason


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("which", ["measured", "given"])
def test_stops_on_non_finite_samples(swing, value, which):
    chain = swing(seconds=3.0)
    parts = {"measured": chain.q.copy(), "given": chain.q.copy()}
    parts[which][500, 2] = value
    reason, when = run(watcher(chain), **parts)
    assert f"{'measured positions' if which == 'measured' else 'set-points'} that are no numbers" in reason
    assert when == pytest.approx(PERIOD * 509)


def test_stops_on_non_finite_times(swing):
    chain = swing(seconds=3.0)
    times = np.array([0.0, np.nan])
    block = SampleBlock(np.arange(2), times, chain.q[:2], None, chain.q[:2], chain.q[:2], None)
    assert "times that are no numbers" in watcher(chain).take(block)


@pytest.mark.parametrize("joint", [3, 4, 5])
@pytest.mark.parametrize("given", [True, False])
def test_stops_an_unplanned_joint_motion_within_the_margin(swing, joint, given):
    """A joint may turn as fast as the tool goes; how far, the positions say."""
    chain = swing(seconds=3.0)
    check = watcher(chain)
    allowed = SET_POINTS if given else MEASURED
    begin = 700
    row = check._path.rows[begin]
    speed = 0.9 * check._path.turning[row, joint]
    turned = np.maximum(PERIOD * speed * np.arange(-begin, len(chain.q) - begin), 0.0)
    driven = chain.q + np.outer(turned, np.eye(6)[joint])
    reason, when = follow(check, driven, given=given)
    assert reason is not None
    most = check._path.reach[begin : begin + 200, joint].max() + allowed.joint
    assert turned[round(when / PERIOD)] <= most + speed * 0.05
