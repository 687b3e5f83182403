"""Runs with further motions: every way gets the same robot time, and a check that was stopped goes on."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from agent.blind_check import WAYS
from agent.core import Console, InputError
from agent.pipeline import active_check as module
from agent.pipeline.active_check import ActiveCheck
from drivers.errors import DriverError

QUIET = Console(verbosity=-1)


@pytest.fixture
def check(tmp_path: Path, monkeypatch):
    """Of three runs, whose first recordings are ambiguous, and that are settled by any second further motion."""
    made = SimpleNamespace(recorded=[], asked=[], fails=False)

    def record(self, case, effects, recipe, texts, keep, folder):
        assert not (self.folder / "key.json").exists(), "the key is closed while anything is recorded"
        if made.fails and case.number == 1:
            raise DriverError("nobody there")
        made.recorded.append((case.number, folder.name, tuple(texts), tuple(keep)))
        return [folder / f"{name}.mcap" for name in keep]

    def diagnose(self, recipe, logs, model):
        verdict = "ambiguous" if len(logs) < 5 else "explained"
        cause = {"effect": "stribeck", "joints": ["joint_2"], "equivalent_to": []}
        return SimpleNamespace(result={"verdict": verdict, "causes": [cause], "closure": 0.9})

    def motion(way, found, recipe, plan, seconds, name, seed):
        made.asked.append((way, name, seconds))
        return f"PROGRAM {name}", 17.0 if way == "planned" else seconds, []

    monkeypatch.setattr(ActiveCheck, "_record", record)
    monkeypatch.setattr(ActiveCheck, "_diagnose", diagnose)
    monkeypatch.setattr(ActiveCheck, "_model", lambda self, case: tmp_path / "model.json")
    monkeypatch.setattr(module, "make_plan", lambda *_: None)
    monkeypatch.setattr(module, "_first", lambda *_: dict.fromkeys(("excite", "valid01", "valid02"), "PROGRAM"))
    monkeypatch.setattr(module, "_motion", motion)
    made.whole = ActiveCheck(3, 5, tmp_path / "check")
    return made


def test_every_way_gets_the_time_of_the_planned_motions_and_begins_with_the_same_recording(check):
    scores = check.whole.run(QUIET)
    first = [(way, name, seconds) for way, name, seconds in check.asked[: 2 * len(WAYS)]]
    assert first[:2] == [("planned", "further1", 60.0), ("planned", "further2", 60.0)]
    assert first[2:] == [(way, name, 17.0) for way in WAYS[1:] for name in ("further1", "further2")]
    of_one = [entry for entry in check.recorded if entry[0] == 0]
    begin = ("excite", "valid01", "valid02")
    assert of_one[0] == (0, "0000", begin, begin)
    assert of_one[2] == (0, "planned", (*begin, "further1", "further2"), ("further2",)), "as warm as it would be"
    assert scores["first"] == {"ambiguous": 3}
    assert scores["ways"]["random"]["robot_s"] == 3 * 2 * 17.0


def test_a_check_goes_on_where_it_was_and_says_what_could_not_be_recorded(check):
    check.fails = True
    scores = check.whole.run(QUIET)
    assert scores["not_recorded"] == [{"run": 1, "why": "nobody there"}]
    assert scores == json.loads((check.whole.folder / "active_check.json").read_text())
    assert len(json.loads((check.whole.folder / "key.json").read_text())["cases"]) == 3
    before = len(check.recorded)
    assert check.whole.run(QUIET) == scores
    assert len(check.recorded) == before


def test_another_check_in_the_folder_is_refused(check):
    check.whole.run(QUIET)
    with pytest.raises(InputError, match="another seed"):
        ActiveCheck(3, 6, check.whole.folder).run(QUIET)
    with pytest.raises(InputError, match="at least one run"):
        ActiveCheck(0, 6, check.whole.folder).run(QUIET)


def test_other_worlds_are_refused(tmp_path):
    out = tmp_path / "x"
    command = [sys.executable, "-m", "agent", "blind-check", "--active", "--world", "mujoco", "-o", str(out)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 2
    assert "leave out the other options" in run.stderr
    assert not out.exists()
