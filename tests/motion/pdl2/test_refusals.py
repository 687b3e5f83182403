"""Everything outside the subset is refused with line, column and word, never skipped."""

import itertools

import pytest

from agent.core.errors import InputError
from agent.motion.pdl2 import Pdl2Error, parse_program

DECLARATIONS = """VAR p, q : POSITION
  ps : ARRAY[3] OF POSITION
  j : JOINTPOS
  i : INTEGER
  x : REAL
  b : BOOLEAN
"""

# statement, the word refused, a part of the reason
STATEMENTS = [
    # words of PDL2 outside the subset
    ("WAIT FOR $DIN[1]", "WAIT", "not of the motion subset"),
    ("WHILE b DO\nENDWHILE", "WHILE", "not of the motion subset"),
    ("IF b THEN\nENDIF", "IF", "not of the motion subset"),
    ("b := NOT b", "NOT", "not of the motion subset"),
    ("OPEN HAND 1", "OPEN", "not of the motion subset"),
    ("MOVE NEAR p BY 100", "NEAR", "not of the motion subset"),
    ("MOVE RELATIVE VEC(0, 0, 1) IN TOOL", "RELATIVE", "not of the motion subset"),
    ("MOVE ARM[1] TO j", "ARM", "not of the motion subset"),
    ("MOVE TO j TIL $DIN[1]", "TIL", "not of the motion subset"),
    ("MOVE TO j WITH CONDITION[1], ENDMOVE", "CONDITION", "not of the motion subset"),
    ("MOVE LINEAR TO j SYNCMOVE ARM[2] TO j", "SYNCMOVE", "not of the motion subset"),
    # words nobody knows
    ("grind(3)", "grind", "is not a statement"),
    ("stop", "stop", "is not a statement"),
    ("$DOUT[1] := ON", "[", "does not belong here"),
    ("$PAYLOAD := 1", "$PAYLOAD", "not a system variable"),
    ("MOVE TO j WITH $JERK = 3", "$JERK", "not a system variable"),
    ("MOVEFLY SPLINE TO j ADVANCE", "SPLINE", "does not belong here"),
    ("x := SQRT(2)", "(", "does not belong here"),
    ("x := 2 ** 3", "*", "does not belong here"),
    ("x := 5 ° 3", "°", "no meaning"),
    ("j := {1, 2", "END", "does not belong here"),
    ("FOR i := 1 TO 2 DO", "END", "does not belong here"),
    ("ENDFOR", "ENDFOR", "does not belong here"),
    ("MOVE TO j WITH $LIN_SPD := 3", ":=", "does not belong here"),
    ("$LIN_SPD = 3", "=", "does not belong here"),
    ("MOVE TO j, WITH $LIN_SPD = 0.1,\nDELAY 5", "DELAY", "does not belong here"),
    ("DELAY 5 DELAY 6", "DELAY", "a line of its own"),
    ("p := POS(0,0,0,0,0,0,'S", "'", "not closed"),
    # names and data types
    ("k := 1", "k", "not declared"),
    ("MOVE TO nowhere", "nowhere", "not declared"),
    ("FOR k := 1 TO 2 DO\nENDFOR", "k", "not declared"),
    ("MOVE TO i", "i", "is INTEGER where POS or JOINTPOS is needed"),
    ("i := 2.5", "2.5", "is REAL where INTEGER is needed"),
    ("i := 4 / 2", "/", "is REAL where INTEGER is needed"),
    ("i := TRUE", "TRUE", "is BOOLEAN"),
    ("p := {0, 0}", "{", "is JOINTPOS where POS"),
    ("p := ps", "ps", "ARRAY[3] OF POS"),
    ("p[1] := q", "p", "not an array"),
    ("x := 'three'", "'three'", "is STRING"),
    ("x := 1 + 'a'", "'a'", "takes INTEGER or REAL"),
    ("b := 1 < 2", "<", "no meaning"),
    ("b := i", "i", "is INTEGER where BOOLEAN is needed"),
    ("FOR i := 1 TO 2.5 DO\nENDFOR", "2.5", "INTEGER"),
    ("FOR x := 1 TO 2 DO\nENDFOR", "x", "INTEGER"),
    ("DELAY b", "b", "is BOOLEAN"),
    ("FINE := 3", "FINE", "is a constant"),
    ("$FLY_TYPE := LINEAR", "LINEAR", "FLY_NORM, FLY_CART"),
    ("$TERM_TYPE := 3", "3", "is INTEGER where predefined is needed"),
    ("$LIN_SPD := FINE", "FINE", "is predefined constant where INTEGER or REAL"),
    ("$TOOL := {0}", "{", "is JOINTPOS where POS is needed"),
    # POS, JOINTPOS
    ("p := POS(1, 2, 3)", "POS", "6 fields"),
    ("p := POS(1, 2, 3, 4, 5, 6, '', 8)", "POS", "or 7"),
    ("p := POS(1, 2, TRUE, 4, 5, 6, '')", "TRUE", "coordinate"),
    ("p := POS(1, 2, 3, 4, 5, 6, 7)", "7", "configuration"),
    ("p := POS(1, 2, 3, 4, 5, 6, 'UP')", "'UP'", "configuration flag"),
    ("p := POS(1, 2, 3, 4, 5, 6, 'S W S')", "'S W S'", "given twice"),
    ("j := {1,2,3,4,5,6,7,8,9,10,11}", "{", "at most 10 joints"),
    # moves
    ("MOVE CIRCULAR TO j", "MOVE", "needs VIA"),
    ("MOVE LINEAR TO j VIA j", "j", "belongs to a CIRCULAR move"),
    ("MOVE TO {0} VIA {1}", "MOVE", "belongs to a CIRCULAR move"),
    ("MOVE CIRCULAR TO {0} VIA {1} VIA {2}", "{", "twice"),
    ("MOVEFLY TO {0} ADVANCE ADVANCE", "ADVANCE", "twice"),
    ("MOVE TO {0} WITH $LIN_SPD = 1, $LIN_SPD = 2", "$LIN_SPD", "twice"),
    # values
    ("MOVE TO p", "p", "has no value yet"),
    ("ps[1] := POS(1,2,3,4,5,6,'')\nMOVE TO ps[2]", "ps", "ps[2] has no value yet"),
    ("x := x + 1", "x", "has no value yet"),
    ("i := 4\nMOVE TO ps[i]", "i", "its elements are 1..3"),
    ("ps[0] := POS(1,2,3,4,5,6,'')", "0", "its elements are 1..3"),
    ("$FLY_DIST := -1", "$FLY_DIST", "at least 0 mm"),
    ("MOVEFLY TO {0} ADVANCE WITH $FLY_PER = 101", "$FLY_PER", "in 1..100 %"),
    ("$FLY_PER := 0", "$FLY_PER", "in 1..100 %"),
    ("$STRESS_PER := 0", "$STRESS_PER", "in 1..100 %"),
    ("$STRESS_PER := 12.5", "12.5", "REAL where INTEGER"),
    ("$PROG_SPD_OVR := 120", "$PROG_SPD_OVR", "in 1..100 %"),
    ("$LIN_SPD := 0", "$LIN_SPD", "above 0 m/s"),
    ("DELAY -1", "DELAY", "0..3600000 ms"),
    ("x := 1 / 0", "/", "divides by zero"),
    ("i := 1 MOD 0", "MOD", "divides by zero"),
    ("i := 2147483648", "2147483648", "larger than"),
    ("i := 2147483647 + 1", "+", "beyond the integers"),
    ("x := 1e999", "1e999", "too large"),
    ("x := 1e200 * 1e200", "*", "beyond the numbers"),
    ("FOR i := 1 TO 2 STEP 0 DO\nENDFOR", "FOR", "at least 1"),
    ("i := 9" + "9" * 5000, "9" + "9" * 5000, "larger than"),
]


@pytest.mark.parametrize(("statement", "word", "reason"), STATEMENTS, ids=[s[0][:40] for s in STATEMENTS])
def test_refuses_invalid_statements_with_line_and_column(statement, word, reason):
    text = f"PROGRAM t HOLD\n{DECLARATIONS}BEGIN\n{statement}\nEND t\n"
    with pytest.raises(Pdl2Error) as caught:
        parse_program(text, "task.pdl")
    error = caught.value
    assert error.word == word
    assert text.split("\n")[error.line - 1][error.column - 1 :].startswith(word)
    assert reason in str(error)
    assert str(error).startswith(f"task.pdl:{error.line}:{error.column}: ")
    assert isinstance(error, InputError)


HEADERS = [
    ("PROGRAM t NOHOLD\nBEGIN\nEND t", "NOHOLD", "cannot move"),
    ("PROGRAM t FAST\nBEGIN\nEND t", "FAST", "attribute"),
    ("PROGRAM t HOLD, PROG_ARM=2\nBEGIN\nEND t", "2", "1..1"),
    ("PROGRAM t HOLD, HOLD\nBEGIN\nEND t", "HOLD", "twice"),
    ("PROGRAM t STACK\nBEGIN\nEND t", "STACK", "integer"),
    ("PROGRAM t HOLD\nBEGIN\nEND u", "u", "END names the program"),
    ("PROGRAM t HOLD\nBEGIN\nEND t\nMOVE TO {0}", "MOVE", "does not belong here"),
    ("PROGRAM t HOLD\nROUTINE r\nBEGIN\nEND r\nBEGIN\nEND t", "ROUTINE", "not of the motion subset"),
    ("PROGRAM t HOLD\nIMPORT 'other'\nBEGIN\nEND t", "IMPORT", "not of the motion subset"),
    ("PROGRAM t HOLD\nVAR p : XTNDPOS\nBEGIN\nEND t", "XTNDPOS", "not of the motion subset"),
    ("PROGRAM t HOLD\nVAR p : VECTOR\nBEGIN\nEND t", "VECTOR", "not of the motion subset"),
    ("PROGRAM t HOLD\nVAR p : POSITION EXPORTED FROM u\nBEGIN\nEND t", "EXPORTED", "not of the motion subset"),
    ("PROGRAM t HOLD\nVAR p : STRING[8]\nBEGIN\nEND t", "[", "does not belong here"),
    ("PROGRAM t HOLD\nTYPE r = RECORD\nBEGIN\nEND t", "RECORD", "not of the motion subset"),
    ("PROGRAM t HOLD\nVAR p : POINT\nBEGIN\nEND t", "POINT", "not a data type"),
    ("PROGRAM t HOLD\nVAR p : POSITION\n    P : REAL\nBEGIN\nEND t", "P", "twice"),
    ("PROGRAM t HOLD\nVAR Fine : REAL\nBEGIN\nEND t", "Fine", "predefined"),
    ("PROGRAM t HOLD\nVAR move : REAL\nBEGIN\nEND t", "move", "does not belong here"),
    ("PROGRAM t HOLD\nVAR p : ARRAY[0] OF POSITION\nBEGIN\nEND t", "0", "1..65535"),
    ("PROGRAM t HOLD\nVAR p : ARRAY[2, 3] OF POSITION\nBEGIN\nEND t", ",", "does not belong here"),
    ("PROGRAM t HOLD\nVAR i : INTEGER\n p : ARRAY[i] OF POSITION\nBEGIN\nEND t", "i", "not a constant"),
    ("PROGRAM t HOLD\nVAR i : INTEGER (2.5)\nBEGIN\nEND t", "2.5", "is REAL"),
    ("PROGRAM t HOLD\nVAR i : INTEGER j : REAL\nBEGIN\nEND t", "j", "a line of its own"),
    ("PROGRAM t HOLD\nCONST c = c\nBEGIN\nEND t", "c", "not a constant"),
    ("PROGRAM t HOLD\nCONST c = 1\nBEGIN\nc := 2\nEND t", "c", "is a constant"),
    (f"PROGRAM t HOLD\nVAR {'n' * 33} : REAL\nBEGIN\nEND t", "n" * 33, "longer than 32"),
    ("BEGIN\nEND t", "BEGIN", "'PROGRAM'"),
]


@pytest.mark.parametrize(("text", "word", "reason"), HEADERS, ids=[h[1][:20] + " " + h[2][:20] for h in HEADERS])
def test_refuses_invalid_declarations_with_line_and_column(text, word, reason):
    with pytest.raises(Pdl2Error) as caught:
        parse_program(text)
    error = caught.value
    assert error.word == word
    assert text.split("\n")[error.line - 1][error.column - 1 :].startswith(word)
    assert reason in str(error)


@pytest.mark.parametrize("text", ["", "\n\n", "-- nothing", "PROGRAM", "PROGRAM t HOLD\nBEGIN\nMOVE TO"])
def test_refuses_a_truncated_program(text):
    with pytest.raises(Pdl2Error, match="ends too early"):
        parse_program(text)


def test_errors_beyond_the_trial_are_raised_where_the_program_reaches_them():
    text = (
        "PROGRAM t HOLD\nVAR i : INTEGER\nBEGIN\nFOR i := 1 TO 20000 DO\nMOVE TO {0} WITH $FLY_PER = 1 + i DIV 200\n"
        "ENDFOR\nEND t"
    )
    run = parse_program(text, "late.pdl").run()
    assert len(list(itertools.islice(run, 19999))) == 19999
    with pytest.raises(Pdl2Error, match=r"late\.pdl:5:18: '\$FLY_PER'"):
        next(run)
