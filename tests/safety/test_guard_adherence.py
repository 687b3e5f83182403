"""The plan is what moves; and links that cannot tell the override, take points, or have too few samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from agent.core.errors import ControllerError, InputError, SafetyError
from agent.robot import load_robot
from agent.safety.adherence import ALLOWANCE, MEASURED, SET_POINTS, SHARE, Adherence
from agent.safety.motion import rest_at
from agent.safety.preconditions import is_loopback
from drivers.protocol import SampleBlock, ViaPoint
from drivers.transports.tcp import TcpDriver

PERIOD = 0.002
HOME = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
ROBOT = load_robot("comau_ns16")


class WithoutOverride(TcpDriver):
    """The real driver, on a wire that has no override."""

    def status(self):
        return replace(super().status(), override_known=False)


class WatchOnly(TcpDriver):
    """The real driver, on a wire whose samples are too few."""

    def identify(self):
        return replace(super().identify(), period=0.02, watch_only="too few samples to identify from")


class Points(TcpDriver):
    """The real driver, on a wire that takes points; the text goes with them, so that the peer has something to run."""

    text = ""

    def load(self, name, checksum, points):
        self.loaded = name, checksum, points
        super().upload(name, self.text)

    def upload(self, name, text):
        raise AssertionError("this link takes points")

    @property
    def facts(self):
        return {"said": "so"}


def reference(chain, times, scale):
    """(K, n) of a chain that takes `scale` times as long as planned."""
    return np.column_stack([np.interp(times, scale * chain.t, column) for column in chain.q.T])


@pytest.fixture(scope="module")
def swing(trajectory_through):
    """`swing(seconds, turn, start)`: from rest to rest, all joints of the arm."""

    def build(seconds=8.0, turn=1.0, start=0.0):
        knots = np.tile(HOME, (5, 1))
        knots[:, 0] += start + turn * np.array([0.0, 0.4, 0.3, 0.8, 1.0])
        knots[:, 2] += 0.4 * turn * np.array([0.0, 0.3, 0.8, 0.9, 1.0])
        return trajectory_through(knots, seconds)

    return build


def watcher(*chains, margin=0.02):
    return Adherence(chains, ROBOT, None, margin, PERIOD)


def follow(check, *pieces, chunk=10, lag=0, servo=0.0, given=True, first=0):
    """Reason and time [s] at which a check says stop; None where it never does. Pieces are (K, n) set-points.

    What is measured comes `lag` samples late and is off by `servo` [rad]; the set-points come along where `given`.
    """
    everything = np.concatenate(pieces)
    measured = np.concatenate([np.repeat(everything[:1], lag, axis=0), everything])[: len(everything)] + servo
    return run(check, measured, everything if given else None, chunk, first)


def run(check, measured, given, chunk=10, first=0):
    zeros = np.zeros_like(measured)
    for start in range(first, len(measured), chunk):
        part = slice(start, start + chunk)
        sequence = np.arange(len(measured))[part]
        block = SampleBlock(
            sequence,
            PERIOD * sequence,
            measured[part],
            None,
            zeros[part],
            None if given is None else given[part],
            None,
        )
        reason = check.take(block)
        if reason is not None:
            return reason, float(block.time[-1])
    return None


def paced(chain, scale):
    return reference(chain, np.arange(0.0, scale * chain.t[-1] + PERIOD, PERIOD), scale)


@settings(deadline=None, max_examples=10)
@given(scale=st.floats(0.9, 1.15), lag=st.integers(0, 50), chunk=st.integers(10, 200), set_points=st.booleans())
def test_an_interpolator_and_servos_that_are_not_ours_are_no_reason(swing, scale, lag, chunk, set_points):
    chain = swing(seconds=3.0)
    assert follow(watcher(chain), paced(chain, scale), lag=lag, servo=0.002, chunk=chunk, given=set_points) is None


@settings(deadline=None, max_examples=15)
@given(scale=st.one_of(st.floats(1.5, 10.0), st.floats(0.1, 0.65)), set_points=st.booleans())
def test_another_speed_is(swing, scale, set_points):
    chain = swing(seconds=3.0)
    reason, _ = follow(watcher(chain), paced(chain, scale), given=set_points)
    assert "override is not at 100 %" in reason or "was planned around there" in reason or "off the" in reason


@pytest.mark.parametrize("late", [0.1, 0.2])
def test_a_way_back_along_the_way_out_is_no_delay(trajectory_through, late):
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
def test_a_turn_that_is_cut_by_less_than_the_margin_is_no_delay(swing, turn, scale, cut):
    """Late on the way in, early on the way out, wherever in the turn the pace was last compared."""
    margin, ramp = 0.08, 0.45
    chain = out_and_back(swing(), turn, ramp)
    wider = ramp + 2 * cut * margin / watcher(chain)._path.levers[0]
    cutting = paced(out_and_back(chain, turn, wider), scale)
    assert follow(watcher(chain, margin=margin), cutting, chunk=64) is None


def test_half_the_speed_is_seen_within_a_second(swing):
    chain = swing()
    _, when = follow(watcher(chain), paced(chain, 2.0))
    # Behind by half of the time, where a share of the planned half is allowed.
    assert when == pytest.approx(ALLOWANCE / (0.5 - 0.5 * SHARE), abs=0.3)


def test_faster_than_planned_is_seen_before_it_is_far(swing):
    chain = swing()
    reason, when = follow(watcher(chain), paced(chain, 0.5))
    assert "rad/s, no more than" in reason
    assert "joint_1" in reason
    assert when < 0.7


@pytest.mark.parametrize("chunk", [1, 7, 100, 1000])
def test_however_the_samples_are_cut(swing, chunk):
    chain = swing(seconds=2.0)
    _, when = follow(watcher(chain), paced(chain, 2.0), chunk=chunk)
    _, exact = follow(watcher(chain), paced(chain, 2.0), chunk=1)
    assert exact - 0.2 <= when < exact + (chunk + 64) * PERIOD
    assert follow(watcher(chain), paced(chain, 1.0), chunk=chunk) is None


def test_an_override_turned_down_on_the_way_is_seen(swing):
    chain = swing()
    first = paced(chain, 1.0)[:1500]
    times = np.arange(3.0, 11.0, PERIOD)
    rest = np.column_stack([np.interp(3.0 + (times - 3.0) / 4, chain.t, column) for column in chain.q.T])
    assert follow(watcher(chain), first, rest) is not None


def test_rests_between_stretches_take_as_long_as_they_take(swing):
    there, back = swing(seconds=3.0), swing(seconds=3.0, turn=-1.0)
    back = replace(back, q=back.q + (there.q[-1] - back.q[0]))
    for rest in (0.02, 5.0):
        pause = np.repeat(there.q[-1:], round(rest / PERIOD), axis=0)
        pieces = paced(there, 1.0), pause, paced(back, 1.0), paced(there, 1.0)
        assert follow(watcher(there, back, there), *pieces) is None
        assert follow(watcher(there, back, there), *pieces, given=False) is None
        assert follow(watcher(there, back), paced(there, 1.0), pause, paced(back, 2.0)) is not None


def test_an_approach_that_was_there_already_has_no_stretch(swing):
    here, chain = swing(seconds=0.5, turn=1e-4), swing(seconds=3.0, start=1e-4)
    assert follow(watcher(here, chain), paced(chain, 1.0)) is None


@pytest.mark.parametrize("given", [True, False])
def test_what_was_not_planned_is_stopped_where_it_leaves_the_plan(swing, given):
    chain, other = swing(), swing(turn=-1.0)
    reason, when = follow(watcher(chain), paced(other, 1.0), given=given)
    assert "into the motion" in reason
    assert np.abs(reference(other, np.array([when]), 1.0) - HOME).max() < 0.15


def test_motion_that_goes_on_after_the_end_is_stopped(swing):
    chain = swing(seconds=3.0)
    again = paced(chain, 1.0) + (chain.q[-1] - chain.q[0])
    reason, when = follow(watcher(chain), paced(chain, 1.0), again)
    assert "joint_1" in reason
    assert 3.0 < when < 3.7


def test_motion_before_the_start_is_stopped(swing):
    chain = swing(seconds=3.0)
    elsewhere = chain.q[:1] + np.linspace(0.0, 0.2, 200)[:, None]
    assert follow(watcher(chain), elsewhere)[1] < 0.4


@pytest.mark.parametrize("joint", range(6))
def test_a_servo_that_does_not_follow_is_stopped(swing, joint):
    chain = swing(seconds=3.0)
    off = np.zeros(6)
    off[joint] = np.radians(40.0)
    reason, _ = follow(watcher(chain), paced(chain, 1.0), servo=off)
    assert f"the position of joint_{joint + 1} is" in reason
    assert "+0.69" in reason


def test_a_servo_that_is_left_behind_is_stopped(swing):
    chain = swing(seconds=3.0)
    assert follow(watcher(chain), paced(chain, 1.0), lag=300) is not None


def test_what_slides_is_told_in_metres(swing):
    sliding = replace(ROBOT, joints=(replace(ROBOT.joints[0], prismatic=True), *ROBOT.joints[1:]))
    check = Adherence([swing(seconds=3.0)], sliding, None, 0.02, PERIOD)
    reason, _ = follow(check, np.tile(HOME + 0.5 * np.eye(6)[0], (20, 1)))
    assert "joint_1 is 0.500 m, +0.500 m off" in reason


@pytest.mark.parametrize("margin", [0.01, 0.05])
def test_the_tool_may_be_as_far_off_as_the_cell_was_checked(margin):
    lever = watcher(rest_at(HOME))._path.levers[0]  # from the first axis to the tool

    def beside(metres):
        off = np.array([metres / lever, 0.0, 0.0, 0.0, 0.0, 0.0])
        return follow(watcher(rest_at(HOME), margin=margin), np.tile(HOME + off, (50, 1)))

    assert beside(0.99 * margin) is None
    reason, _ = beside(1.02 * margin)
    assert f"{1000 * margin:.0f} mm are allowed, near x" in reason


def test_set_points_of_ten_radians_a_second_are_stopped(swing):
    chain = swing()
    jump = chain.q[0] + np.outer(10.0 * PERIOD * np.arange(100), np.eye(6)[0])
    assert follow(watcher(chain), jump, chunk=1)[1] < 0.02


def test_degrees_for_radians_are_told_as_such(swing):
    chain = swing(seconds=3.0, start=0.5)
    for set_points in (chain.q, None):
        reason, _ = run(watcher(chain), np.degrees(chain.q), set_points)
        assert "fits the plan in degrees" in reason


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize("which", ["measured", "given"])
def test_samples_that_are_no_numbers_are_no_motion_as_planned(swing, value, which):
    chain = swing(seconds=3.0)
    parts = {"measured": chain.q.copy(), "given": chain.q.copy()}
    parts[which][500, 2] = value
    _, when = run(watcher(chain), **parts)
    assert when == pytest.approx(PERIOD * 509)


def test_times_that_are_no_numbers_are_stopped_too(swing):
    chain = swing(seconds=3.0)
    times = np.array([0.0, np.nan])
    block = SampleBlock(np.arange(2), times, chain.q[:2], None, chain.q[:2], chain.q[:2], None)
    assert "times that are no numbers" in watcher(chain).take(block)


def test_samples_lost_on_the_way_or_at_first_are_no_reason(swing):
    chain = swing(seconds=3.0)
    assert follow(watcher(chain), chain.q, first=600) is None
    check = watcher(chain)
    assert run(check, chain.q[:300], chain.q[:300]) is None
    assert run(check, chain.q, chain.q, first=900) is None


@pytest.mark.parametrize("cycles", [1.0, 2.0])
@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_a_loss_as_long_as_a_cycle_leaves_the_arm_in_the_cycle_that_it_is_in(trajectory_through, cycles, scale):
    knots = np.tile(HOME, (5, 1))
    knots[:, 0] += np.array([0.0, 0.5, 0.8, 0.5, 0.0])
    cycle = trajectory_through(knots, 2.0)
    driven = np.concatenate([paced(cycle, scale)[:-1]] * 5)
    before = round(0.4 * len(driven) / 5)
    after = before + round(cycles * len(driven) / 5)
    check = watcher(*[cycle] * 5)
    assert run(check, driven[:before], driven[:before]) is None
    assert run(check, driven, driven, first=after) is None
    assert check.left < 0.1
    short = watcher(*[cycle] * 5)
    until = 4 * len(driven) // 5
    assert run(short, driven[:before], driven[:before]) is None
    assert run(short, driven[:until], driven[:until], first=after) is None
    assert short.left == pytest.approx(cycle.t[-1], abs=0.1), "an end that is a cycle early shows"


@pytest.mark.parametrize("joint", [3, 4, 5])
@pytest.mark.parametrize("given", [True, False])
def test_a_joint_that_turns_unplanned_is_stopped_within_its_reach(swing, joint, given):
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


def test_a_path_that_comes_back_on_itself_is_followed_there_and_back(trajectory_through):
    knots = np.tile(HOME, (9, 1))
    knots[:, 0] += np.array([0, 1, 0, 1, 0, 1, 0, 1, 0])
    chain = trajectory_through(knots, 8.0)
    check = watcher(chain)
    assert follow(check, paced(chain, 1.05)) is None
    assert check.left < 0.1
    assert (
        follow(watcher(chain), paced(chain, 1.0)[:1000], np.repeat(chain.q[999:1000], 500, axis=0), given=False) is None
    )


def test_the_guard_stops_what_leaves_the_plan(bench, program):
    chosen = slowly(program(), 10)
    bench.controller.blocks = 60
    bench.controller.moves = lambda times: reference(chosen.chains[0], times, 2.0)
    guard, received = bench.open(), []
    guard.send(chosen)
    with pytest.raises(SafetyError, match="override is not at 100 %"), guard.motion(chosen) as samples:
        received += samples
    assert bench.controller.stops > 0
    assert len(received) < 30  # it was stopped when it was seen, not at the end
    guard.close()
    bench.controller = replace(bench.controller, moves=lambda times: reference(chosen.chains[0], times, 1.0))
    assert bench.run(chosen) == 6000


def test_an_arm_that_is_stopped_for_another_reason_is_not_called_slow(bench, program):
    chosen = slowly(program(), 10)
    bench.controller = replace(bench.controller, blocks=60, pushes=True, later={"mode": "teach"})
    bench.controller.moves = lambda times: reference(chosen.chains[0], times, 2.0)
    with pytest.raises(SafetyError, match="the mode was changed"):
        bench.run(chosen)


def slowly(chosen, factor):
    (chain,) = chosen.chains
    return replace(chosen, chains=(replace(chain, t=chain.t * factor, qd=chain.qd / factor),))


def test_set_points_that_the_wire_does_not_have_leave_what_is_measured(bench, program):
    class Nothing(TcpDriver):
        def samples(self):
            return (replace(block, reference_position=None) for block in super().samples())

    bench.driver = Nothing
    assert bench.run(program()) == 1000
    bench.controller = replace(bench.controller, moves=lambda times: np.tile(HOME - 0.3, (len(times), 1)))
    with pytest.raises(SafetyError, match="the position of"):
        bench.run(program())


def test_a_person_is_asked_for_the_override_where_it_cannot_be_read(bench):
    bench.driver = WithoutOverride
    with pytest.raises(InputError):
        bench.open(yes=False)
    bench.driver = TcpDriver
    with pytest.raises(InputError):
        bench.open(yes=False)
    unread, read = bench.asked
    assert "cannot read the override" in unread
    assert "override" not in read


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("127.0.0.1,trajectory=9100,mqtt=10.0.0.1:1883", True),
        ("127.0.0.1", True),
        ("localhost,start=hand", True),
        ("[::1]:9100", True),
        ("10.0.0.1,mqtt=127.0.0.1:1883", False),
        ("10.0.0.1", False),
        ("robot,mqtt=localhost:1883", False),
    ],
)
def test_an_address_with_options_is_on_this_machine_if_its_host_is(address, local):
    assert is_loopback(address) is local


def test_too_few_samples_are_refused_and_may_be_watched(bench):
    bench.driver = WatchOnly
    with pytest.raises(ControllerError, match="too few samples to identify from"):
        bench.open()
    assert bench.warned == []
    bench.open(watching=True)
    assert "too few samples to identify from" in bench.warned[0]


def test_watching_a_link_with_enough_samples_still_checks_their_rate(bench):
    with pytest.raises(ControllerError, match="every 2 ms"):
        bench.open(watching=True, rate=250.0)


def test_a_link_that_takes_points_gets_them_and_no_program(bench, program):
    point = ViaPoint(np.zeros(6), 0.0, 0.1)
    chosen = replace(program(), points=(point,))
    bench.driver = type("Told", (Points,), {"text": chosen.text})
    guard = bench.open()
    assert guard.takes_points
    assert bench.run(chosen, guard) == 1000
    assert guard.facts == {"said": "so"}


def test_other_links_take_programs_and_know_no_more(bench, program):
    guard = bench.open()
    assert not guard.takes_points
    assert guard.facts == {}
