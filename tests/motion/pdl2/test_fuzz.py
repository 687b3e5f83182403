"""No text makes the reader hang or raise anything but its own error."""

import itertools

import pytest
from hypothesis import given, settings, strategies as st

from agent.motion.pdl2 import Pdl2Error, parse_program
from agent.motion.program import Delay, Move

PROGRAM = """PROGRAM loop HOLD, PROG_ARM=1
CONST height = 800.5
TYPE points = ARRAY[4] OF POSITION
VAR
  p : points
  home : JOINTPOS NOSAVE
  i, k : INTEGER (3)
  x : REAL
BEGIN CYCLE
  -- where to go
  home := {0, 0, -90, 0, 90, 0}
  FOR i := 1 TO 4 DO
    p[i] := POS(1000 + 10 * i, -200, height / 2, 0, 180, 0, 'S W T1:0')
  ENDFOR
  $LIN_SPD := 0.5 ; $TOOL := POS(0, 0, 120, 0, 0, 0, '')
  MOVE JOINT TO home, WITH $PROG_SPD_OVR = 10, ENDMOVE
  FOR i := 4 DOWNTO 2 STEP 1 DO
    MOVEFLY LINEAR TO p[i] ADVANCE,
      WITH $FLY_TYPE = FLY_CART, $FLY_DIST = 20,
           $TERM_TYPE = COARSE, $TOL_COARSE = 1,
    ENDMOVE
    MOVE CIRCULAR TO p[1] VIA p[2]
  ENDFOR
  x := (k DIV 2) * 1.5E-1 - -i MOD 2
  DELAY 100
END loop
"""
ODD_WORDS = """' '' & ; -- := = <> { } [ ] 0 1e9 99999999999 $ ENDIF $FLY_PER -1 1.5. ** TRUE WAIT é ﬀ"""
WORDS = [*PROGRAM.replace("(", " ( ").replace(",", " , ").split(), *ODD_WORDS.split(), "\n", "\r", "\x00"]


def outcome(text: str) -> None:
    error = None
    try:
        statements = list(itertools.islice(parse_program(text).run(limit=500), 500))
        assert all(isinstance(statement, Move | Delay) for statement in statements)
    except Pdl2Error as raised:
        error = raised
    if error is not None:
        assert min(error.line, error.column) >= 1
        assert len(str(error)) < 1000


@given(st.text(max_size=200))
def test_any_text_parses_or_gives_an_error(text):
    outcome(text)


@given(st.lists(st.sampled_from(WORDS), max_size=60))
def test_any_words_parse_or_give_an_error(words):
    outcome(" ".join(words))


EDITS = st.lists(
    st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 12), st.sampled_from(WORDS) | st.text(max_size=5)),
    min_size=1,
    max_size=4,
)


def edited(edits) -> str:
    text = PROGRAM
    for place, removed, inserted in edits:
        k = int(place * len(text))
        text = text[:k] + inserted + text[k + removed :]
    return text


@given(EDITS)
@settings(max_examples=400)
def test_edited_programs_parse_or_give_an_error(edits):
    outcome(edited(edits))


@given(st.permutations(PROGRAM.split("\n")))
def test_shuffled_lines_parse_or_give_an_error(lines):
    outcome("\n".join(lines))


@pytest.mark.verify
@given(EDITS)
@settings(max_examples=20_000, deadline=None)
def test_many_edited_programs_parse_or_give_an_error(edits):
    outcome(edited(edits))


LONG = {
    "parentheses": "x := " + "(" * 50_000,
    "closed parentheses": "x := " + "(" * 50_000 + "1" + ")" * 50_000,
    "signs": "x := " + "- " * 50_000 + "1",
    "sums": "x := 1" + " + 1" * 50_000,
    "subscripts": "x := " + "p[" * 50_000 + "1" + "]" * 50_000,
    "blocks": "FOR i := 1 TO 1 DO\n" * 20_000 + "ENDFOR\n" * 20_000,
    "settings": "MOVE TO home WITH " + ", ".join(["$LIN_SPD = 1"] * 20_000),
    "joints": "home := {" + ", ".join(["1"] * 50_000) + "}",
    "digits": "x := " + "9" * 900_000,
    "real digits": "x := 0." + "9" * 900_000,
    "a name": "n" * 900_000,
    "a string": "x := '" + "a" * 900_000 + "'",
    "a comment": "-- " + "a" * 900_000,
    "quotes": "x := " + "'" * 900_000,
    "statements": "x := 1\n" * 10_000,
    "semicolons": ";" * 100_000,
    "a loop": "FOR i := -2147483647 TO 2147483647 DO\nENDFOR",
    "loops in loops": "FOR i := 1 TO 2000000000 DO\n" * 30 + "ENDFOR\n" * 30,
    "too long": " " * 1_000_001,
}


@pytest.mark.parametrize("what", LONG)
def test_large_programs_parse(what):
    outcome(PROGRAM.replace("  -- where to go", LONG[what]))
