"""What frames, turns and left-over variables mean on the fake controller, checked with Pinocchio on the URDF."""

import numpy as np
import pinocchio
import pytest
from hypothesis import Phase, given, settings, strategies as st

from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, Pdl2Settings, Termination, pose_to_pos
from agent.motion.pdl2 import parse_program, write_program
from agent.motion.pdl2.variables import SYSTEM_VARIABLES, pos_to_pose
from agent.motion.program import NO_FRAME, CartesianTarget, JointTarget, Move, MoveType, frame_of
from agent.robot import kinematics_for
from fake_controller.execution import Planner
from fake_controller.interpolation import PARAMETERS
from fake_controller.program.frames import Transform, tool_point
from fake_controller.program.interpreter import FACTORY, Interpreter, left_over
from tests.link.by_pinocchio import DATA, ROBOT, START, flange

FLY_DISTANCE = 0.02


def se3(fields) -> pinocchio.SE3:
    """x, y, z [mm], a, e, r [deg] by elementary rotations."""
    a, e, r = (
        np.array(axis) * np.radians(x) for axis, x in zip(([0, 0, 1], [0, 1, 0], [0, 0, 1]), fields[3:], strict=True)
    )
    turn = pinocchio.exp3(a) @ pinocchio.exp3(e) @ pinocchio.exp3(r)
    return pinocchio.SE3(turn, np.array(fields[:3]) / 1000.0)


def as_tuple(frame: pinocchio.SE3) -> tuple[tuple[float, ...], ...]:
    return frame_of(frame.homogeneous)


def run_on_the_fake(text: str, system: dict, start: np.ndarray = START) -> list[np.ndarray]:
    """Set-points from stop to stop."""
    interpolator = FlyInterpolator(ROBOT, period=0.005, parameters=PARAMETERS)
    statements = Interpreter(parse_program(text, "p", ROBOT), ROBOT, system).run()
    return [chain.trajectory.q for chain in Planner(interpolator).chains(statements, start)]


def frames(reach: float):
    angles = (st.floats(-180, 180), st.floats(5, 175), st.floats(-180, 180))
    return st.tuples(*[st.floats(-reach, reach)] * 3, *angles)


@given(tool=frames(200), base=frames(500), uframe=frames(800), seed=st.integers(0, 99), via=st.integers(0, 2**31))
@settings(max_examples=8, deadline=None, phases=[Phase.generate])
def test_the_tool_passes_every_programmed_position(tool, base, uframe, seed, via):
    """Whatever ran before, and by kinematics that neither planner nor fake has."""
    tool, base, uframe = se3(tool), se3(base), se3(uframe)
    rng = np.random.default_rng(via)
    corners = START + np.radians(rng.uniform(-5, 5, (4, 6)))
    fields = Pdl2Settings(
        fly_type=FlyType.FLY_CART,
        fly_trajectory=FlyTrajectory.FLY_TOL,
        fly_distance=FLY_DISTANCE,
        linear_speed=0.5,
        base=as_tuple(base),
        tool=as_tuple(tool),
        uframe=as_tuple(uframe),
    )
    points = [uframe.actInv(base * flange(q) * tool) for q in corners]
    targets = [CartesianTarget(point.homogeneous) for point in points]
    stop = fields.changed(termination=Termination.FINE)
    moves = [Move(MoveType.JOINT, JointTarget(corners[0]), stop)]
    moves += [Move(MoveType.LINEAR, target, fields, fly=True) for target in targets[1:]]
    moves.append(Move(MoveType.LINEAR, targets[0], stop))
    _, loop = run_on_the_fake(write_program("p", moves, ROBOT), left_over(seed))
    passed = np.array([uframe.actInv(base * flange(q) * tool).translation for q in loop[::2]])
    for point in points[1:]:
        assert (
            np.linalg.norm(passed - point.translation, axis=1).min() <= 1.01 * FLY_DISTANCE
        )  # between two samples it is nearer
    end = uframe.actInv(base * flange(loop[-1]) * tool)
    np.testing.assert_allclose(end.homogeneous, points[0].homogeneous, atol=1e-6)


@given(frames(900), frames(900), frames(900))
@settings(max_examples=30, deadline=None)
def test_reports_the_tool_point_in_the_user_frame(base, tool, uframe):
    expected = se3(uframe).actInv(se3(base) * flange(START) * se3(tool))
    told = tool_point(flange(START).homogeneous, base, tool, uframe)
    np.testing.assert_allclose(told.matrix, expected.homogeneous, atol=1e-9)
    np.testing.assert_allclose(se3(told.pos).homogeneous, expected.homogeneous, atol=1e-9)


@pytest.mark.parametrize("e", [0.0, 180.0])
def test_singular_euler_angles_give_the_right_frame(e):
    fields = (1.0, 2.0, 3.0, 50.0, e, -170.0)
    again = Transform.of_pos(Transform.of_pos(fields).pos).matrix
    np.testing.assert_allclose(again, se3(fields).homogeneous, atol=1e-9)
    np.testing.assert_allclose(again, pos_to_pose(np.array(fields)), atol=1e-9)


def test_agent_and_fake_know_the_same_system_variables():
    assert set(FACTORY) == set(SYSTEM_VARIABLES)


def linear(settings: Pdl2Settings) -> str:
    pose = pose_to_pos(flange(START + 0.05).homogeneous)
    return write_program("p", [Move(MoveType.LINEAR, CartesianTarget(pos_to_pose(pose)), settings)], ROBOT)


def test_a_program_without_frames_uses_those_of_the_previous_one():
    """That is why ours set them all."""
    framed = Pdl2Settings(base=NO_FRAME, tool=NO_FRAME, uframe=NO_FRAME)
    (alone,) = run_on_the_fake(linear(Pdl2Settings()), dict(FACTORY))
    (told,) = run_on_the_fake(linear(framed), left_over(3))
    np.testing.assert_allclose(told[-1], alone[-1], atol=1e-9)
    system = dict(FACTORY)
    shifted = framed.changed(uframe=as_tuple(se3((0, 0, 30, 0, 0, 0))))
    run_on_the_fake(linear(shifted), system)
    (after,) = run_on_the_fake(linear(Pdl2Settings()), system)
    rise = flange(after[-1]).translation - flange(alone[-1]).translation
    np.testing.assert_allclose(rise, [0, 0, 0.03], atol=1e-6)


@pytest.mark.parametrize(("say", "end"), [("$JNT_MTURN := TRUE\n", 300.0), ("", -60.0)])
def test_a_turn_flag_left_by_another_program_changes_the_way_round(say, end):
    text = f"PROGRAM p\nBEGIN\n{say}MOVE JOINT TO {{0, 0, -90, 0, 30, 300}}\nEND p\n"
    (way,) = run_on_the_fake(text, left_over(0), np.radians([0, 0, -90, 0, 30, 0]))
    assert np.degrees(way[-1, 5]) == pytest.approx(end)


@pytest.mark.parametrize("joint", [3, 5])
@pytest.mark.parametrize(("degrees", "turn"), [(-181, -1), (-179, 0), (0, 0), (179, 0), (181, 1), (541, 2)])
def test_turns_of_axes_4_and_6_change_at_half_turns(joint, degrees, turn):
    """T1 and T2 as the published post-processor counts them: (q + 180) // 360."""
    q = START.copy()
    q[joint] = np.radians(degrees)
    kinematics = kinematics_for(ROBOT)
    configuration = kinematics.configuration(q)
    assert configuration.turns[{3: 0, 5: 1}[joint]] == turn == (degrees + 180) // 360
    pose = kinematics.forward(q[None])[0]
    np.testing.assert_allclose(kinematics.solve_configuration(pose, str(configuration)), q, atol=1e-9)


@pytest.mark.parametrize(("fifth", "flag"), [(-30, True), (-0.1, True), (0.1, False), (30, False)])
def test_w_is_a_negative_axis_5(fifth, flag):
    q = START.copy()
    q[4] = np.radians(fifth)
    assert kinematics_for(ROBOT).configuration(q).wrist is flag


def wrist_centre(q: np.ndarray) -> np.ndarray:
    return flange(q).act(np.array([0.0, 0.0, -0.135]))


@pytest.mark.parametrize("second", [-60.0, -20.0, 30.0])
def test_s_is_the_wrist_behind_axis_1(second):
    kinematics = kinematics_for(ROBOT)
    for third in range(-165, 105, 15):
        q = np.radians([0.0, second, third, 0.0, 30.0, 0.0])
        ahead = wrist_centre(q)[0]
        if abs(ahead) > 0.02:
            assert kinematics.configuration(q).shoulder is bool(ahead < 0)


def test_e_changes_where_the_arm_is_stretched_and_is_off_at_the_calibration_pose():
    kinematics = kinematics_for(ROBOT)
    third = np.arange(-165.0, 105.0, 1.0)
    ways = np.radians([[0.0, 0.0, angle, 0.0, 30.0, 0.0] for angle in third])
    flange(ways[0])
    shoulder = DATA.oMi[2].translation.copy()
    reach = [np.linalg.norm(wrist_centre(q) - shoulder) for q in ways]
    bent = [kinematics.configuration(q).elbow for q in ways]
    assert not bent[int(np.flatnonzero(third == -90.0)[0])]
    (change,) = np.flatnonzero(np.diff(bent))
    assert abs(int(np.argmax(reach)) - change) <= 1
