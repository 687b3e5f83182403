"""A motion that was planned with a known mass: a person says that it is mounted, or nothing runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agent.core import InputError
from agent.link.payload import known_of
from agent.model import PAYLOAD
from agent.recording import PARTS

LOAD = "5 kg, 0 mm, 0 mm, 60 mm"


def nobody(question: str) -> bool:
    return False


@pytest.fixture
def program(tmp_path: Path) -> Path:
    path = tmp_path / "program.pdl"
    (tmp_path / "experiment.json").write_text(json.dumps({"program": str(path), "payload": LOAD}), encoding="utf-8")
    return path


def test_it_is_asked_for_and_never_assumed(program: Path):
    asked: list[str] = []

    def person(question: str) -> bool:
        asked.append(question)
        return True

    assert known_of(program, None, person) == {PAYLOAD: LOAD}
    assert LOAD in asked[0]
    with pytest.raises(InputError, match="mount it, and say so with --payload '5 kg"):
        known_of(program, None, nobody)


def test_what_a_person_names_is_what_the_motion_was_planned_with(program: Path):
    assert known_of(program, "5000 g, 0, 0, 0.06 m", nobody) == {PAYLOAD: LOAD}
    with pytest.raises(InputError, match=r"not 4 kg"):
        known_of(program, "4 kg, 0, 0, 0.06 m", nobody)


def test_any_other_program_says_what_a_person_says(tmp_path: Path, program: Path):
    other = tmp_path / "other.pdl"
    assert known_of(other, None, nobody) == {}
    assert known_of(other, LOAD, nobody) == {PAYLOAD: LOAD}
    program.with_name("experiment.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="plan the motion again"):
        known_of(program, None, nobody)


def test_the_log_of_a_planned_motion_says_in_how_many_parts_it_is_held_out(program: Path):
    plan = {"program": str(program), PARTS: "2"}
    program.with_name("experiment.json").write_text(json.dumps(plan), encoding="utf-8")
    assert known_of(program, None, nobody) == {PARTS: "2"}
    assert known_of(program.with_name("other.pdl"), None, nobody) == {}
