"""Laws of every program, checked on the set-points alone, by finite differences and by geometry."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, MotionError, Move, MoveType, Trajectory

PERIOD = 0.002
SEEDS = st.integers(0, 2**32 - 1)
QUICK = settings(max_examples=100, deadline=None, derandomize=True)


def planned(fly: FlyInterpolator, program: list, start: np.ndarray) -> Trajectory | None:
    """None where the program is refused, with the statement named."""
    refusal = None
    try:
        return fly.plan(program, start)
    except MotionError as error:
        refusal = error
    assert 0 <= refusal.move < len(program)
    assert refusal.excess > 0
    assert f"statement {refusal.move + 1}" in str(refusal)
    return None


def distance_to_polyline(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """(P,) of points (P, d) from a polyline (L, d)."""
    start, chord = line[:-1], np.diff(line, axis=0)
    squares = np.maximum(np.einsum("ij,ij->i", chord, chord), 1e-300)
    if len(points) > len(chord):
        best = np.full(len(points), np.inf)
        for a, side, square in zip(start, chord, squares, strict=True):
            along = np.clip((points - a) @ side / square, 0, 1)
            best = np.minimum(best, np.linalg.norm(points - a - along[:, None] * side, axis=1))
        return best
    best = np.empty(len(points))
    for k, point in enumerate(points):
        along = np.clip(np.einsum("ij,ij->i", point - start, chord) / squares, 0, 1)
        best[k] = np.sqrt(np.min(np.sum((point - start - along[:, None] * chord) ** 2, axis=1)))
    return best


def check_limits(fly: FlyInterpolator, trajectory: Trajectory, start: np.ndarray) -> None:
    robot, q = fly.robot, trajectory.q
    jerk = np.array([joint.max_jerk for joint in robot.joints])
    lower, upper = robot.position_limits
    speed, acceleration, change = (np.diff(q, k, axis=0) / PERIOD**k for k in (1, 2, 3))
    assert np.array_equal(q[0], start)
    assert np.all(q >= lower - 1e-6)
    assert np.all(q <= upper + 1e-6)
    assert np.max(np.abs(speed) / robot.max_velocity, initial=0) <= 1
    assert np.max(np.abs(acceleration) / robot.max_acceleration, initial=0) <= 1
    assert np.max(np.abs(change) / jerk, initial=0) <= 1
    assert np.max(np.abs(trajectory.qd) / robot.max_velocity) <= 1
    assert np.max(np.abs(trajectory.qdd) / robot.max_acceleration) <= 1
    assert np.max(np.abs(np.diff(trajectory.qdd, axis=0)) / PERIOD / jerk, initial=0) <= 1
    # The velocities and accelerations given are those of the positions given.
    between = 0.5 * (trajectory.qd[1:] + trajectory.qd[:-1])
    assert np.max(np.abs(speed - between) / (jerk * PERIOD**2)) < 1
    assert np.max(np.abs(acceleration - trajectory.qdd[1:-1]) / (jerk * PERIOD), initial=0) < 1
    for at_rest in (trajectory.qd[[0, -1]], trajectory.qdd[[0, -1]]):
        assert np.max(np.abs(at_rest)) < 1e-9


def check_tcp(fly: FlyInterpolator, trajectory: Trajectory, program: list) -> None:
    """Poses are those of the joints, and keep the Cartesian limits in Cartesian moves."""
    from agent.robot import kinematics_for

    tcp = trajectory.tcp
    assert np.max(np.abs(kinematics_for(fly.robot).forward(trajectory.q) - tcp)) < 1e-5
    position = tcp[:, :3, 3]
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1) / PERIOD
    limits = fly.robot.cartesian_limits
    joint = np.array([isinstance(s, Move) and s.type is MoveType.JOINT for s in program])
    cartesian = ~joint[trajectory.move]
    inside = cartesian[2:] & cartesian[1:-1] & cartesian[:-2]
    # A blend with a JOINT move belongs to both halves of it: only well inside Cartesian moves is it asked.
    inside &= np.convolve(joint[trajectory.move], np.ones(401), "same")[1:-1] == 0
    assert np.max(speed[1:][inside], initial=0) <= limits.linear_speed
    acceleration = np.linalg.norm(np.diff(position, 2, axis=0), axis=1) / PERIOD**2
    assert np.max(acceleration[inside], initial=0) <= limits.linear_acceleration
    assert np.max(np.abs(trajectory.path_speed[1:] - speed)) < 0.05


def check_corners(fly: FlyInterpolator, trajectory: Trajectory, program: list, start: np.ndarray) -> None:
    """FLY_TOL, lines alone: within $FLY_DIST of the points and of the lines, and through every line's middle."""
    from agent.robot import kinematics_for

    first = kinematics_for(fly.robot).forward(start[None])[0]
    points = np.array([first[:3, 3]] + [move.target.pose[:3, 3] for move in program])
    position = trajectory.tcp[:, :3, 3]
    allowed = program[0].settings.fly_distance
    for point in points:
        assert distance_to_polyline(point[None], position)[0] <= allowed + 1e-6
    assert np.max(distance_to_polyline(position, points)) <= allowed + 1e-6
    middles = 0.5 * (points[1:] + points[:-1])
    assert np.max(distance_to_polyline(middles, position)) < 2e-5
    assert np.linalg.norm(position[-1] - points[-1]) < 1e-6
    assert np.max(np.abs(trajectory.tcp[-1] - program[-1].target.pose)) < 1e-6


def check_flight(fly: FlyInterpolator, trajectory: Trajectory, program: list, start: np.ndarray) -> None:
    """FLY_CART over lines: stationary only at the ends and where the path turns back, never on another branch."""
    from agent.robot import kinematics_for

    kinematics = kinematics_for(fly.robot)
    points = np.array([kinematics.forward(start[None])[0, :3, 3]] + [m.target.pose[:3, 3] for m in program])
    sides = np.diff(points, axis=0)
    lengths = np.linalg.norm(sides, axis=1)
    cosines = np.einsum("ij,ij->i", sides[1:], sides[:-1]) / (lengths[1:] * lengths[:-1])
    moving = np.linalg.norm(np.diff(trajectory.q, axis=0), axis=1) > 1e-12
    moving = moving[np.flatnonzero(moving)[0] : np.flatnonzero(moving)[-1]]
    if np.all(cosines > np.cos(fly.parameters.stop_angle)):
        assert np.all(moving)
    flags = {kinematics.configuration_text(q).split("T")[0] for q in trajectory.q[::20]}
    assert len(flags) == 1


def check_named_limits(trajectory: Trajectory, programmed: float) -> None:
    """Programmed speed, or a limit that says why not."""
    speed = trajectory.path_speed
    assert np.max(speed) <= programmed * 1.0006
    named = np.zeros(len(speed), dtype=bool)
    for limit in trajectory.binding:
        assert limit.end >= limit.start
        named |= (trajectory.t >= limit.start - 0.011) & (trajectory.t <= limit.end + 0.011)
    assert np.all(named | (speed > 0.99 * programmed))


def corner_speeds(trajectory: Trajectory, program: list) -> np.ndarray:
    """Smallest TCP speed within 10 mm of where one move hands over to the next."""
    position = trajectory.tcp[:, :3, 3]
    lowest = []
    for k in range(len(program) - 1):
        handover = int(np.argmax(trajectory.move > k))
        around = np.linalg.norm(position - position[handover], axis=1) < 0.01
        around &= np.abs(np.arange(len(position)) - handover) < 500
        lowest.append(trajectory.path_speed[around].min())
    return np.array(lowest)


def check_same_path(fly: FlyInterpolator, program: list, start: np.ndarray, override: float) -> None:
    """Slower by override and by programmed speed, on the same way through joint space."""
    speed = 0.5 * program[0].settings.linear_speed
    slower = [replace(m, settings=m.settings.changed(speed_override=override, linear_speed=speed)) for m in program]
    one, two = planned(fly, program, start), planned(fly, slower, start)
    assert (one is None) == (two is None)
    if one is not None and two is not None:
        picked = two.q[:: max(1, len(two.q) // 60)]
        assert np.max(distance_to_polyline(picked, one.q)) < 2e-5


def check_overlap(fly: FlyInterpolator, program: list, start: np.ndarray) -> None:
    """FLY_NORM against FLY_CART at the corners, and against a stop at each of them."""
    norm = [replace(m, settings=m.settings.changed(fly_type=FlyType.FLY_NORM)) for m in program]
    stop = [replace(m, fly=False) for m in program]
    cart, overlapped, stopped = (planned(fly, each, start) for each in (program, norm, stop))
    if cart is not None and overlapped is not None and stopped is not None:
        assert np.all(corner_speeds(overlapped, program) <= 1.05 * corner_speeds(cart, program) + 0.003)
        assert overlapped.duration <= stopped.duration + 1e-9


@QUICK
@given(seed=SEEDS)
def test_every_program_keeps_every_limit(fly, home, random_program, seed):
    program = random_program(seed)
    trajectory = planned(fly, program, home)
    if trajectory is not None:
        check_limits(fly, trajectory, home)
        check_tcp(fly, trajectory, program)


@QUICK
@given(seed=SEEDS)
def test_lines_are_flown_within_the_fly_distance(fly, home, random_lines, seed):
    program = random_lines(seed)
    trajectory = planned(fly, program, home)
    if trajectory is not None:
        check_limits(fly, trajectory, home)
        check_corners(fly, trajectory, program, home)
        check_flight(fly, trajectory, program, home)
        check_named_limits(trajectory, program[0].settings.linear_speed)


@settings(QUICK, max_examples=40)
@given(seed=SEEDS, override=st.floats(0.1, 1), mode=st.sampled_from(FlyTrajectory))
def test_fly_cart_takes_the_same_path_at_any_override(fly, home, random_lines, seed, override, mode):
    check_same_path(fly, random_lines(seed, count=4, fly_trajectory=mode, linear_speed=0.8), home, override)


@settings(QUICK, max_examples=40)
@given(seed=SEEDS, mode=st.sampled_from(FlyTrajectory), percent=st.floats(1, 100))
def test_fly_norm_is_slower_at_corners_than_fly_cart_and_quicker_than_stopping(
    fly, home, random_lines, seed, mode, percent
):
    check_overlap(fly, random_lines(seed, count=4, fly_trajectory=mode, fly_percent=percent), home)


@pytest.mark.verify
@pytest.mark.parametrize("piece", range(20))
def test_ten_thousand_programs_keep_every_limit(fly, home, random_program, random_lines, measured, piece):
    refused = 0
    for seed in range(piece * 250, (piece + 1) * 250):
        program, lines = random_program(seed), random_lines(seed)
        trajectory = planned(fly, program, home)
        if trajectory is None:
            refused += 1
        else:
            check_limits(fly, trajectory, home)
            check_tcp(fly, trajectory, program)
        trajectory = planned(fly, lines, home)
        if trajectory is None:
            refused += 1
        else:
            check_limits(fly, trajectory, home)
            check_corners(fly, trajectory, lines, home)
            check_flight(fly, trajectory, lines, home)
            check_named_limits(trajectory, lines[0].settings.linear_speed)
        if seed % 10 == 0:
            mode = list(FlyTrajectory)[seed // 10 % 4]
            check_same_path(fly, random_lines(seed, count=4, fly_trajectory=mode), home, 0.1 + 0.9 * (seed % 97) / 97)
            check_overlap(fly, random_lines(seed, count=4, fly_trajectory=mode, fly_percent=1.0 + seed % 100), home)
    measured(f"random programs, piece {piece + 1} of 20: laws broken", 0, f"of 500, {refused} refused", "0")
