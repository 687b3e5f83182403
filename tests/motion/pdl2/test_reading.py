"""What people write parses, and does what the controller would do."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from agent.motion import FlyTrajectory, FlyType, OrientationType, Pdl2Settings, SpeedOption, Termination
from agent.motion.pdl2 import Pdl2Error, parse_program
from agent.motion.program import NO_FRAME, CartesianTarget, Delay, JointTarget, MoveType
from agent.robot.description import load_robot


def moves(text: str, **options):
    return list(parse_program(text).run(**options))


def body(statements: str, declarations: str = "") -> str:
    return f"PROGRAM t HOLD\n{declarations}\nBEGIN\n{statements}\nEND t\n"


FIELD = Pdl2Settings(
    fly_type=FlyType.FLY_CART,
    speed_option=SpeedOption.SPD_LIN,
    fly_trajectory=FlyTrajectory.FLY_TOL,
    stress_percent=50,
    fly_distance=0.02,
    linear_speed=0.8,
    termination=Termination.COARSE,
    tolerance_coarse=0.001,
)
FIELD_SETTINGS = [
    "$FLY_TYPE = FLY_CART",
    "$MOVE_TYPE = LINEAR",
    "$SPD_OPT = SPD_LIN",
    "$FLY_TRAJ = FLY_TOL",
    "$STRESS_PER = 50",
    "$FLY_DIST = 20",
    "$LIN_SPD = 0.8",
    "$TERM_TYPE = COARSE",
    "$TOL_COARSE = 1",
]
LAYOUTS = {
    "one line": "MOVEFLY LINEAR TO p ADVANCE, WITH " + ", ".join(FIELD_SETTINGS) + ", ENDMOVE",
    "one line without commas or ENDMOVE": "MOVEFLY LINEAR TO p ADVANCE WITH " + ", ".join(FIELD_SETTINGS),
    "a setting a line": "MOVEFLY LINEAR TO p ADVANCE,\n   WITH " + ",\n        ".join(FIELD_SETTINGS) + ",\nENDMOVE",
    "a WITH a setting": "MOVEFLY LINEAR TO p ADVANCE,\n" + "".join(f" WITH {s},\n" for s in FIELD_SETTINGS) + "ENDMOVE",
    "a WITH a setting, no commas": "MOVEFLY LINEAR TO p ADVANCE\n"
    + "".join(f" WITH {s}\n" for s in FIELD_SETTINGS)
    + "ENDMOVE",
    "lower case": ("MOVEFLY LINEAR TO p ADVANCE, WITH " + ", ".join(FIELD_SETTINGS) + ", ENDMOVE").lower(),
    "no blanks": "MOVEFLY LINEAR TO p ADVANCE,WITH " + ",".join(FIELD_SETTINGS).replace(" = ", "=") + ",ENDMOVE",
    "comments inside": "MOVEFLY LINEAR TO p ADVANCE, -- on we go\n WITH -- how\n"
    + ", -- and\n".join(FIELD_SETTINGS)
    + ", -- that is all\nENDMOVE -- done",
    "continued lines": "MOVEFLY LINEAR TO p & -- on\n ADVANCE, & \n WITH " + ", &\n".join(FIELD_SETTINGS) + ", ENDMOVE",
    "ADVANCE last": "MOVEFLY LINEAR TO p,\n WITH " + ", ".join(FIELD_SETTINGS) + ",\n ADVANCE,\nENDMOVE",
    "$MOVE_TYPE instead of the word": "MOVEFLY TO p ADVANCE, WITH " + ", ".join(FIELD_SETTINGS) + ", ENDMOVE",
    "tabs and Windows line ends": "\tMOVEFLY\tLINEAR TO p\tADVANCE,\r\n\tWITH "
    + ",\r\n\t".join(FIELD_SETTINGS)
    + ",\r\nENDMOVE\r\n",
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_the_fly_statement_mean_the_same(layout):
    (move,) = moves(body("p := POS(900, 0, 800, 0, 180, 0, '')\n" + LAYOUTS[layout], "VAR p : POSITION"))
    assert move.settings == FIELD
    assert (move.type, move.fly, move.name) == (MoveType.LINEAR, True, "p")


def test_a_whole_program_with_declarations_loops_and_arithmetic():
    text = """
    -- taught on Monday
    program Task ez, prog_arm=1, hold, stack=2000
    CONST
       height = 800.5 ; cfg = 'S W T1:1'
       rounds = 2
    TYPE points = ARRAY[3] OF POSITION
    VAR p : points
        home : JOINTPOS NOSAVE
        i, j : INTEGER
        x : REAL (100)
    BEGIN
      FOR i := 1 TO 3 DO
        p[i] := POS(x * i + 1e2, -50.0, height, 0, 180 - 10, 3 * (i - 1), cfg)
      ENDFOR
      home := {0, 0, -90, 0, 90.5, -.5}
      MOVE JOINT TO home
      FOR j := rounds DOWNTO 1 DO
        FOR i := 1 TO 3 STEP 2 DO
          MOVEFLY LINEAR TO p[i] ADVANCE
        ENDFOR
        DELAY 250 * j
      ENDFOR
      MOVE LINEAR TO p[7 DIV 3]; MOVE CIRCULAR TO p[1] VIA p[3 MOD 2 + 1]
    END task
    """
    result = moves(text)
    assert [m.name for m in result if not isinstance(m, Delay)] == ["home", *(2 * ["p[1]", "p[3]"]), "p[2]", "p[1]"]
    assert [each.seconds for each in result if isinstance(each, Delay)] == [0.5, 0.25]
    home, first, third, *_, second, circle = result
    assert isinstance(home.target, JointTarget)
    np.testing.assert_allclose(home.target.position, np.radians([0, 0, -90, 0, 90.5, -0.5]), rtol=1e-15)
    assert isinstance(first.target, CartesianTarget)
    np.testing.assert_allclose(first.target.pose[:3, 3], [0.2, -0.05, 0.8005])
    np.testing.assert_allclose(third.target.pose[:3, 3], [0.4, -0.05, 0.8005])
    assert first.target.configuration == "S W T1:1"
    assert circle.type is MoveType.CIRCULAR
    np.testing.assert_array_equal(circle.via.pose, second.target.pose)
    assert (first.fly, second.fly) == (True, False)
    assert text.split("\n")[first.line - 1].strip() == "MOVEFLY LINEAR TO p[i] ADVANCE"


def test_system_variables_hold_until_changed_and_with_holds_for_its_move():
    result = moves(
        body(
            """
            $LIN_SPD := 0.5
            $ORNT_TYPE := RS_TRAJ
            MOVE LINEAR TO {0}
            MOVE LINEAR TO {0} WITH $LIN_SPD = $LIN_SPD / 2, $CNFG_CARE = TRUE
            $LIN_SPD := $LIN_SPD + 0.1
            MOVE LINEAR TO {0}
            """
        )
    )
    start = replace(Pdl2Settings(), linear_speed=0.5, orientation=OrientationType.RS_TRAJ)
    assert [m.settings for m in result] == [
        start,
        start.changed(linear_speed=0.25, configuration_care=True),
        start.changed(linear_speed=0.6),
    ]


def test_units_of_every_variable():
    (move,) = moves(
        body(
            """
            $FLY_DIST := 12.5; $FLY_PER := 80; $STRESS_PER := 30; $ROT_SPD := 1.5; $TOL_FINE := 0.2; $TOL_COARSE := 2
            $PROG_SPD_OVR := 50; $ARM_SPD_OVR := 40; $PROG_ACC_OVR := 30; $ARM_DEC_OVR := 20; $ARM_OVR := 10
            $TERM_TYPE := NOSETTLE; $SPD_OPT := SPD_ROT; $TURN_CARE := ON; $SING_CARE := FALSE; $FLY_TRAJ := FLY_FROM
            $TOOL := POS(0, 0, 120, 0, 0, 0, ''); $BASE := POS(0, 0, 0, 0, 0, 0, ''); $MOVE_TYPE := LINEAR
            MOVE TO {1}
            """
        )
    )
    tool = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.12), (0.0, 0.0, 0.0, 1.0))
    assert move.settings == Pdl2Settings(
        fly_distance=0.0125,
        fly_percent=80,
        stress_percent=30,
        rotational_speed=1.5,
        tolerance_fine=0.0002,
        tolerance_coarse=0.002,
        speed_override=0.2,
        acceleration_override=0.3,
        deceleration_override=0.2,
        arm_override=0.1,
        termination=Termination.NOSETTLE,
        speed_option=SpeedOption.SPD_ROT,
        fly_trajectory=FlyTrajectory.FLY_FROM,
        turn_care=True,
        base=NO_FRAME,  # said, which is more than not said
        tool=tool,
    )
    assert move.settings.uframe is None
    assert move.type is MoveType.LINEAR


def test_the_trajectory_word_overrides_move_type_and_joint_is_the_default():
    result = moves(body("MOVE TO {0}\n$MOVE_TYPE := LINEAR\nMOVE TO {0}\nMOVE JOINT TO {0}"))
    assert [m.type for m in result] == [MoveType.JOINT, MoveType.LINEAR, MoveType.JOINT]


def test_an_endless_program_is_run_lazily():
    program = parse_program("PROGRAM a HOLD\nVAR n : INTEGER (0)\nBEGIN CYCLE\nMOVE TO {n}\nn := n + 1\nEND a")
    assert program.cycle
    assert [m.target.position[0] for m in itertools.islice(program.run(), 3)] == pytest.approx(np.radians([0, 1, 2]))
    assert len(list(itertools.islice(program.run(), 20_000))) == 20_000
    with pytest.raises(Pdl2Error, match="more than 100 statements"):
        list(program.run(limit=100))


def test_a_loop_without_moves_ends_at_the_limit():
    program = parse_program(body("FOR i := 1 TO 2000000000 DO\nENDFOR", "VAR i : INTEGER"))
    with pytest.raises(Pdl2Error, match="more than 1000 statements"):
        list(program.run(limit=1000))


def test_loops_whose_range_is_empty_do_not_run():
    declared = "VAR i : INTEGER"
    assert moves(body("FOR i := 2 TO 1 DO\nMOVE TO {0}\nENDFOR", declared)) == []
    assert moves(body("FOR i := 1 DOWNTO 2 DO\nMOVE TO {0}\nENDFOR", declared)) == []
    assert len(moves(body("FOR i := 3 DOWNTO 1 STEP 2 DO\nMOVE TO {0}\nENDFOR", declared))) == 2


def test_with_a_robot_the_number_of_joints_is_checked():
    robot = load_robot("comau_ns16")
    assert list(parse_program(body("MOVE TO {0, 0, -90, 0, 0, 0}"), robot=robot).run())
    with pytest.raises(Pdl2Error, match="has 5 joints; comau_ns16 has 6") as caught:
        parse_program(body("MOVE TO {0, 0, -90, 0, 0}"), robot=robot)
    assert (caught.value.line, caught.value.column) == (4, 9)


def test_prismatic_joints_are_millimetres():
    robot = load_robot("comau_ns16")
    robot = replace(robot, joints=(replace(robot.joints[0], prismatic=True), *robot.joints[1:]))
    (move,) = parse_program(body("MOVE TO {250, 0, -90, 0, 0, 0}"), robot=robot).run()
    np.testing.assert_allclose(move.target.position, [0.25, 0, -np.pi / 2, 0, 0, 0])


def test_old_line_endings_end_a_comment():
    assert len(moves(body("-- a comment\rMOVE TO {0}\r"))) == 1


def test_pos_has_six_or_seven_fields():
    result = moves(body("MOVE TO POS(1, 2, 3, 0, 90, 0)\nMOVE TO POS(1, 2, 3, 0, 90, 0, '')"))
    np.testing.assert_array_equal(result[0].target.pose, result[1].target.pose)
    assert result[0].target.configuration == ""


def test_accepts_arm_names_as_in_published_programs():
    text = """PROGRAM p
VAR
  a, b : JOINTPOS FOR ARM[1]
  c : ARRAY[2] OF POSITION FOR ARM[1]
BEGIN
  a := {10}
  $ARM_DATA[1].ARM_OVR := 45
  MOVE TO a
END p
"""
    (move,) = parse_program(text).run()
    assert move.settings.arm_override == 0.45
    with pytest.raises(Pdl2Error, match="another arm"):
        parse_program(text.replace("JOINTPOS FOR ARM[1]", "JOINTPOS FOR ARM[2]"))
    with pytest.raises(Pdl2Error, match="not a system variable"):
        parse_program(text.replace("$ARM_DATA[1].ARM_OVR", "$ARM_DATA[1].ARM_NOTHING"))
