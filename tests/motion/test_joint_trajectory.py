"""Joint trajectories: the law of a JointTrajectoryController, and programs that are its plan."""

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.interpolate import BPoly

from agent.core.errors import InputError
from agent.motion import (
    CartesianTarget,
    JointTarget,
    LoopProgram,
    MotionError,
    MotionSettings,
    Move,
    MoveType,
    create_dialect,
    create_interpolator,
    stop_to_stop,
    with_frames,
)
from agent.robot import kinematics_for, load_robot
from agent.safety.first_run import slow_text
from agent.safety.planned_program import PlannedProgram
from drivers.joint_trajectory import JointSpline, rest_to_rest
from fake_controller.state import home

DIALECT = create_dialect("joint_trajectory")
PERIOD = 0.002


def random_spline(seed, count=8, joints=3):
    rng = np.random.default_rng(seed)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.01, 2.0, count - 1))])
    return JointSpline(t, *rng.uniform(-3, 3, (3, count, joints)))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_law_is_the_quintic_through_position_velocity_and_acceleration(seed):
    spline = random_spline(seed)
    rows = np.stack([spline.q, spline.qd, spline.qdd], axis=1)
    other = BPoly.from_derivatives(spline.t, rows)
    t = np.linspace(0.0, spline.duration, 200)
    for order, found in enumerate(spline.at(t)):
        wanted = other.derivative(order)(t) if order else other(t)
        assert np.abs(found - wanted).max() <= 1e-6 * (1 + np.abs(wanted).max())
    late = np.append(t - 0.5, spline.duration + 0.5)
    one_by_one = np.array([spline.position(each) for each in late.tolist()])
    assert np.allclose(one_by_one, spline.at(late)[0], rtol=1e-9, atol=1e-9 * (1 + np.abs(one_by_one).max()))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.0, 9.0))
def test_stretching_keeps_the_path(seed, factor):
    spline = random_spline(seed)
    slow = spline.stretched(factor)
    t = np.linspace(0.0, spline.duration, 50)
    for order, (one, other) in enumerate(zip(spline.at(t), slow.at(factor * t), strict=True)):
        assert np.allclose(one, other * factor**order, rtol=1e-6, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_move_between_rests_keeps_its_limits_and_reaches_one(seed):
    rng = np.random.default_rng(seed)
    start, end = rng.uniform(-3, 3, (2, 5))
    velocity, acceleration = rng.uniform(0.1, 2, (2, 5))
    spline = rest_to_rest(start, end, velocity, acceleration)
    q, qd, qdd = spline.at(np.linspace(0, spline.duration, 2001))
    fullest = max((np.abs(qd) / velocity).max(), (np.abs(qdd) / acceleration).max())
    assert 0.999 < fullest <= 1 + 1e-9
    assert np.allclose(q[[0, -1]], [start, end])


def loop(robot, speed=0.1, distance=0.01):
    """Four points near a pose with bent elbow and wrist, as a loop."""
    kinematics = kinematics_for(robot)
    start = home(robot) + [0.1, 0.1, -0.1, 0.2, 0.5, 0.1]
    size = 0.06 * np.linalg.norm(kinematics.forward(start[None])[0, :3, 3])
    poses = np.repeat(kinematics.forward(start[None]), 4, axis=0)
    poses[1:, :3, 3] += size * np.array([[1, 0, 0], [1, 1, 0], [0, 1, 1]])
    settings = with_frames(DIALECT.settings({"distance": distance}, speed, robot), None)
    return start, [CartesianTarget(pose) for pose in poses], settings


@pytest.mark.parametrize("name", ["comau_ns16", "ur5e", "ur10e"])
def test_a_program_is_its_plan(name):
    robot = load_robot(name)
    start, points, settings = loop(robot)
    law = create_interpolator("joint_trajectory", robot, None, period=PERIOD)
    text = DIALECT.write_loop("square", LoopProgram.of(points, settings, 3, None, JointTarget(start)), robot)
    groups = list(stop_to_stop(DIALECT.read(text, "square", robot).run()))
    there = law.plan(groups[0], start + 0.2)
    assert np.abs(there.q[-1] - start).max() < 1e-8
    assert (np.abs(there.qd) <= 0.1001 * robot.max_velocity).all()
    q, plans = there.q[-1], []
    for moves in groups[1:]:
        plans.append(law.plan(moves, q))
        q = plans[-1].q[-1]
    leads, cycles = plans[::2], plans[1::2]
    assert len(cycles) == 3
    assert not any(np.ptp(one.q, axis=0).any() for one in leads)
    assert all(np.array_equal(one.q, cycles[0].q) for one in cycles[1:])
    statements = [Move(MoveType.LINEAR, point, settings, True) for point in points[1:]]
    stop = Move(MoveType.LINEAR, points[0], settings)
    meant = law.plan([*statements, stop], start)
    assert len(meant.q) == len(cycles[0].q)
    assert np.abs(meant.q - cycles[0].q).max() < 1e-7
    assert np.abs(meant.path_speed).max() < 0.1 * 1.02
    for plan in cycles:
        assert (np.abs(plan.qd) <= robot.max_velocity).all()
        assert (np.abs(plan.qdd) <= 1.001 * robot.max_acceleration).all()
        assert np.abs(np.gradient(plan.q, PERIOD, axis=0) - plan.qd)[2:-2].max() < 1e-3


def test_a_first_run_is_the_same_path_slowly():
    robot = load_robot("ur5e")
    start, points, settings = loop(robot, speed=0.6)
    law = create_interpolator("joint_trajectory", robot, None, period=PERIOD)
    text = DIALECT.write_loop("square", LoopProgram.of(points, settings, 2, None, JointTarget(start)), robot)
    statements = tuple(DIALECT.read(text, "square", robot).run())
    chains = [law.plan(moves, start) for moves in stop_to_stop(statements)]
    assert max(one.path_speed.max() for one in chains) > 0.26
    program = PlannedProgram("square", text, tuple(chains), statements=statements)
    slow = DIALECT.read(slow_text(program, robot, DIALECT, law, start), "slow", robot)
    q = start
    for moves in stop_to_stop(slow.run()):
        plan = law.plan(moves, q)
        assert plan.path_speed.max() <= 0.25
        q = plan.q[-1]
    assert np.abs(plan.q - chains[-1].q.mean(axis=0)).max() < 1.0


def test_goals_are_messages_that_can_be_sent_by_hand():
    robot = load_robot("ur5e")
    start, points, settings = loop(robot)
    text = DIALECT.write_loop("square", LoopProgram.of(points, settings, 3, None, JointTarget(start)), robot)
    files = DIALECT.messages(text)
    assert sorted(files) == ["goal_1.json", "send_goal.txt"]
    goal = json.loads(files["goal_1.json"])
    assert set(goal) == {"trajectory", "path_tolerance", "goal_time_tolerance"}
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in goal["trajectory"]["points"]]
    assert times[0] >= 0.2
    assert 0.04 < np.diff(times).min() <= np.diff(times).max() < 0.0501
    assert not any(goal["trajectory"]["points"][-1]["velocities"])
    assert all(0 < one["position"] <= 0.2 for one in goal["path_tolerance"])
    assert "ros2 action send_goal" in files["send_goal.txt"]


HEADER = '{"program": "p", "joint_names": ["a", "b"]}\n'
TO = '{"to": [0, 0], "velocity": [1, 1], "acceleration": [1, 1]}\n'


def goal(**changes):
    def point(t, q, v=0.0):
        time = {"sec": int(t), "nanosec": round(1e9 * (t - int(t)))}
        return {"positions": [q, q], "velocities": [v, v], "accelerations": [0.0, 0.0], "time_from_start": time}

    data = {
        "trajectory": {"joint_names": ["a", "b"], "points": [point(0.2, 0.0), point(1.0, 0.1, 0.2), point(2.0, 0.2)]},
        "path_tolerance": [{"name": name, "position": 0.1} for name in "ab"],
    }
    for key, value in changes.items():
        if key in data:
            data[key] = value
        else:
            where, name = key.split("__")
            data["trajectory"]["points"][int(where[1:])][name] = value
    return HEADER + TO + json.dumps({"cycles": 2, "goal": data}) + "\n"


def test_a_program_of_someone_else_is_read():
    moves = list(DIALECT.read(goal()).run())
    assert [move.fly for move in moves] == [False, *(2 * [False, True, False])]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (goal(path_tolerance=[]), "path_tolerance"),
        (goal(path_tolerance=[{"name": "a", "position": 0.1}, {"name": "b", "position": 3.0}]), "path_tolerance"),
        (goal(p0__time_from_start={"sec": 0, "nanosec": 10}), "times have to rise, from 0.2 s on"),
        (goal(p2__time_from_start={"sec": 1, "nanosec": 0}), "times have to rise"),
        (goal(p2__velocities=[0.1, 0.0]), "end stationary"),
        (goal(p0__velocities=[0.1, 0.0]), "begin"),
        (goal(p1__positions=[0.1]), "2 finite numbers"),
        (goal(p1__positions=[0.1, float("nan")]), "finite"),
        (goal(p1__time_from_start={"sec": 0.5, "nanosec": 0}), "whole sec"),
        (goal().replace('"cycles": 2', '"cycles": 0'), "cycles is 0"),
        (goal().replace('"cycles": 2', '"cycles": true'), "cycles is True"),
        (goal().replace('["a", "b"], "points"', '["b", "a"], "points"'), "joints of a goal"),
        (HEADER + TO.replace("[1, 1]", "[1, 0]"), "above zero"),
        (goal(p2__time_from_start={"sec": 21, "nanosec": 0}), "20 s are allowed"),
        (HEADER + TO.replace("[0, 0]", "[NaN, 0]"), "finite"),
        (HEADER, "moves nothing"),
        (HEADER + '{"rest": -1}', "a rest of -1"),
        (HEADER + "[1]", "an object"),
        (HEADER + '{"to": [0, 0]}', "'velocity' is missing"),
        (HEADER + "[" * 100_000, "not a line"),
        ('{"program": "p", "joint_names": ["a", "a"]}', "every joint once"),
    ],
)
def test_refuses_what_would_not_be_moved_as_it_says(text, what):
    with pytest.raises(InputError, match=what) as found:
        list(DIALECT.read(text, "x.jsonl").run())
    assert str(found.value).startswith("x.jsonl:")


def test_refuses_motion_that_breaks_a_limit_or_does_not_stop():
    robot = load_robot("ur5e")
    law = create_interpolator("joint_trajectory", robot, None, period=PERIOD)
    start = kinematics_for(robot).middle
    for target, override, what in (
        (start + 20.0, 1.0, "position"),
        (start + 0.5, 0.005, "without a stop; 20 s"),
    ):
        settings = MotionSettings(speed_override=override)
        with pytest.raises(MotionError, match=what):
            law.plan([Move(MoveType.JOINT, JointTarget(target), settings)], start)
    names = list(robot.joint_names)
    other = goal().replace('["a", "b"]', json.dumps(names)).replace("[0, 0]", "[0, 0, 0, 0, 0, 0]")
    with pytest.raises(InputError, match="6 finite"):
        DIALECT.read(other, "x", robot)
    with pytest.raises(InputError, match="it is for a, b"):
        DIALECT.read(goal(), "x", robot)
    text = DIALECT.write("p", [Move(MoveType.JOINT, JointTarget(start))], robot)
    fast = law.plan(list(DIALECT.read(text, "p", robot).run()), start + 0.1)
    assert fast.duration >= 0.5


def test_a_path_needs_a_start():
    robot = load_robot("ur5e")
    start, points, settings = loop(robot)
    with pytest.raises(InputError, match="a joint move to where the arm begins"):
        DIALECT.write("p", [Move(MoveType.LINEAR, points[1], settings)], robot)
    with pytest.raises(InputError, match="name it"):
        DIALECT.write("p", [Move(MoveType.JOINT, JointTarget(start))])
