"""Runs with further motions: every way gets the same robot time, and a check that was stopped continues."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from agent.core import Console, InputError
from agent.robot import load_robot
from benchmarks.active.__main__ import OPEN, check
from benchmarks.active.run import ActiveRun, WayMotion
from benchmarks.active.scoring import WAYS
from drivers.errors import DriverError
from fake_controller.actuation import EFFECTS
from fake_controller.withheld.cases import draw_cases

QUIET = Console(verbosity=-1)


class Made:
    """Three runs whose first recordings are ambiguous; any further motion settles them."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.ran, self.asked, self.read = [], [], []
        self.fails, self.refuses, self.first, self.effect = "", (), {}, "stribeck"
        self.brakes, self.masses, self.on_it = {}, {}, {}

    def whole(self):
        return check(3, 5, self.folder, QUIET)

    def record(self, run, effects, texts, keep, folder):
        number = run._case.number
        if self.fails == f"{number} {folder.name}":
            raise DriverError("nobody there")
        folder.mkdir(parents=True, exist_ok=True)
        self.ran.append((number, folder.name, tuple(texts), tuple(keep)))
        self.on_it[number, folder.name] = [one for one in effects if one not in run._case.effects]
        for name in keep:
            (folder / f"{name}.mcap").write_text("log")
        return [folder / f"{name}.mcap" for name in keep]

    def diagnose(self, run, logs, drives_off=False):
        assert all(log.exists() for log in logs), "no earlier motion's log is lost"
        self.read.append((len(logs), drives_off))
        number = run._case.number
        verdict = self.first.get(number, "ambiguous") if len(logs) == 1 else "explained"
        if drives_off:
            verdict = self.brakes[number, len(logs)]
        cause = {"effect": self.effect, "joints": ["joint_2"], "equivalent_to": []}
        return SimpleNamespace(result={"verdict": verdict, "causes": [cause], "closure": 0.9})

    def motion(self, run, way, found, seconds, load, ask_mass):
        number = run._case.number
        self.asked.append((number, way, seconds))
        mass = self.masses.get(number) if way == "planned" and load is None else None
        if number in self.refuses and load is None:
            return WayMotion("", 0.0, mass=mass)
        return WayMotion("PROGRAM further", 17.0 if way == "planned" else seconds, mass=mass if ask_mass else None)


@pytest.fixture
def made(tmp_path: Path, monkeypatch):
    made = Made(tmp_path / "check")
    for name in ("record", "diagnose", "motion"):
        method = getattr(made, name)
        monkeypatch.setattr(ActiveRun, f"_{name}", lambda self, *given, m=method, **named: m(self, *given, **named))
    monkeypatch.setattr(ActiveRun, "_texts", {"excite": "PROGRAM"})
    return made


def test_every_strategy_gets_the_same_motion_time_and_first_recording(made):
    scores = made.whole()
    assert [entry for entry in made.asked if entry[0] == 0] == [
        (0, "planned", 60.0),
        *((0, way, 17.0) for way in WAYS[1:]),
    ]
    of_one = [entry for entry in made.ran if entry[0] == 0]
    assert of_one[0] == (0, "0000", ("excite",), ("excite",))
    assert of_one[1] == (0, "planned", ("excite", "further"), ("further",)), "as warm as it would be"
    assert scores["first"] == {"ambiguous": 3}
    assert scores["ways"]["random_pieces"]["robot_s"] == 3 * 17.0
    assert not any(drives_off for _, drives_off in made.read), "no offset is open"
    assert not list(made.folder.glob("runs/*/*brakes*"))


def test_ambiguous_runs_are_continued_first(made):
    made.first = {0: "unknown", 1: "explained"}
    scores = made.whole()
    assert [entry[0] for entry in made.ran[:3]] == [0, 1, 2]
    assert [entry[0] for entry in made.asked] == [2] * len(WAYS) + [0] * len(WAYS)
    assert [case["number"] for case in scores["cases"]] == [0, 1, 2]


def test_plans_a_motion_for_what_the_drives_off_record_leaves_open(made):
    made.effect = "torque_offset"
    made.brakes = {(0, 1): "explained", (1, 1): "ambiguous", (1, 2): "explained", (2, 1): "ambiguous"}
    made.brakes[2, 2] = "unknown"
    made.whole()
    planned = sorted(number for number, way, _ in made.asked if way == "planned")
    assert planned == [0, 1, 1, 2, 2], "run 0 needs no other motion with them"
    runs = [json.loads((made.folder / f"runs/000{k}/planned_brakes.json").read_text())["result"] for k in range(3)]
    assert [run["verdict"] for run in runs] == ["explained", "explained", "unknown"]


def test_mounts_the_requested_mass_and_gives_every_strategy_that_motion_time(made):
    made.masses, made.refuses = {0: "5 kg, 0 mm, 0 mm, 60 mm", 1: "2 kg, 0 mm, 0 mm, 0 mm"}, (1,)
    scores = made.whole()
    ball = {"effect": "payload", "joints": [], "parameters": {"mass": 5.0, "centre": [0.0, 0.0, 0.06]}}
    assert made.on_it[0, "planned_mass"] == [ball]
    assert made.on_it[0, "planned"] == made.on_it[0, "random_pieces"] == []
    assert (2, "planned_mass") not in made.on_it
    assert (1, "random_pieces", 17.0) in made.asked, "the bare arm has no motion, one with the mass has"
    assert scores["no_motion"] == 1


def test_keeps_the_drives_off_verdict_if_no_motion_helps(made):
    made.effect, made.refuses, made.masses = "torque_offset", (0,), {0: "5 kg, 0 mm, 0 mm, 0 mm"}
    made.brakes = {(0, 1): "unknown", (1, 1): "explained", (2, 1): "explained"}
    made.whole()
    kept = json.loads((made.folder / "runs/0000/planned_brakes.json").read_text())
    assert kept["result"]["verdict"] == "unknown"


def test_records_nothing_if_no_motion_would_help(made):
    made.refuses = (1,)
    scores = made.whole()
    assert [entry for entry in made.asked if entry[0] == 1] == [(1, "planned", 60.0)]
    assert scores["no_motion"] == 1
    assert scores["ways"]["planned"]["right"]["of"] == 3, "it counts all the same"


@pytest.mark.parametrize(
    ("fails", "why"), [("1 0001", "nobody there"), ("1 random_pieces", "random_pieces: nobody there")]
)
def test_names_failed_recordings_and_does_not_repeat_a_finished_check(made, fails: str, why: str):
    made.fails = fails
    scores = made.whole()
    assert scores["not_recorded"] == [{"run": 1, "why": why}]
    assert scores == json.loads((made.folder / "active_check.json").read_text())
    assert scores["ways"]["d_optimal_pieces"]["robot_s"] == (2 if fails == "1 0001" else 3) * 17.0
    before = len(made.ran)
    assert made.whole() == scores
    assert len(made.ran) == before


def test_a_stopped_check_keeps_its_answers(made, monkeypatch):
    real = ActiveRun._motion
    monkeypatch.setattr(
        ActiveRun,
        "_motion",
        lambda self, way, *rest, **n: 1 / 0 if way == "random_pieces" else real(self, way, *rest, **n),
    )
    with pytest.raises(ZeroDivisionError):
        made.whole()
    assert len(made.ran) == 5, "the first motions of all, a planned one, and the loop again"
    monkeypatch.setattr(ActiveRun, "_motion", real)
    made.whole()
    assert len({entry[:2] for entry in made.ran}) == len(made.ran), "nothing is recorded twice"


def test_refuses_a_folder_of_another_check(made):
    made.whole()
    with pytest.raises(InputError, match="another seed"):
        check(3, 6, made.folder, QUIET)
    with pytest.raises(InputError, match="at least one run"):
        check(0, 6, made.folder, QUIET)
    (made.folder / "file").write_text("", encoding="utf-8")
    for below in ("file", "file/deep"):
        with pytest.raises(InputError, match="is a file, or lies below one"):
            check(1, 6, made.folder / below, QUIET)


def test_draws_weak_effects_of_every_repeatable_kind():
    cases = draw_cases(60, 3, load_robot("comau_ns16"), OPEN)
    assert {case.kind for case in cases} == {"one", "none"}
    assert all(0.15 <= case.strength <= 0.8 for case in cases)
    names = {effect["effect"] for case in cases for effect in case.effects}
    assert names == set(OPEN.names)
    assert set(EFFECTS) - names == {"contact", "interpolator_mismatch"}, "neither is met again in torque"
