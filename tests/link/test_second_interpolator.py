"""The emulator's second interpolator: what a program promises holds, by kinematics that neither side has."""

import itertools

import numpy as np
import pytest
from hypothesis import Phase, given, settings, strategies as st

from agent.motion import FlyTrajectory, FlyType, MotionError, OrientationType, Pdl2Settings, Termination
from agent.motion.program import CartesianTarget, JointTarget, Move, MoveType, frame_of
from fake_controller.interpolation import build_interpolator
from fake_controller.interpolation.parts import InterpolationLaw, drawn_law
from fake_controller.interpolation.ramps import RampedMove
from fake_controller.interpolation.second import SecondInterpolator
from tests.link.by_pinocchio import ROBOT, START, flange

PERIOD = 0.004


def tool_points(q: np.ndarray, tool: np.ndarray) -> np.ndarray:
    return np.array([flange(row).act(tool) for row in q])


def loop(via: int, distance: float, speed: float, kind: MoveType = MoveType.LINEAR) -> tuple[list[Move], np.ndarray]:
    """Four corners around the start and the way back, and the tool's frame."""
    rng = np.random.default_rng(via)
    tool = np.eye(4)
    tool[:3, 3] = rng.uniform(-0.2, 0.2, 3)
    fields = Pdl2Settings(
        fly_type=FlyType.FLY_CART,
        fly_trajectory=FlyTrajectory.FLY_TOL,
        fly_distance=distance,
        linear_speed=speed,
        tool=frame_of(tool),
    )
    moves = []
    for q in [*(START + np.radians(rng.uniform(-8, 8, (3, 6)))), START]:
        pose = flange(q).homogeneous @ tool
        target = JointTarget(q) if kind is MoveType.JOINT else CartesianTarget(pose)
        moves.append(Move(kind, target, fields, fly=True))
    moves[-1] = Move(kind, moves[-1].target, fields.changed(termination=Termination.FINE))
    return moves, tool[:3, 3]


def off_polygon(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    away = []
    for a, b in itertools.pairwise(corners):
        part = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        away.append(np.linalg.norm(points - a - part[:, None] * (b - a), axis=1))
    return np.min(away, axis=0)


@given(
    via=st.integers(0, 2**31),
    seed=st.integers(0, 2**31),
    distance=st.sampled_from([0.002, 0.02, 0.05]),
    speed=st.floats(0.1, 1.5),
)
@settings(max_examples=10, deadline=None, phases=[Phase.generate])
def test_the_tool_passes_every_position_and_stays_near_the_programmed_lines(via, seed, distance, speed):
    moves, tool = loop(via, distance, speed)
    plan = SecondInterpolator(ROBOT, drawn_law(seed), PERIOD).plan(moves, START)
    points = tool_points(plan.q, tool)
    corners = np.array([points[0], *(move.target.pose[:3, 3] for move in moves)])
    between = speed * PERIOD  # two samples
    for corner in corners:
        assert np.linalg.norm(points - corner, axis=1).min() <= distance + between
    assert off_polygon(points, corners).max() <= distance + 1e-4
    np.testing.assert_allclose(points[-1], corners[-1], atol=1e-6)
    assert np.all(np.linalg.norm(np.diff(points, axis=0), axis=1) <= 1.001 * speed * PERIOD)


@given(via=st.integers(0, 2**31), seed=st.integers(0, 2**31), kind=st.sampled_from([MoveType.LINEAR, MoveType.JOINT]))
@settings(max_examples=8, deadline=None, phases=[Phase.generate])
def test_set_points_are_one_motion_within_the_joints_limits(via, seed, kind):
    moves, _ = loop(via, 0.02, 1.0, kind)
    plan = SecondInterpolator(ROBOT, drawn_law(seed), PERIOD).plan(moves, START)
    assert np.all(np.abs(plan.qd) <= ROBOT.max_velocity * 1.001)
    assert np.all(np.abs(plan.qdd) <= ROBOT.max_acceleration * 1.02)
    walked = plan.q[0] + np.cumsum(0.5 * (plan.qd[1:] + plan.qd[:-1]) * PERIOD, axis=0)
    np.testing.assert_allclose(walked, plan.q[1:], atol=2e-3)
    assert not plan.qd[[0, -1]].any()


@given(
    length=st.floats(1e-3, 3),
    start=st.floats(0, 1),
    end=st.floats(0, 1),
    speed=st.floats(0.05, 2),
    jerk=st.sampled_from([5.0, 40.0, np.inf]),
)
@settings(max_examples=60, deadline=None)
def test_a_stretch_is_the_integral_of_its_acceleration(length, start, end, speed, jerk):
    stretch = RampedMove(length, start, end, max(speed, start, end), 1.5, 2.0, jerk)
    up, _, down = stretch.parts()
    if up.length + down.length > length * (1 + 1e-9):
        return  # the borders do not fit into the length: `reachable` keeps that from happening
    t = np.linspace(0, stretch.duration, 2001)
    way, rate, acceleration = stretch.at(t)
    assert way[-1] == pytest.approx(length, rel=1e-6)
    assert (rate[0], rate[-1]) == pytest.approx((start, end), abs=1e-6)
    assert rate.max() <= max(speed, start, end) + 1e-9
    assert acceleration.max() <= 1.5 + 1e-9
    assert acceleration.min() >= -2.0 - 1e-9
    np.testing.assert_allclose(np.cumsum(np.diff(t) * 0.5 * (rate[1:] + rate[:-1])), way[1:], atol=1e-3)


def test_differs_from_the_planners_interpolator():
    """Path and time law of the two differ by more than what one tuning of the other would."""
    moves, tool = loop(1, 0.02, 1.0)
    ours, second = (build_interpolator(kind, ROBOT, 3, PERIOD).plan(moves, START) for kind in ("ours", "second"))
    paths = tool_points(ours.q, tool), tool_points(second.q, tool)
    away = [np.linalg.norm(paths[0] - point, axis=1).min() for point in paths[1]]
    assert max(away) > 0.001 or abs(second.duration / ours.duration - 1) > 0.02


def test_an_override_keeps_the_path():
    moves, tool = loop(2, 0.02, 0.8)
    slow = [Move(m.type, m.target, m.settings.changed(arm_override=0.3), m.fly) for m in moves]
    law = SecondInterpolator(ROBOT, InterpolationLaw(), PERIOD)
    full, third = tool_points(law.plan(moves, START).q, tool), tool_points(law.plan(slow, START).q, tool)
    assert len(third) > 1.3 * len(full)
    assert off_polygon(third[::5], full).max() < 1e-3


def test_names_the_move_that_the_controller_does_not_support():
    moves, _ = loop(3, 0.02, 0.8)
    wrist = Move(MoveType.LINEAR, moves[1].target, moves[1].settings.changed(orientation=OrientationType.WRIST_JNT))
    with pytest.raises(MotionError, match="WRIST_JNT") as error:
        SecondInterpolator(ROBOT, InterpolationLaw(), PERIOD).plan([moves[0], wrist], START)
    assert error.value.move == 1


def test_a_circle_passes_its_via_point():
    moves, tool = loop(4, 0.02, 0.5)
    circle = Move(MoveType.CIRCULAR, moves[1].target, moves[1].settings, via=moves[0].target)
    points = tool_points(SecondInterpolator(ROBOT, InterpolationLaw(), PERIOD).plan([circle], START).q, tool)
    for target in (moves[0].target, moves[1].target):
        assert np.linalg.norm(points - target.pose[:3, 3], axis=1).min() < 0.003
