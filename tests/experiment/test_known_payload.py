"""A motion that was planned with a known mass: a person says that it is mounted, or nothing runs."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core import LARGEST_JSON, InputError, sha256_text
from agent.link.mounted_mass import PROGRAM_SHA256, SCHEMA, check_payload, known_of, with_payload
from agent.model import PAYLOAD, payload_of
from agent.motion import Delay
from agent.motion.pdl2 import parse_program, write_program
from agent.recording import PARTS
from agent.robot import Tool, load_robot

LOAD = "5 kg, 0 mm, 0 mm, 60 mm"
TEXT = "PROGRAM experiment HOLD\nBEGIN\nEND experiment\n"


def nobody(question: str) -> bool:
    return False


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "program.pdl"
    plan = {"schema": SCHEMA, "program": str(path), PROGRAM_SHA256: sha256_text(TEXT), PARTS: "2", "payload": LOAD}
    (tmp_path / "experiment.json").write_text(json.dumps(plan), encoding="utf-8")
    return path


def test_asks_whether_the_mass_is_mounted(program: Path):
    asked: list[str] = []

    def person(question: str) -> bool:
        asked.append(question)
        return True

    assert known_of(program, TEXT, None, person) == {PAYLOAD: LOAD, PARTS: "2"}
    assert LOAD in asked[0]
    with pytest.raises(InputError, match="mount it, and say so with --payload '5 kg"):
        known_of(program, TEXT, None, nobody)


def test_the_stated_payload_must_match_the_planned_one(program: Path):
    assert known_of(program, TEXT, "5000 g, 0, 0, 0.06 m", nobody) == {PAYLOAD: LOAD, PARTS: "2"}
    with pytest.raises(InputError, match=r"not 4 kg"):
        known_of(program, TEXT, "4 kg, 0, 0, 0.06 m", nobody)


def test_other_programs_use_the_stated_payload(tmp_path: Path, program: Path):
    other = tmp_path / "other.pdl"
    assert known_of(other, TEXT, None, nobody) == {}
    assert known_of(other, TEXT, LOAD, nobody) == {PAYLOAD: LOAD}


@pytest.mark.parametrize(
    "change",
    [
        None,
        {PROGRAM_SHA256: None},
        {PROGRAM_SHA256: 7},
        {PARTS: "two"},
        {PARTS: None},
        {PARTS: ["2"]},
        {"payload": "5 apples"},
        {"payload": 5},
        {"program": 5},
        {"program": None},
        {"schema": "experiment/9"},
        {"schema": None},
    ],
)
def test_refuses_a_damaged_plan_with_a_message(program: Path, change):
    """`change`: keys of the plan, None to take one out; None for all of it."""
    path = program.with_name("experiment.json")
    if change is None:
        path.write_text("[" * 100_000, encoding="utf-8")
    else:
        plan = json.loads(path.read_text(encoding="utf-8")) | change
        path.write_text(json.dumps({k: v for k, v in plan.items() if v is not None}), encoding="utf-8")
    with pytest.raises(InputError, match=r"experiment\.json: (is )?damaged.* plan the motion again, or move"):
        known_of(program, TEXT, LOAD, nobody)


def test_refuses_a_plan_that_is_far_too_long(program: Path):
    os.truncate(program.with_name("experiment.json"), LARGEST_JSON + 1)
    with pytest.raises(InputError, match=r"longer than 64 MiB.* plan the motion again, or move"):
        known_of(program, TEXT, LOAD, nobody)


def test_the_log_of_a_planned_motion_records_its_number_of_folds(program: Path):
    plan = {"schema": SCHEMA, "program": str(program), PROGRAM_SHA256: sha256_text(TEXT), PARTS: "2"}
    program.with_name("experiment.json").write_text(json.dumps(plan), encoding="utf-8")
    assert known_of(program, TEXT, None, nobody) == {PARTS: "2"}
    assert known_of(program.with_name("other.pdl"), TEXT, None, nobody) == {}


@pytest.mark.parametrize("beside", [None, {}, {"payload": "1 kg, 0 mm, 0 mm, 0 mm"}])
def test_the_program_text_records_its_payload(tmp_path: Path, beside):
    """Copied elsewhere, or next to a file that somebody has changed."""
    robot, program = load_robot("comau_ns16"), tmp_path / "program.pdl"
    text = with_payload(write_program("experiment", [Delay(1.0)], robot), payload_of(LOAD), "--")
    parts = {}
    if beside is not None:
        parts = {PARTS: "2"}
        plan = {"schema": SCHEMA, "program": "program.pdl", PROGRAM_SHA256: sha256_text(text), **parts, **beside}
        program.with_name("experiment.json").write_text(json.dumps(plan), encoding="utf-8")
    assert len(list(parse_program(text, "program.pdl", robot).run())) == 1
    with pytest.raises(InputError, match="mount it, and say so with --payload '5 kg"):
        known_of(program, text, None, nobody)
    assert known_of(program, text, LOAD, nobody) == {PAYLOAD: LOAD, **parts}


def test_refuses_a_program_changed_after_planning(tmp_path: Path):
    program = tmp_path / "program.pdl"
    plan = {"schema": SCHEMA, "program": "program.pdl", PROGRAM_SHA256: sha256_text(TEXT), PARTS: "2"}
    program.with_name("experiment.json").write_text(json.dumps(plan), encoding="utf-8")
    assert known_of(program, TEXT, None, nobody) == {PARTS: "2"}
    with pytest.raises(InputError, match="was changed since it was planned"):
        known_of(program, TEXT.replace("BEGIN", "BEGIN\n  DELAY 1"), None, nobody)


def test_refuses_tool_and_payload_above_the_rated_payload():
    robot, tool = load_robot("comau_ns16"), Tool(np.eye(4), 10.0, np.zeros(3))
    check_payload(robot, None, payload_of("16 kg, 0, 0, 0"))
    check_payload(robot, tool, payload_of("6 kg, 0, 0, 0"))
    with pytest.raises(InputError, match=r"100 kg at the flange are more than the 16 kg that comau_ns16 is rated for"):
        check_payload(robot, None, payload_of("100 kg, 0, 0, 0"))
    with pytest.raises(InputError, match="7 kg and 10 kg of tool"):
        check_payload(robot, tool, payload_of("7 kg, 0, 0, 0"))
    check_payload(replace(robot, rated_payload=None), tool, payload_of("100 kg, 0, 0, 0"))
