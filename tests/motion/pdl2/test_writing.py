"""The parser reads back the writer's programs unchanged."""

from dataclasses import fields
from enum import Enum

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.motion import FlyTrajectory, FlyType, OrientationType, Pdl2Settings, SpeedOption, Termination
from agent.motion.pdl2 import parse_program, write_loop_program, write_program
from agent.motion.pdl2.variables import pos_to_pose
from agent.motion.program import NO_FRAME, CartesianTarget, Delay, JointTarget, LoopProgram, Move, MoveType
from agent.robot.description import load_robot


def approximately(low: float, high: float):
    return st.floats(low, high, allow_subnormal=False)


CONFIGURATIONS = st.sampled_from(["", "S", "E W", "S E W T1:0 T2:-1 T3:12", "w t1:1"])
CARTESIAN = st.builds(
    lambda pos, configuration: CartesianTarget(pos_to_pose(np.array(pos)), configuration),
    st.tuples(*[approximately(-3000, 3000)] * 3, *[approximately(-360, 360)] * 3),
    CONFIGURATIONS,
)
JOINTS = st.builds(
    lambda q: JointTarget(np.array(q)), st.lists(approximately(-7, 7), min_size=6, max_size=6).filter(len)
)
TARGETS = CARTESIAN | JOINTS
FRAMES = st.none() | st.builds(lambda target: tuple(tuple(float(x) for x in row) for row in target.pose), CARTESIAN)
PERCENT = st.integers(1, 100)
OVERRIDE = PERCENT.map(lambda percent: percent / 100)
SETTINGS = st.builds(
    Pdl2Settings,
    fly_type=st.sampled_from(FlyType),
    fly_trajectory=st.sampled_from(FlyTrajectory),
    fly_distance=st.just(0.0) | approximately(1e-4, 1),
    fly_percent=PERCENT,
    stress_percent=PERCENT,
    speed_option=st.sampled_from(SpeedOption),
    linear_speed=approximately(1e-4, 3),
    rotational_speed=approximately(1e-4, 9),
    orientation=st.sampled_from(OrientationType),
    termination=st.sampled_from(Termination),
    tolerance_fine=approximately(1e-6, 0.1),
    tolerance_coarse=approximately(1e-6, 0.1),
    speed_override=OVERRIDE,
    acceleration_override=OVERRIDE,
    deceleration_override=OVERRIDE,
    arm_override=OVERRIDE,
    base=FRAMES,
    tool=FRAMES,
    uframe=FRAMES,
    configuration_care=st.booleans(),
    turn_care=st.booleans(),
    singularity_care=st.booleans(),
    multi_turn=st.booleans(),
)


@st.composite
def any_move(draw):
    kind = draw(st.sampled_from(MoveType))
    via = draw(TARGETS) if kind is MoveType.CIRCULAR else None
    return Move(kind, draw(TARGETS), draw(SETTINGS), draw(st.booleans()), via)


STATEMENTS = any_move() | st.builds(Delay, approximately(0, 3600))


def assert_same_target(found, expected):
    assert type(found) is type(expected)
    if isinstance(expected, CartesianTarget):
        assert found.configuration == expected.configuration
        np.testing.assert_allclose(found.pose, expected.pose, atol=1e-9)
    elif expected is not None:
        np.testing.assert_allclose(found.position, expected.position, atol=1e-9)


def assert_same_settings(found: Pdl2Settings, expected: Pdl2Settings):
    for field in fields(Pdl2Settings):
        a, b = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(b, Enum | bool) or b is None:
            assert a == b, field.name
        else:
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9, err_msg=field.name)


def assert_same_statement(found, expected):
    if isinstance(expected, Delay):
        assert found.seconds == pytest.approx(expected.seconds, rel=1e-9, abs=1e-12)
        return
    assert (found.type, found.fly) == (expected.type, expected.fly)
    assert_same_target(found.target, expected.target)
    assert_same_target(found.via, expected.via)
    assert_same_settings(found.settings, expected.settings)


@given(st.lists(STATEMENTS, max_size=4))
@settings(max_examples=50, deadline=None)
def test_statements_round_trip(statements):
    text = write_program("any_moves", statements)
    found = list(parse_program(text).run())
    assert len(found) == len(statements)
    for a, b in zip(found, statements, strict=True):
        assert_same_statement(a, b)
    again = list(parse_program(write_program("any_moves", found)).run())
    for a, b in zip(again, statements, strict=True):
        assert_same_statement(a, b)


@given(st.lists(TARGETS, min_size=2, max_size=4), SETTINGS, SETTINGS, st.integers(1, 4))
@settings(max_examples=25, deadline=None)
def test_a_loop_approaches_and_ends_every_cycle_stationary(points, going, approach, cycles):
    text = write_loop_program("loop", LoopProgram.of(points, going, cycles, approach))
    found = list(parse_program(text).run())
    fine = going.changed(termination=Termination.FINE)
    expected = [Move(MoveType.JOINT, points[0], approach.changed(termination=Termination.FINE))]
    cycle = [Move(MoveType.LINEAR, point, going, fly=True) for point in points[1:]]
    cycle.append(Move(MoveType.LINEAR, points[0], fine))
    expected += cycle * cycles
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert_same_statement(a, b)


FIELD = Pdl2Settings(
    fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02, linear_speed=1.0
)


def point(*pos, configuration=""):
    return CartesianTarget(pos_to_pose(np.array(pos)), configuration)


def test_the_text_of_a_loop_uses_common_pdl2():
    points = [point(1000, -200, 800, 0, 180, 0, configuration="W T1:0"), point(1000, 200, 800, 0, 150, 30)]
    text = write_loop_program("ns16_loop", LoopProgram.of(points, FIELD, 100))
    assert text.startswith("PROGRAM ns16_loop HOLD, PROG_ARM=1\nVAR\n")
    assert "  p1 := POS(1000, -200, 800, 0, 180, 0, 'W T1:0')\n" in text
    assert "  p2 := POS(1000, 200, 800, 0, 150, 30, '')\n" in text
    assert "  MOVE JOINT TO p1,\n    WITH $TERM_TYPE = FINE, $PROG_SPD_OVR = 10,\n  ENDMOVE\n" in text
    flying = (
        "    MOVEFLY LINEAR TO p2 ADVANCE,\n"
        "      WITH $FLY_TYPE = FLY_CART, $MOVE_TYPE = LINEAR, $SPD_OPT = SPD_LIN, $FLY_TRAJ = FLY_TOL,\n"
        "      WITH $STRESS_PER = 50, $FLY_DIST = 20, $LIN_SPD = 1, $TERM_TYPE = COARSE, $TOL_COARSE = 1,\n"
        "    ENDMOVE\n"
        "    MOVE LINEAR TO p1,\n      WITH $TERM_TYPE = FINE,\n    ENDMOVE\n  ENDFOR\nEND ns16_loop\n"
    )
    assert text.endswith("  FOR cycle_number := 1 TO 100 DO\n" + flying)
    assert all(len(line) <= 120 for line in text.split("\n"))
    assert "$TOOL" not in text  # no move says anything of it
    assert "p1, p2 : POSITION FOR ARM[1]" in text


def test_a_loop_sets_frames_turns_and_override():
    tool = tuple(map(tuple, pos_to_pose(np.array([0, 0, 120, 0, 90, 0])).tolist()))
    framed = FIELD.changed(base=NO_FRAME, tool=tool, uframe=NO_FRAME)
    points = [point(1000, -200, 800, 0, 180, 0), point(1000, 200, 800, 0, 150, 30)]
    start = JointTarget(np.radians([10, 0, -90, 0, 30, 400]))
    text = write_loop_program("ns16_loop", LoopProgram.of(points, framed, 3, start=start))
    before_motion = text[: text.index("MOVE")]
    for line in (
        "$BASE := POS(0, 0, 0, 0, 0, 0, '')",
        "$TOOL := POS(0, 0, 120, 0, 90, 0, '')",
        "$UFRAME := POS(0, 0, 0, 0, 0, 0, '')",
        "$JNT_MTURN := TRUE",
        "$ORNT_TYPE := RS_WORLD",
        "$TERM_TYPE := COARSE",
        "$LIN_SPD := 1",
        "$PROG_SPD_OVR := 100",
        "$ARM_DATA[1].ARM_OVR := 100",
        "$ARM_DATA[1].ARM_SPD_OVR := 100",
        "p3 := {10, 0, -90, 0, 30, 400}",
    ):
        assert f"  {line}\n" in before_motion
    assert "  MOVE JOINT TO p3,\n" in text
    first, *others = parse_program(text).run()
    np.testing.assert_allclose(first.target.position, start.position, atol=1e-9)
    assert {type(move.target) for move in others} == {CartesianTarget}


def test_a_frame_named_by_some_moves_is_written_with_them():
    framed = FIELD.changed(uframe=NO_FRAME)
    moves = [Move(MoveType.LINEAR, point(1, 2, 3, 0, 0, 0), settings) for settings in (FIELD, framed, FIELD)]
    text = write_program("t", moves)
    assert "$UFRAME :=" not in text
    assert [move.settings.uframe for move in parse_program(text).run()] == [None, NO_FRAME, None]


def test_configured_values_round_trip_exactly():
    chosen = FIELD.changed(speed_override=0.3, tolerance_fine=0.0003, arm_override=0.7, fly_distance=0.035)
    (move,) = parse_program(write_program("t", [Move(MoveType.LINEAR, point(1, 2, 3, 0, 0, 0), chosen)])).run()
    assert move.settings == chosen


def test_equal_points_are_one_variable():
    points = [point(*[100 * k] * 3, 0, 90, 0) for k in (1, 2, 1)]
    text = write_program("t", [Move(MoveType.LINEAR, p) for p in points])
    assert "p1, p2 : POSITION" in text
    assert [m.name for m in parse_program(text).run()] == ["p1", "p2", "p1"]


def test_prismatic_joints_are_written_in_millimetres():
    from dataclasses import replace

    robot = load_robot("comau_ns16")
    robot = replace(robot, joints=(*robot.joints[:5], replace(robot.joints[5], prismatic=True)))
    target = JointTarget(np.array([0, 0, -np.pi / 2, 0, 0, 0.125]))
    text = write_program("t", [Move(MoveType.JOINT, target)], robot)
    assert "{0, 0, -90, 0, 0, 125}" in text
    (move,) = parse_program(text, robot=robot).run()
    np.testing.assert_allclose(move.target.position, target.position, atol=1e-12)


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda p: write_program("9lives", [Move(MoveType.LINEAR, p)]), "program name '9lives'"),
        (lambda p: write_program("a" * 33, [Move(MoveType.LINEAR, p)]), "32 characters"),
        (lambda p: write_program("while", [Move(MoveType.LINEAR, p)]), "'while'"),
        (lambda p: write_program("move", [Move(MoveType.LINEAR, p)]), "'move'"),
        (lambda p: write_program("t", [Move(MoveType.LINEAR, p, FIELD.changed(fly_percent=0))]), r"\$FLY_PER is 0"),
        (lambda p: write_program("t", [Move(MoveType.LINEAR, p, FIELD.changed(speed_override=0.125))]), "INTEGER"),
        (lambda p: write_program("t", [Delay(7200)]), "DELAY"),
        (lambda p: write_program("t", [Move(MoveType.CIRCULAR, p)]), "VIA"),
        (lambda p: write_program("t", [Move(MoveType.LINEAR, point(0, 0, np.nan, 0, 0, 0))]), "finite"),
        (lambda p: write_program("t", [Move(MoveType.LINEAR, point(0, 0, 0, 0, 0, 0, configuration="'"))]), "flag"),
        (lambda p: LoopProgram.of([p], FIELD, 1), "at least 2 points"),
        (lambda p: LoopProgram.of([p, p], FIELD, 0), "number of cycles"),
    ],
)
def test_refuses_to_write_what_could_not_be_read(write, reason):
    with pytest.raises(InputError, match=reason):
        write(point(1000, 0, 800, 0, 180, 0))
