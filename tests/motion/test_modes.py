"""Each mode of the FLY interpolator does what its system variable says."""

from dataclasses import replace

import numpy as np
import pytest

from agent.motion import FlyInterpolator, FlyParameters, FlyTrajectory, FlyType, OrientationType, SpeedOption
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.program import CartesianTarget, Delay, JointTarget, Move, MoveType
from agent.motion.regions import pose_of

CALM = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02)


def line(pose, fly=False, **settings):
    return Move(MoveType.LINEAR, CartesianTarget(pose), CALM.changed(**settings), fly=fly)


def angle_between(one, other):
    return np.arccos(np.clip((np.trace(one.T @ other) - 1) / 2, -1, 1))


@pytest.fixture
def corner(down):
    """A right angle: 0.3 m along y, then 0.3 m along x."""
    return [down([1.0, 0.3, 0.8]), down([1.3, 0.3, 0.8])]


def positions(trajectory):
    return trajectory.tcp[:, :3, 3]


def nearest_to(trajectory, point):
    return float(np.min(np.linalg.norm(positions(trajectory) - point, axis=1)))


def test_samples_have_the_controller_period_and_their_statement(fly, home, corner):
    trajectory = fly.plan([line(corner[0], fly=True), Delay(0.1), line(corner[1])], home)
    assert np.allclose(np.diff(trajectory.t), 0.002)
    assert trajectory.t[0] == 0
    assert list(np.unique(trajectory.move)) == [0, 1, 2]
    assert np.all(np.diff(trajectory.move) >= 0)
    resting = trajectory.move == 1
    assert np.count_nonzero(resting) == 50
    assert np.all(trajectory.qd[resting] == 0)
    again = fly.plan([line(corner[0], fly=True), Delay(0.1), line(corner[1])], home)
    assert np.array_equal(trajectory.q, again.q)


def test_an_empty_program_gives_one_stationary_sample(fly, home, kinematics):
    for program in ([], [line(kinematics.forward(home[None])[0])], [Move(MoveType.JOINT, JointTarget(home))]):
        trajectory = fly.plan(program, home)
        assert np.array_equal(trajectory.q, home[None])


def test_a_joint_move_is_limited_by_the_slowest_joint(fly, ns16, home):
    change = np.array([2.0, -0.3, 0.2, 0.5, 0.1, -1.0])
    settings = CALM.changed(speed_override=0.5)
    trajectory = fly.plan([Move(MoveType.JOINT, JointTarget(home + change), settings)], home)
    share = (trajectory.q - home) / change
    assert np.max(np.ptp(share, axis=1)) < 1e-9
    assert np.max(np.abs(trajectory.qd[:, 0])) == pytest.approx(0.5 * ns16.max_velocity[0], rel=3e-3)
    assert np.max(np.abs(trajectory.qdd[:, 0])) == pytest.approx(ns16.max_acceleration[0], rel=1e-2)


def test_a_blend_keeps_the_programmed_speed_if_no_limit_is_active(fly, home, corner):
    program = [line(corner[0], fly=True, linear_speed=0.08), line(corner[1], linear_speed=0.08)]
    trajectory = fly.plan(program, home)
    ramps = (trajectory.t < 0.4) | (trajectory.t > trajectory.duration - 0.4)
    assert np.max(np.abs(trajectory.path_speed[~ramps] / 0.08 - 1)) < 1e-4
    assert all(limit.end < 0.4 or limit.start > trajectory.duration - 0.4 for limit in trajectory.binding)
    assert 0.005 < nearest_to(trajectory, corner[0][:3, 3]) <= 0.02


def test_speed_drops_only_in_the_corner_and_names_the_limit(fly, home, corner):
    program = [line(corner[0], fly=True, linear_speed=0.4), line(corner[1], linear_speed=0.4)]
    trajectory = fly.plan(program, home)
    slow = trajectory.path_speed < 0.99 * 0.4
    away = np.linalg.norm(positions(trajectory) - corner[0][:3, 3], axis=1) > 0.17
    ramps = (trajectory.t < 0.6) | (trajectory.t > trajectory.duration - 0.6)
    assert not np.any(slow & away & ~ramps)
    at_corner = trajectory.t[np.argmin(np.linalg.norm(positions(trajectory) - corner[0][:3, 3], axis=1))]
    named = [limit.limit for limit in trajectory.binding if limit.start <= at_corner <= limit.end]
    assert named
    assert any(word in named[0] for word in ("acceleration", "jerk"))


def test_a_higher_stress_percentage_is_quicker_through_the_corner(fly, home, corner):
    def corner_speed(stress):
        settings = {"stress_percent": stress, "linear_speed": 0.8, "fly_distance": 0.05}
        trajectory = fly.plan([line(corner[0], fly=True, **settings), line(corner[1], **settings)], home)
        return trajectory.path_speed[np.argmin(np.linalg.norm(positions(trajectory) - corner[0][:3, 3], axis=1))]

    speeds = [corner_speed(stress) for stress in (1, 50, 100)]
    assert speeds[0] < speeds[1] <= 1.001 * speeds[2]


@pytest.mark.parametrize("distance", [0.01, 0.05, 0.12])
def test_fly_from_leaves_the_line_that_far_before_the_corner(fly, home, corner, distance):
    settings = {"fly_trajectory": FlyTrajectory.FLY_FROM, "fly_distance": distance}
    trajectory = fly.plan([line(corner[0], fly=True, **settings), line(corner[1], **settings)], home)
    along = corner[0][1, 3] - positions(trajectory)[:, 1]
    aside = positions(trajectory)[:, 0] - 1.0
    before = along > 0.151  # the first half of the first move belongs to no corner
    assert np.max(np.abs(aside[(along > distance + 1e-6) | before])) < 1e-6
    assert np.all(aside[(along < 0.7 * distance) & (along > 0)] > 1e-5 * distance)


@pytest.mark.parametrize("turn", [[1.3, 0.3, 0.8], [1.2, 0.1, 0.7], [0.9, 0.5, 0.9]])
def test_fly_pass_goes_through_the_point_in_its_orientation(fly, home, down, turn):
    point, after = down([1.0, 0.3, 0.8], np.array([0.2, 0.1, 0.0])), down(turn)
    settings = {"fly_trajectory": FlyTrajectory.FLY_PASS, "fly_distance": 0.03}
    trajectory = fly.plan([line(point, fly=True, **settings), line(after, **settings)], home)
    nearest = int(np.argmin(np.linalg.norm(positions(trajectory) - point[:3, 3], axis=1)))
    step = np.linalg.norm(positions(trajectory)[nearest + 1] - positions(trajectory)[nearest])
    assert nearest_to(trajectory, point[:3, 3]) <= 0.51 * step + 1e-6
    assert angle_between(trajectory.tcp[nearest, :3, :3], point[:3, :3]) < 0.01
    assert trajectory.path_speed[nearest] > 0


def test_fly_auto_goes_nearer_to_the_point_under_more_stress(fly, home, corner):
    def away(stress):
        settings = {"fly_trajectory": FlyTrajectory.FLY_AUTO, "stress_percent": stress}
        return nearest_to(fly.plan([line(corner[0], fly=True, **settings), line(corner[1])], home), corner[0][:3, 3])

    distances = [away(stress) for stress in (1, 25, 50, 75, 100)]
    assert np.all(np.diff(distances) < 0)


def test_fly_norm_overlaps_more_with_a_larger_percentage(fly, home, corner):
    def plan(percent):
        settings = {
            "fly_type": FlyType.FLY_NORM,
            "fly_trajectory": FlyTrajectory.FLY_AUTO,
            "fly_percent": percent,
            "linear_speed": 0.3,
        }
        return fly.plan([line(corner[0], fly=True, **settings), line(corner[1], **settings)], home)

    plans = [plan(percent) for percent in (25, 50, 100)]
    assert np.all(np.diff([nearest_to(each, corner[0][:3, 3]) for each in plans]) > 0)
    assert np.all(np.diff([each.duration for each in plans]) < 0)
    halted = fly.plan([line(corner[0], linear_speed=0.3), line(corner[1], linear_speed=0.3)], home)
    assert plans[0].duration < halted.duration


def test_a_reversing_corner_is_a_stop(fly, home, down):
    there, back = down([1.0, 0.3, 0.8]), down([1.0, 0.1, 0.8])
    trajectory = fly.plan([line(there, fly=True), line(back)], home)
    assert nearest_to(trajectory, there[:3, 3]) < 1e-7
    assert np.min(trajectory.path_speed[10:-10]) < 1e-9


def test_circular_is_an_arc_through_the_via_point(fly, home, down):
    centre, radius = np.array([1.0, 0.2, 0.8]), 0.2
    via, end = down([1.2, 0.2, 0.8]), down([1.0, 0.4, 0.8])
    move = Move(MoveType.CIRCULAR, CartesianTarget(end), CALM, via=CartesianTarget(via))
    trajectory = fly.plan([move], home)
    assert np.max(np.abs(np.linalg.norm(positions(trajectory) - centre, axis=1) - radius)) < 1e-6
    assert np.max(np.abs(positions(trajectory)[:, 2] - 0.8)) < 1e-6
    assert nearest_to(trajectory, via[:3, 3]) < 0.001
    assert np.linalg.norm(positions(trajectory)[-1] - end[:3, 3]) < 1e-7


def test_rs_traj_keeps_the_tool_to_the_tangent(fly, home, down):
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # the tangent's turn over the quarter circle
    via = down([1.0 + 0.2 * np.sin(np.pi / 4), 0.2 - 0.2 * np.cos(np.pi / 4), 0.8])
    end = down([1.2, 0.2, 0.8])
    end[:3, :3] = turned @ end[:3, :3]

    def plan(style):
        settings = CALM.changed(orientation=style)
        return fly.plan([Move(MoveType.CIRCULAR, CartesianTarget(end), settings, via=CartesianTarget(via))], home)

    trajectory = plan(OrientationType.RS_TRAJ)
    moving = trajectory.path_speed > 0.01
    tangents = np.gradient(positions(trajectory), axis=0)[moving]
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    in_tool = np.einsum("sji,sj->si", trajectory.tcp[moving, :3, :3], tangents)
    assert np.max(np.abs(in_tool - in_tool[0])) < 0.01
    assert np.max(np.abs(trajectory.tcp[-1] - end)) < 1e-6


def test_rs_world_turns_about_one_axis_in_proportion(fly, home, down, kinematics):
    end = down([1.0, 0.3, 0.8], np.array([0.3, -0.2, 0.4]))
    trajectory = fly.plan([line(end)], home)
    start = kinematics.forward(home[None])[0]
    share = (positions(trajectory)[:, 1] - start[1, 3]) / 0.3
    whole = angle_between(start[:3, :3], end[:3, :3])
    turned = np.array([angle_between(start[:3, :3], pose[:3, :3]) for pose in trajectory.tcp])
    left = np.array([angle_between(pose[:3, :3], end[:3, :3]) for pose in trajectory.tcp])
    assert np.max(np.abs(turned - share * whole)) < 1e-5
    assert np.max(np.abs(turned + left - whole)) < 1e-5


def test_eul_world_changes_the_euler_angles_in_proportion(fly, home, down, kinematics):
    before = pose_of([1.0, 0.0, 0.8, 0.4, 2.8, 0.3])
    after = pose_of([1.0, 0.3, 0.8, 0.9, 2.5, -0.2])
    start = kinematics.solve(before, home)
    trajectory = fly.plan([line(after, orientation=OrientationType.EUL_WORLD)], start)
    share = positions(trajectory)[:, 1] / 0.3
    expected = pose_of(
        np.column_stack([positions(trajectory), 0.4 + 0.5 * share, 2.8 - 0.3 * share, 0.3 - 0.5 * share])
    )
    assert np.max(np.abs(trajectory.tcp - expected)) < 1e-5


def test_speed_options_and_overrides(fly, ns16, home, down):
    end = down([1.0, 0.35, 0.8], np.array([0.0, 0.0, 1.2]))
    cruise = {}
    for option in SpeedOption:
        settings = CALM.changed(
            speed_option=option, linear_speed=0.2, rotational_speed=0.4, speed_override=0.5, arm_override=0.8
        )
        trajectory = fly.plan([Move(MoveType.LINEAR, CartesianTarget(end), settings)], home)
        middle = len(trajectory.t) // 2
        turn = angle_between(trajectory.tcp[middle - 5, :3, :3], trajectory.tcp[middle + 5, :3, :3]) / 0.02
        cruise[option] = (trajectory.path_speed[middle], turn, trajectory)
    assert cruise[SpeedOption.SPD_LIN][0] == pytest.approx(0.08, rel=1e-4)
    assert cruise[SpeedOption.SPD_ROT][1] == pytest.approx(0.16, rel=1e-3)
    assert cruise[SpeedOption.SPD_CONST][0] == pytest.approx(
        min(cruise[SpeedOption.SPD_LIN][0], cruise[SpeedOption.SPD_ROT][0]), rel=1e-3
    )
    by_joints = cruise[SpeedOption.SPD_JNT][2]
    assert np.max(np.abs(by_joints.qd) / ns16.max_velocity) <= 0.4 * 1.001
    assert cruise[SpeedOption.SPD_JNT][0] > 0.2


def test_acceleration_and_deceleration_have_their_own_overrides(fly, home, down):
    end = down([1.0, 0.35, 0.8])

    def ramps(**overrides):
        trajectory = fly.plan([line(end, linear_speed=0.5, **overrides)], home)
        slope = np.diff(trajectory.path_speed) / 0.002
        return slope.max(), -slope.min()

    assert ramps() == pytest.approx((1.7, 1.7), rel=0.01)
    assert ramps(acceleration_override=0.5) == pytest.approx((0.85, 1.7), rel=0.01)
    assert ramps(deceleration_override=0.4) == pytest.approx((1.7, 0.68), rel=0.01)
    assert ramps(arm_override=0.5) == pytest.approx((0.85, 0.85), rel=0.01)


def test_base_and_user_frame_move_the_targets(fly, home, corner):
    frame = pose_of([0.2, -0.1, 0.3, 0.4, 0.2, -0.1])
    as_tuple = tuple(tuple(row) for row in frame)
    plain = fly.plan([line(corner[0]), line(corner[1])], home)
    in_user = fly.plan([line(np.linalg.solve(frame, pose), uframe=as_tuple) for pose in corner], home)
    on_base = fly.plan([line(frame @ pose, base=as_tuple) for pose in corner], home)
    for other in (in_user, on_base):
        assert np.max(np.abs(other.q - plain.q)) < 1e-9


def test_the_tool_in_the_settings_overrides_the_recipe(fly, home, corner, ns16, kinematics):
    from agent.robot.dynamics import Tool

    frame = pose_of([0.01, 0.02, 0.15, 0.0, 0.1, 0.0])
    as_tuple = tuple(tuple(row) for row in frame)
    pose = corner[0] @ frame
    by_settings = fly.plan([line(pose, tool=as_tuple)], home)
    by_recipe = FlyInterpolator(ns16, Tool(frame)).plan([line(pose)], home)
    assert np.max(np.abs(by_settings.q - by_recipe.q)) < 1e-9
    assert np.max(np.abs(kinematics.forward(by_settings.q[-1:])[0] - corner[0])) < 1e-6
    assert np.max(np.abs(by_recipe.tcp[-1] - pose)) < 1e-6


def test_a_change_of_tool_is_a_stop(fly, home, corner):
    tool = tuple(tuple(row) for row in pose_of([0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    trajectory = fly.plan([line(corner[0], fly=True), line(corner[1], tool=tool)], home)
    assert np.min(trajectory.path_speed[10:-10]) < 1e-9


def test_flying_between_joint_and_linear_moves_keeps_the_distance(fly, home, kinematics, corner):
    posture = kinematics.solve(corner[0], home)
    for one, two in ((MoveType.JOINT, MoveType.LINEAR), (MoveType.LINEAR, MoveType.JOINT), (MoveType.JOINT,) * 2):
        first = JointTarget(posture) if one is MoveType.JOINT else CartesianTarget(corner[0])
        program = [Move(one, first, CALM, fly=True), Move(two, CartesianTarget(corner[1]), CALM)]
        trajectory = fly.plan(program, home)
        assert 1e-4 < nearest_to(trajectory, corner[0][:3, 3]) <= 0.02 + 1e-6
        assert np.min(np.linalg.norm(trajectory.qd[60:-60], axis=1)) > 1e-3
        assert np.max(np.abs(trajectory.tcp[-1] - corner[1])) < 1e-6


def test_interpolator_parameters_change_ramps_and_blends_slightly(ns16, fly, home, corner):
    program = [line(corner[0], fly=True, linear_speed=0.6), line(corner[1], linear_speed=0.6)]
    ours = fly.plan(program, home)
    others = FlyInterpolator(ns16, parameters=FlyParameters(blend_shape=0.1, ramp=1.6, stress_floor=0.55))
    theirs = others.plan(program, home)
    assert ours.duration != theirs.duration
    assert ours.duration == pytest.approx(theirs.duration, rel=0.05)
    assert nearest_to(theirs, corner[0][:3, 3]) <= 0.02 + 1e-9


def test_a_statement_without_motion_does_not_affect_the_others(fly, home, corner):
    plain = fly.plan([line(corner[0], fly=True), line(corner[1])], home)
    repeated = fly.plan([line(corner[0], fly=True), replace(line(corner[0]), fly=True), line(corner[1])], home)
    assert np.array_equal(plain.q, repeated.q)


def test_each_move_keeps_its_own_speed_across_a_corner(fly, home, corner):
    for speeds in ((0.4, 0.1), (0.1, 0.4)):
        program = [line(corner[0], fly=True, linear_speed=speeds[0]), line(corner[1], linear_speed=speeds[1])]
        trajectory = fly.plan(program, home)
        for k, speed in enumerate(speeds):
            own = trajectory.path_speed[trajectory.move == k]
            assert own.max() == pytest.approx(speed, rel=1e-3)
