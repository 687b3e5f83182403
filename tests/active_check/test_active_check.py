"""Runs with further motions: every way gets the same robot time, and a check that was stopped goes on."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from agent.core import Console, InputError
from agent.model import CATALOGUE
from agent.robot import load_robot
from benchmarks.active.check import ActiveCheck
from benchmarks.active.machines import OPEN, ControllerMachines
from benchmarks.active.run import ActiveRun, WayMotion
from benchmarks.active.scoring import WAYS
from drivers.errors import DriverError
from fake_controller.withheld.cases import draw_cases

QUIET = Console(verbosity=-1)
BEGIN = ("excite",)


@pytest.fixture
def check(tmp_path: Path, monkeypatch):
    """Of three runs, whose first recordings are ambiguous, and that are settled by any second further motion."""
    made = SimpleNamespace(
        ran=[],
        asked=[],
        read=[],
        fails="",
        refuses=(),
        first={},
        later=None,
        folder=tmp_path / "check",
        brakes={},
        masses={},
        on_it={},
        effect="stribeck",
    )

    def record(self, job):
        assert not (made.folder / "key.json").exists(), "the key is closed while anything is recorded"
        if made.fails == f"{job.case.number} {job.folder.name}":
            raise DriverError("nobody there")
        made.ran.append((job.case.number, job.folder.name, tuple(job.texts), tuple(job.keep)))
        made.on_it[made.ran[-1][:2]] = [one for one in job.effects if one not in job.case.effects]
        for name in job.keep:
            (job.folder / f"{name}.mcap").write_text("log")

    def diagnose(self, logs, brakes=False):
        assert all(log.exists() for log in logs), "no earlier motion's log is lost"
        made.read.append((len(logs), brakes))
        number = int(logs[0].parent.name)
        open_now = made.brakes.get((number, len(logs))) if brakes else made.first.get(number, "ambiguous")
        verdict = (open_now if brakes or len(logs) < 3 else "explained") if made.later is None else made.later
        cause = {"effect": made.effect, "joints": ["joint_2"], "equivalent_to": []}
        return SimpleNamespace(
            result={"verdict": verdict, "causes": [cause], "closure": 0.9},
            dataset=SimpleNamespace(robot=load_robot("comau_ns16"), logs=logs),
            finding=SimpleNamespace(evidence=None),
        )

    def motion(self, way, found, seconds, name, seed, load=None, mass=False):
        made.asked.append((self._case.number, way, name, seconds))
        asked = made.masses.get(self._case.number) if way == "planned" and load is None else None
        if self._case.number in made.refuses and load is None:
            return WayMotion("", 0.0, mass=asked)
        return WayMotion(f"PROGRAM {name}", 17.0 if way == "planned" else seconds, mass=asked if mass else None)

    monkeypatch.setattr(ControllerMachines, "run", record)
    monkeypatch.setattr(ActiveRun, "_diagnose", diagnose)
    monkeypatch.setattr(ActiveRun, "_motion", motion)
    monkeypatch.setattr(ActiveRun, "_recipe", None)
    monkeypatch.setattr(ActiveRun, "_texts", dict.fromkeys(BEGIN, "PROGRAM"))
    made.whole = ActiveCheck(3, 5, made.folder)
    return made


def test_every_way_gets_the_time_of_the_planned_motions_and_begins_with_the_same_recording(check):
    scores = check.whole.run(QUIET)
    asked = {entry[1:] for entry in check.asked if entry[0] == 0}
    assert {entry for entry in asked if entry[0] == "planned"} == {("planned", f"further{k}", 60.0) for k in (1, 2)}
    assert asked - {entry for entry in asked if entry[0] == "planned"} == {
        (way, name, 17.0) for way in WAYS[1:] for name in ("further1", "further2")
    }
    of_one = [entry for entry in check.ran if entry[0] == 0]
    assert of_one[0] == (0, "0000", BEGIN, BEGIN)
    assert (0, "planned2", (*BEGIN, "further1", "further2"), ("further2",)) in of_one, "as warm as it would be"
    assert scores["first"] == {"ambiguous": 3}
    assert scores["ways"]["random_pieces"]["robot_s"] == 3 * 2 * 17.0


def test_the_first_further_motions_of_all_runs_come_before_any_second(check):
    check.whole.run(QUIET)
    order = [name for _, _, name, _ in check.asked]
    assert order == ["further1"] * 3 * len(WAYS) + ["further2"] * 3 * len(WAYS)


def test_what_is_ambiguous_comes_before_what_is_unknown_once_all_runs_have_their_first_motions(check):
    check.first = {0: "unknown", 1: "explained"}
    scores = check.whole.run(QUIET)
    ways = len(WAYS)
    assert [entry[0] for entry in check.ran[:3]] == [0, 1, 2]
    assert [entry[0] for entry in check.asked] == [2] * ways + [0] * ways + [2] * ways + [0] * ways
    assert [case["number"] for case in scores["cases"]] == [0, 1, 2]


def test_where_nothing_is_found_one_motion_of_every_way_says_what_would_have_been(check, monkeypatch):
    check.first, check.later = dict.fromkeys(range(3), "no_gap"), "no_gap"
    sizes = {2: {("backlash", (1,)): float("inf")}, 3: {("backlash", (1,)): 0.5}}
    monkeypatch.setattr("agent.diagnosis.smallest_sizes", lambda dataset, evidence: sizes[len(dataset.logs) + 1])
    scores = check.whole.run(QUIET)
    assert [name for _, _, name, _ in check.asked] == ["further1"] * 3 * len(WAYS)
    found = scores["smallest_sizes"]["d_optimal_pieces"]
    assert (found["weak"], found["had_none"], found["have_one"], found["halved"]) == (3, 3, 3, 3)


def test_seconds_on_the_brakes_come_first_where_an_offset_is_open_and_the_motion_is_planned_for_what_they_leave(check):
    check.effect = "torque_offset"
    check.brakes = {
        (0, 1): "explained",
        (1, 1): "ambiguous",
        (1, 2): "explained",
        (2, 1): "ambiguous",
        (2, 2): "unknown",
    }
    check.whole.run(QUIET)
    planned = [number for number, way, name, _ in check.asked if (way, name) == ("planned", "further1")]
    assert sorted(planned) == [0, 1, 1, 2, 2], "run 0 needs no other motion with them"
    assert [entry[1] for entry in check.ran if entry[0] == 1 and entry[1].endswith("_brakes")] == ["planned_brakes"]
    runs = check.folder / "runs"
    said = {
        (number, way): json.loads((runs / f"{number:04d}" / f"{way}_brakes.json").read_text())["result"]["verdict"]
        for number in range(3)
        for way in WAYS
    }
    assert {said[0, way] for way in WAYS} == {said[1, way] for way in WAYS} == {"explained"}
    assert {said[2, way] for way in WAYS} == {"unknown"}


def test_nothing_stands_on_its_brakes_where_no_offset_is_open(check):
    check.whole.run(QUIET)
    assert not any(brakes for _, brakes in check.read)
    assert not list(check.folder.glob("runs/*/*brakes*"))


def test_a_mass_that_is_asked_for_is_mounted_and_all_ways_get_the_time_of_its_motion(check):
    check.masses, check.refuses = {0: "5 kg, 0 mm, 0 mm, 60 mm", 1: "2 kg, 0 mm, 0 mm, 0 mm"}, (1,)
    scores = check.whole.run(QUIET)
    ball = {"effect": "payload", "joints": [], "parameters": {"mass": 5.0, "centre": [0.0, 0.0, 0.06]}}
    assert check.on_it[0, "planned_mass"] == [ball]
    assert check.on_it[0, "planned1"] == check.on_it[0, "random_loops1"] == []
    assert (2, "planned_mass") not in check.on_it
    assert (1, "planned", "further1", 60.0) in check.asked
    assert (1, "random_loops", "further1", 17.0) in check.asked, "the bare arm has no motion, one with the mass has"
    assert scores["no_motion"] == 1


def test_where_no_motion_tells_beside_the_brakes_what_they_say_stands_though_a_mass_is_asked_for(check):
    check.effect, check.refuses = "torque_offset", (0,)
    check.masses, check.brakes = (
        {0: "5 kg, 0 mm, 0 mm, 0 mm"},
        {(0, 1): "unknown", (1, 1): "explained", (2, 1): "explained"},
    )
    check.whole.run(QUIET)
    kept = json.loads((check.folder / "runs" / "0000" / "planned_brakes.json").read_text())
    assert kept["result"]["verdict"] == "unknown"


def test_no_time_is_spent_where_no_motion_would_tell(check):
    check.refuses = (1,)
    scores = check.whole.run(QUIET)
    assert [entry for entry in check.asked if entry[0] == 1] == [(1, "planned", "further1", 60.0)]
    assert scores["no_motion"] == 1
    assert scores["ways"]["planned"]["right_after_one"]["of"] == 3, "it counts all the same"


def test_a_check_goes_on_where_it_was_and_says_what_could_not_be_recorded(check):
    check.fails = "1 0001"
    scores = check.whole.run(QUIET)
    assert scores["not_recorded"] == [{"run": 1, "why": "nobody there"}]
    assert scores == json.loads((check.folder / "active_check.json").read_text())
    assert len(json.loads((check.folder / "key.json").read_text())["cases"]) == 3
    before = len(check.ran)
    assert check.whole.run(QUIET) == scores
    assert len(check.ran) == before


def test_a_check_that_is_stopped_keeps_every_answer_until_then(check, monkeypatch):
    real = ActiveRun._motion
    monkeypatch.setattr(
        ActiveRun, "_motion", lambda self, way, *rest: 1 / 0 if way == "random_loops" else real(self, way, *rest)
    )
    with pytest.raises(ZeroDivisionError):
        check.whole.run(QUIET)
    ran = len(check.ran)
    assert ran == 5, "the first motions of all, a planned one, and the loop again"
    monkeypatch.setattr(ActiveRun, "_motion", real)
    check.whole.run(QUIET)
    assert len({entry[:2] for entry in check.ran}) == len(check.ran), "nothing is recorded twice"


def test_a_way_that_could_not_be_recorded_is_named_and_costs_no_other(check):
    check.fails = "0 random_pieces1"
    scores = check.whole.run(QUIET)
    assert scores["not_recorded"] == [{"run": 0, "why": "random_pieces: nobody there"}]
    assert scores["ways"]["d_optimal_pieces"]["robot_s"] == 3 * 2 * 17.0


def test_another_check_in_the_folder_is_refused(check):
    check.whole.run(QUIET)
    with pytest.raises(InputError, match="another seed"):
        ActiveCheck(3, 6, check.folder).run(QUIET)
    with pytest.raises(InputError, match="at least one run"):
        ActiveCheck(0, 6, check.folder).run(QUIET)
    (check.folder / "file").write_text("", encoding="utf-8")
    for below in ("file", "file/deep"):
        with pytest.raises(InputError, match="is a file, or lies below one"):
            ActiveCheck(1, 6, check.folder / below).run(QUIET)
    with pytest.raises(InputError, match="no such world"):
        ActiveCheck(3, 6, check.folder, "moon").run(QUIET)


def test_weak_effects_of_every_kind_that_comes_again_are_drawn():
    cases = draw_cases(60, 3, load_robot("comau_ns16"), OPEN)
    assert {case.kind for case in cases} == {"one", "none"}
    assert all(0.15 <= case.strength <= 0.8 for case in cases)
    names = {effect["effect"] for case in cases for effect in case.effects}
    assert names == set(OPEN.names or ())
    assert set(CATALOGUE) - names == {"contact", "interpolator_mismatch"}, "neither is met again in torque"
