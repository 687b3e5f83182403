"""The fake trajectory controller: what the source of ros2_controllers does (Jazzy), each with a test; no ROS."""

import numpy as np
import pytest

from fake_controller.ros2.controller import ErrorCode, Goal, TrajectoryController
from fake_controller.ros2.trajectory import SampledTrajectory, TrajectoryMessage, TrajectoryPoint

JOINTS = ("a", "b")
PERIOD = 0.01


def message(*points, stamp=0.0, names=JOINTS):
    """Points (time, position, velocity, acceleration) of both joints."""
    return TrajectoryMessage(
        tuple(names),
        stamp,
        tuple(TrajectoryPoint.of(t, *([value] * len(names) for value in row)) for t, *row in points),
    )


def goal(ends, *points, **options):
    return Goal(message(*points), lambda *end: ends.append(end), **options)


class Bench:
    """A controller whose arm is where its command was, but for what a test adds."""

    def __init__(self, **options):
        self.now, self.off, self.speed = 100.0, np.zeros(2), None
        self.controller = TrajectoryController(JOINTS, PERIOD, np.zeros(2), **options)
        self.position, self.velocity = np.zeros(2), np.zeros(2)

    def run(self, seconds):
        commands = []
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            command, rate = self.controller.update(self.now, self.position, self.velocity)
            self.position, self.velocity = command + self.off, rate
            commands.append(command[0])
        return np.array(commands)


@pytest.mark.parametrize(("rows", "order"), [(1, 1), (2, 3), (3, 5)])
def test_the_kind_of_a_segment_follows_from_what_both_ends_have(rows, order):
    points = [(1.0, 0.5, 0.3, -0.2)[: 1 + rows], (2.0, 1.0, 0.0, 0.4)[: 1 + rows]]
    sampled = SampledTrajectory(message(*points), JOINTS, 0.0, (np.zeros(2), np.zeros(2)))
    t = np.linspace(1.0, 1.999, 12)
    values = np.array([sampled.at(one)[0][0] for one in t])
    fitted = np.polynomial.Polynomial.fit(t, values, order)
    assert np.abs(fitted(t) - values).max() < 1e-9
    assert order == 1 or np.abs(np.polynomial.Polynomial.fit(t, values, order - 1)(t) - values).max() > 1e-6
    assert np.allclose([sampled.at(1.0)[0][0], sampled.at(2.0)[0][0]], [0.5, 1.0])
    if rows > 1:
        assert sampled.at(1.0)[1][0] == pytest.approx(0.3)
    rates = np.array([sampled.at(one)[1][0] for one in t])
    assert np.allclose(fitted.deriv()(t), rates, atol=1e-6)


def test_a_segment_leads_from_the_measured_state_to_the_first_point():
    bench = Bench()
    bench.position = np.array([0.2, 0.2])
    assert bench.controller.take(message((1.0, 1.0, 0.0, 0.0)), bench.now) == ""
    way = bench.run(1.2)
    assert way[0] == pytest.approx(0.2, abs=0.01)
    assert np.abs(np.diff(way)).max() < 2.0 * PERIOD
    assert way[-1] == 1.0


def test_the_command_jumps_to_a_first_point_that_is_due():
    bench = Bench()
    bench.controller.take(message((0.0, 0.5, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0)), bench.now)
    assert bench.run(PERIOD)[0] == pytest.approx(0.5, abs=0.01)


def test_a_stamp_in_the_future_is_waited_for_on_the_way_to_the_first_point():
    bench = Bench()
    bench.controller.take(message((0.2, 0.0, 0.0, 0.0), (1.2, 1.0, 0.0, 0.0), stamp=bench.now + 0.5), bench.now)
    way = bench.run(2.0)
    assert np.abs(way[: round(0.69 / PERIOD)]).max() < 1e-9
    assert way[round(1.2 / PERIOD) - 2] == pytest.approx(0.5, abs=0.01)  # the command is one period ahead
    assert way[-1] == 1.0


def test_points_of_the_past_have_no_lead():
    """The command jumps: what makes late messages dangerous."""
    bench = Bench()
    bench.controller.take(message((0.2, 0.0, 0.0, 0.0), (1.2, 1.0, 0.0, 0.0), stamp=bench.now - 0.7), bench.now)
    assert bench.run(PERIOD)[0] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (message(), "empty"),
        (message((1.0, 1.0), names=("a",)), "joints"),
        (message((1.0, 1.0), names=("a", "c")), "joints"),
        (message((1.0, 1.0), (1.0, 2.0)), "rising"),
        (message((1.0, 1.0), stamp=50.0), "past"),
        (message((1.0, 1.0, 0.1)), "velocity at the end"),
        (message((1.0, float("nan"))), "no number"),
        (TrajectoryMessage(JOINTS, 0.0, (TrajectoryPoint.of(1.0, [1.0]),)), "number of positions"),
    ],
)
def test_refuses_what_the_controller_refuses(given, why):
    bench = Bench()
    assert why in bench.controller.take(given, bench.now)
    assert not bench.run(0.1).any()


def test_joints_may_come_in_any_order():
    bench = Bench()
    point = TrajectoryPoint.of(1.0, [1.0, -1.0], [0.0, 0.0], [0.0, 0.0])
    bench.controller.take(TrajectoryMessage(("b", "a"), 0.0, (point,)), bench.now)
    bench.run(1.5)
    assert bench.controller.command.tolist() == [-1.0, 1.0]


def test_no_path_is_watched_without_a_tolerance():
    bench = Bench()
    bench.controller.take(message((1.0, 1.0, 0.0, 0.0)), bench.now)
    bench.off = np.array([0.5, 0.0])
    assert bench.run(1.5)[-1] == 1.0


def test_off_its_path_a_goal_is_aborted_and_the_arm_held_where_it_was_measured():
    bench, ends = Bench(), []
    assert bench.controller.take_goal(goal(ends, (1.0, 1.0, 0.0, 0.0), path={"a": 0.1, "b": 0.1}), bench.now) == ""
    bench.run(0.4)
    bench.off = np.array([-0.2, 0.0])
    bench.run(0.05)
    held = bench.controller.command.copy()
    assert ends == [("aborted", ErrorCode.PATH_TOLERANCE_VIOLATED, "a left its path")]
    bench.off = np.zeros(2)
    bench.run(0.5)
    assert np.array_equal(bench.controller.command, held)
    assert 0.0 <= held[0] < 0.3
    assert not bench.controller.command_velocity.any()


def test_tolerances_of_a_goal_stay_for_trajectories_by_topic():
    bench, ends = Bench(), []
    bench.controller.take_goal(goal(ends, (0.2, 0.1, 0.0, 0.0), path={"a": 0.1}), bench.now)
    bench.run(0.5)
    assert ends[0][0] == "succeeded"
    bench.controller.take(message((1.0, 1.0, 0.0, 0.0)), bench.now)
    bench.run(0.3)
    bench.off = np.array([0.2, 0.0])
    assert bench.run(1.0)[-1] < 1.0


@pytest.mark.parametrize(
    ("path", "stopped"), [({}, True), ({"a": 0.0}, True), ({"a": -1.0}, False), ({"a": -0.5}, True), ({"x": 9.0}, True)]
)
def test_what_a_goal_leaves_open_is_that_of_the_parameters(path, stopped):
    bench, ends = Bench(path=0.1), []
    bench.controller.take_goal(goal(ends, (1.0, 1.0, 0.0, 0.0), path=path), bench.now)
    bench.run(0.3)
    bench.off = np.array([0.2, 0.0])
    bench.run(1.0)
    assert (ends[0][1] == ErrorCode.PATH_TOLERANCE_VIOLATED) == stopped


def test_a_goal_that_is_not_reached_is_aborted_in_time_or_waits_for_ever():
    for goal_time, ended in ((0.5, True), (0.0, False)):
        bench, ends = Bench(), []
        bench.off = np.array([0.2, 0.0])
        given = goal(ends, (0.5, 1.0, 0.0, 0.0), goal={"a": 0.1}, goal_time=goal_time)
        bench.controller.take_goal(given, bench.now)
        bench.run(3.0)
        assert ([end[1] for end in ends] == [ErrorCode.GOAL_TOLERANCE_VIOLATED]) == ended


def test_a_goal_replaces_a_goal_and_a_topic_does_not_end_it():
    bench, first, second = Bench(), [], []
    bench.controller.take_goal(goal(first, (1.0, 1.0, 0.0, 0.0)), bench.now)
    bench.run(0.2)
    bench.controller.take_goal(goal(second, (1.0, 0.5, 0.0, 0.0)), bench.now)
    assert first[0][0] == "aborted"
    bench.run(0.2)
    bench.controller.take(message((0.3, 0.2, 0.0)), bench.now)
    bench.run(0.5)
    assert second == [("succeeded", ErrorCode.SUCCESSFUL, "Goal successfully reached!")]
    assert bench.controller.command[0] == pytest.approx(0.2)


def test_a_brake_point_brakes_at_a_constant_deceleration():
    bench = Bench()
    bench.controller.take(message((2.0, 2.0, 0.0, 0.0)), bench.now)
    bench.run(1.0)
    v = bench.velocity[0]
    bench.controller.take(message((0.3, bench.position[0] + v * 0.15, 0.0)), bench.now)
    way = bench.run(0.5)
    slowing = np.diff(np.diff(way))[2:26] / PERIOD**2
    assert np.allclose(slowing, -v / 0.3, rtol=0.05)
    assert np.ptp(way[-10:]) == 0.0


def test_cancelling_holds_a_goal_abruptly_and_leaves_a_trajectory_by_topic():
    bench, ends = Bench(), []
    bench.controller.take(message((1.0, 1.0, 0.0, 0.0)), bench.now)
    bench.run(0.5)
    assert not bench.controller.cancel()
    assert bench.run(1.0)[-1] == 1.0
    bench.controller.take_goal(goal(ends, (1.0, 0.0, 0.0, 0.0)), bench.now)
    bench.run(0.5)
    assert bench.controller.cancel()
    assert ends[0][0] == "canceled"
    assert not np.diff(bench.run(0.5)).any()


def test_a_scaled_trajectory_takes_longer_and_ends_well():
    bench, ends = Bench(), []
    bench.controller.scaling = 0.5
    bench.controller.take_goal(goal(ends, (1.0, 1.0, 0.0, 0.0), path={"a": 0.1}), bench.now)
    assert bench.run(1.5)[-1] < 1.0
    assert bench.run(1.0)[-1] == 1.0
    assert ends[0][0] == "succeeded"


def test_a_deactivated_controller_stays_with_its_last_command():
    bench, ends = Bench(), []
    bench.controller.take_goal(goal(ends, (1.0, 1.0, 0.0, 0.0)), bench.now)
    bench.run(0.5)
    bench.controller.deactivate()
    assert ends[0][0] == "aborted"
    assert not np.diff(bench.run(0.5)).any()
    assert "not active" in bench.controller.take(message((1.0, 1.0)), bench.now)


def test_what_holds_the_arm_is_no_motion():
    bench = Bench()
    for place, started in ((0.0, 0), (0.5, 1), (0.5, 1)):
        assert bench.controller.take(message((0.3, place, 0.0, 0.0)), bench.now) == ""
        assert bench.controller.moving == (place != bench.position[0])
        bench.run(0.1)
        assert bench.controller.take(message((0.3, place, 0.0, 0.0)), bench.now) == ""  # replaces what runs
        bench.run(0.5)
        assert not bench.controller.moving
        assert bench.controller.started == started
