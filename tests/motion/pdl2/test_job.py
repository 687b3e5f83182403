"""Real programs: moves are read, other statements are counted, unknown ones are reported."""

import re

import numpy as np
import pytest

from agent.motion.pdl2 import Pdl2Error, parse_program
from agent.motion.pdl2.reduced_job import job_text
from agent.motion.program import JointTarget, Move
from agent.robot import load_robot

ROBOT = load_robot("comau_ns16")
TASK = """PROGRAM pick &PA, NOHOLD, DETACH, PROG_ARM=1
IMPORT 'gripper'
TYPE
  header = RECORD
    length : INTEGER
  ENDRECORD
CONST
  c_port = 0x1F
  c_name = 'pick' -- MOVE is only a word here
  c_count = 2
VAR
  arm_idx, i : INTEGER
  over : POSITION FOR ARM[1]
  text : STRING[40]
  done : BOOLEAN EXPORTED FROM other NOSAVE
  home : JOINTPOS FOR ARM[1] (({0, 0, -90, 0, 60, 0}))
ROUTINE grip(force : INTEGER) EXPORTED FROM gripper
ROUTINE say
BEGIN
  WRITE LUN_CRT('MOVE TO nowhere', NL)
END say
BEGIN
  CONDITION[1]:
    WHEN done DO
      say
  ENDCONDITION
  arm_idx := 1
  $ARM_DATA[1].ARM_OVR := 50
  $SENSOR_ENBL := FALSE
  over := POS(1000, 0, 900, 0, 180, 0, '')
CYCLE
  WAIT FOR $DIN[3] = ON
  MOVE ARM[arm_idx] TO home
  FOR i := 1 TO c_count DO
    MOVEFLY LINEAR TO over ADVANCE,
      WITH $FLY_DIST = 10,
           $LIN_SPD = 0.5,
    ENDMOVE
  ENDFOR
  SELECT arm_idx OF
    CASE (1):
      grip(40)
    ELSE:
      MOVE ARM[1] JOINT TO {0, 0, -90, 0, 90, 0}
  ENDSELECT
  WRITE LUN_CRT('a', &
     i, NL)
  DELAY ROUND(1 / 3)
END pick
"""


def moves(text: str) -> list[Move]:
    kept, _ = job_text(text, "pick.pdl", ROBOT)
    return [each for each in parse_program(kept, "pick.pdl", ROBOT).run() if isinstance(each, Move)]


def test_moves_are_read_and_the_rest_is_counted():
    read = moves(TASK)
    assert [move.line for move in read] == [
        number
        for number, line in enumerate(TASK.split("\n"), 1)
        for _ in range(1 + ("FLY L" in line))
        if _is_move(line)
    ]
    assert [type(move.target) is JointTarget for move in read] == [True, False, False, True]
    assert read[1].fly
    assert (read[1].settings.fly_distance, read[1].settings.linear_speed) == (0.01, 0.5)
    assert read[1].settings.arm_override == 0.5
    passed = job_text(TASK, "pick.pdl", ROBOT)[1]
    assert {"IMPORT", "ROUTINE", "CONDITION", "WAIT", "SELECT", "GRIP", "WRITE", "DELAY"} <= set(passed)
    assert passed["ROUTINE"] == 2


def _is_move(line: str) -> bool:
    return re.match(r"\s*MOVE", line) is not None


def test_a_program_of_the_subset_stays_as_it_is():
    text = "PROGRAM p\nBEGIN\n  MOVE TO {0, 0, -90, 0, 60, 0}\nEND p\n"
    assert job_text(text, "p.pdl", ROBOT) == (text, {})


@pytest.mark.parametrize(
    ("statement", "word"),
    [
        ("MOVE ALONG trajectory", "ALONG"),
        ("MOVE TO trajectory.NODE[1].$MAIN_JNTP", "character"),
        ("MOVEFYL LINEAR TO over", "not a statement"),
        ("IF done THEN MOVE TO home ENDIF", "moves, but not in a statement"),
        ("MOVE ARM[2] TO home", "another arm"),
        ("MOVE TO elsewhere", "not declared"),
        ("SYNCMOVE TO home", "moves, but not"),
    ],
)
def test_reports_unsupported_motion_with_its_line(statement, word):
    line = TASK.split("\n").index("CYCLE") + 1
    with pytest.raises(Pdl2Error, match=word) as error:
        moves(TASK.replace("CYCLE\n", statement + "\n"))
    assert error.value.line == line


def test_refuses_to_ignore_a_routine_that_moves():
    text = TASK.replace("  WRITE LUN_CRT('MOVE TO nowhere', NL)\n", "  MOVE TO home\n")
    with pytest.raises(Pdl2Error, match="is a routine that moves, in line 20") as error:
        moves(text)
    assert error.value.line == 25


OF_A_DRIVER = """PROGRAM handler &PA, HOLD, PROG_ARM = 1, STACK = 10003
CONST
  K_ARM = 1
  K_NONE = 0x00000
VAR
  _enabled : BOOLEAN EXPORTED FROM other NOSAVE
  _frequency : INTEGER EXPORTED FROM other NOSAVE
  joints : JOINTPOS FOR ARM[K_ARM] EXPORTED FROM other
  lun : INTEGER (0)NOSAVE
  kinds : ARRAY[6] OF INTEGER
  known, at : INTEGER
  was : BOOLEAN
BEGIN
  known := _frequency
  was := _enabled
  kinds[at] := 1
  lun := K_NONE
  _enabled := FALSE
  WRITE lun("do not MOVE TO home -- now", NL)
  FOR at := 1 TO $LAST_JNT_AXIS DO
    kinds[at] := 0x1F;
  ENDFOR
  SYS_CALL('ML', 'UD:\\other.cod')
  joints := {0, 0, -90, 0, 60, 0}
  MOVEFLY ARM[K_ARM] JOINT TO joints ADVANCE
  MOVE ARM[K_ARM] JOINT TO {0, 0, -90, 0, 50, 0}
END handler
"""


def test_variables_of_other_programs_are_unknown():
    """Names with an underscore before, constants for the arm, numbers of other systems, strings of either kind."""
    assert [move.line for move in moves(OF_A_DRIVER)] == [25, 26]
    with pytest.raises(Pdl2Error, match="joints has no value") as error:
        moves(OF_A_DRIVER.replace("  joints := {0, 0, -90, 0, 60, 0}\n", "\n"))
    assert error.value.line == 25
    with pytest.raises(Pdl2Error, match="another arm"):
        moves(OF_A_DRIVER.replace("K_ARM = 1", "K_ARM = 2"))


LISTED = """PROGRAM weld HOLD, PROG_ARM=1
VAR
  pnt0001P, pnt0002P : POSITION FOR ARM[1] NOSAVE
  xtn0001X : XTNDPOS FOR ARM[1]
  jnt0001J : JOINTPOS FOR ARM[1] ({0, 0, -90, 0, 60, 0})
  count : INTEGER
BEGIN
  MOVE JOINT TO jnt0001J
  FOR count := 1 TO count DO
    MOVEFLY LINEAR TO pnt0001P ADVANCE
    MOVE LINEAR TO pnt0002P
  ENDFOR
  MOVE LINEAR TO xtn0001X
END weld
"""
VARIABLES = """pnt0001P POS Priv X:1000.000 Y:-50.5 Z:900.000 A:0.000 E:180.000 R:0.000 CNFG: 'S T1:1'

pnt0002P POS  Priv
 X: 1100.0 Y: 0.0 Z: 9.0E2 A: 10.0 E: 170.0 R: 0.0
 CNFG: ''
xtn0001X XTND Arm: 1 Ax: 1 Priv
 X:1200.0 Y:0.0 Z:900.0 A:0.0 E:180.0 R:0.0 7:33.0
 CNFG: 'S'
jnt0001J JNTP Arm: 1 AX: 6 Priv
 1:10.0 2:0.0 3:-90.0 4:0.0 5:60.0 6:-5.0
count INT Priv 2
name STR Priv 'POS Priv X:1'
"""


def test_positions_come_from_the_variable_file_next_to_the_program():
    kept, passed = job_text(LISTED, "weld.pdl", ROBOT, VARIABLES)
    read = [move for move in parse_program(kept, "weld.pdl", ROBOT).run() if isinstance(move, Move)]
    assert [move.line for move in read] == [8, 10, 11, 10, 11, 13]
    assert np.allclose(read[0].target.position, np.radians([10, 0, -90, 0, 60, -5]))  # not its value in the program
    points = [move.target.pose[:3, 3] for move in read[1:]]
    assert np.allclose([points[0], points[1], points[4]], [[1.0, -0.0505, 0.9], [1.1, 0, 0.9], [1.2, 0, 0.9]])
    assert (read[1].target.configuration, read[5].target.configuration) == ("S T1:1", "S")
    assert passed == {"auxiliary axes": 1}


@pytest.mark.parametrize(
    ("listed", "instead"),
    [
        ("Z:900.000 A", "Z:****** A"),
        ("pnt0001P POS", "pnt0001P JNTP"),
        ("pnt0001P POS Priv", "pnt0001P POS Arm: 2 Priv"),
    ],
)
def test_reports_a_move_to_a_position_missing_from_the_variable_file(listed, instead):
    assert listed in VARIABLES
    kept, _ = job_text(LISTED, "weld.pdl", ROBOT, VARIABLES.replace(listed, instead, 1))
    with pytest.raises(Pdl2Error, match="pnt0001P") as error:
        parse_program(kept, "weld.pdl", ROBOT)
    assert error.value.line == 10


SETTINGS = """PROGRAM glue
VAR
  spot : POSITION
BEGIN
  spot := POS(1000, 0, 900, 0, 180, 0, '')
  $FLY_DIST := -1.0
  $ARM_DATA[1].LIN_SPD := 0
  MOVE JOINT TO {0, 0, -90, 0, 60, 0}
  MOVEFLY LINEAR TO spot ADVANCE WITH CONDITION[2]
  MOVEFLY LINEAR TO spot ADVANCE, WITH CONDITION[1], CONDITION[7], WITH $LIN_SPD = 0.2
  MOVEFLY LINEAR TO spot ADVANCE WITH $FLY_DIST = -5, $LIN_SPD = 0.2,
  ENDMOVE
  MOVEFLY LINEAR TO spot ADVANCE WITH $LIN_SPD = 0.3, $FLY_DIST = -5
  MOVE LINEAR TO spot WITH $FLY_DIST = -5
  MOVE LINEAR TO spot TIL $DIN[4] = TRUE, WITH $LIN_SPD = 0.1
  MOVEFLY TO spot ADVANCE TIL CONDITION[3]
END glue
"""


def test_conditions_and_unsupported_settings_are_ignored_and_counted():
    kept, passed = job_text(SETTINGS, "glue.pdl", ROBOT)
    read = [each for each in parse_program(kept, "glue.pdl", ROBOT).run() if isinstance(each, Move)]
    assert [move.line for move in read] == [8, 9, 10, 11, 13, 14, 15, 16]
    assert passed == {"WITH": 2, "TIL": 2, "$FLY_DIST": 4, "$LIN_SPD": 1}
    assert [round(move.settings.linear_speed, 9) for move in read[2:5]] == [0.2, 0.2, 0.3]


def test_refuses_to_ignore_an_unsupported_frame():
    frame = SETTINGS.replace("$FLY_DIST := -1.0", "$TOOL := 3")
    kept, passed = job_text(frame, "glue.pdl", ROBOT)
    assert "$TOOL" not in passed
    with pytest.raises(Pdl2Error, match=r"glue\.pdl:6"):
        parse_program(kept, "glue.pdl", ROBOT)
