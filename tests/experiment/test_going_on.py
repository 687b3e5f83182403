"""What a run that was stopped says to continue with: the command that started it."""

import shlex
from dataclasses import fields, replace
from pathlib import Path

import pytest
import typer

from agent.cli.app import app
from agent.core import ControllerError, InputError, MismatchError
from agent.pipeline import GapQuestion
from agent.pipeline.ending import resume_advice
from agent.pipeline.gap.diagnosis_question import options_of
from agent.pipeline.gap.next_steps import after_diagnosis
from agent.runs.folder import RunFolder

STOPPED = KeyboardInterrupt()
ASKED = GapQuestion(
    model=Path("it's a model.xml"), joint_map=Path("map.yaml"), cutoff=12.5, without=("stribeck", "two words"),
    report=Path("page.html"), out=Path("out"), allow_mixed=True, force=True, next_recipe=Path("next.yaml"),
    next_payload="2 kg, 0 mm, 0 mm, -30 mm", drives_off=Path("zero.mcap"), topic="/arm/joint_states",
    planning_budget=90.0, effort="current", known=("kp",),
)  # fmt: skip
#: Parameters of the command that the question does not have, and what the test's command line says of them.
BESIDE = {"as_json": False, "yes": False, "messages": None, "robot": None}


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    recipe = tmp_path / "my job.yaml"
    recipe.write_text("robot: comau_ns16\n", encoding="utf-8")
    return RunFolder.create(tmp_path / "logs", "comau_ns16", recipe)


def read(command: str) -> dict[str, object]:
    """What `agent diagnose` understands of a command line."""
    words = shlex.split(command)
    assert words[:2] == ["agent", "diagnose"]
    diagnose = typer.main.get_command(app).commands["diagnose"]
    asked = diagnose.make_context("diagnose", words[2:]).params
    return {key: value for key, value in asked.items() if key != "help_all"}


def test_every_option_of_the_question_is_covered():
    assert all(getattr(ASKED, field.name) != field.default for field in fields(ASKED))


def test_the_command_to_repeat_a_diagnosis_is_the_original_one(run: RunFolder, tmp_path: Path):
    run.note(kind="diagnose", robot_source="my robot.yaml", options=[*ASKED.options(), *options_of(600.0)])
    assert "diagnose them with" not in resume_advice(run, "record", STOPPED)
    for name in ("excitation.mcap", "validation_01.mcap", "record"):
        run.finish(name)
    said = resume_advice(run, "rounds", STOPPED)
    found = read(said.partition("start again with: ")[2])
    recorded = {"logs": (), "record": found["record"], "runs": tmp_path / "logs", "until_sure": True}
    budgets = {"budget": "600 s", "load": ASKED.next_payload, "planning_budget": "90 s"}
    same = {key: value for key, value in vars(ASKED).items() if key not in ("next_payload", "planning_budget")}
    question = {**recorded, **budgets, **same}
    assert {**found, "without": tuple(found["without"]), "known": tuple(found["known"])} == {**BESIDE, **question}
    recorded = read(said.partition("diagnose them with: ")[2].partition("; or start again")[0])
    assert recorded["logs"] == [run.file("excitation.mcap"), run.file("validation_01.mcap")]
    assert (recorded["robot"], recorded["record"], recorded["until_sure"]) == ("my robot.yaml", None, False)
    assert {key: recorded[key] for key in ("model", "cutoff")} == {"model": ASKED.model, "cutoff": ASKED.cutoff}
    assert found["record"].resolve() == tmp_path / "my job.yaml"


def test_the_command_for_further_logs_keeps_options_and_overwrites_nothing():
    result = {"verdict": "ambiguous", "causes": [{"effect": "stribeck"}], "next_experiment": None}
    (step,) = after_diagnosis(result, "my robot.yaml", [Path("a b.mcap")], ASKED)
    found = read(step.command)
    same = replace(ASKED, report=None, out=None, next_recipe=None, next_payload=None)
    wanted = {**vars(same), "without": list(same.without), "known": list(same.known)}
    del wanted["next_payload"], wanted["planning_budget"]
    assert {key: found[key] for key in wanted} == wanted
    assert found["load"] is None
    assert (found["robot"], found["logs"]) == ("my robot.yaml", [Path("a b.mcap"), Path("new.mcap")])
    assert "new.mcap" in step.what, "what is recorded has the name that the command reads"


@pytest.mark.parametrize(("recorded", "new"), [("lerobot", "new/"), ("pace.pt", "new.pt"), ("a.mcap", "new.mcap")])
def test_the_next_log_is_of_the_kind_that_was_given(recorded: str, new: str, tmp_path: Path):
    (tmp_path / "lerobot").mkdir()
    result = {"verdict": "unknown", "causes": [], "next_experiment": None}
    (step,) = after_diagnosis(result, None, [tmp_path / recorded], replace(ASKED, next_recipe=None))
    assert f" as {new}, then" in step.what
    assert shlex.split(step.command)[-1] == new


@pytest.mark.parametrize("known", [None, Path("zero.mcap")])
def test_asks_for_a_drives_off_record_with_its_option(known):
    experiment = {"motion": "the same loop", "program": None, "drives_off": True}
    result = {"verdict": "ambiguous", "causes": [{"effect": "torque_offset"}], "next_experiment": experiment}
    (step,) = after_diagnosis(result, "my robot.yaml", [Path("a.mcap")], replace(ASKED, drives_off=known))
    found = read(step.command)
    assert found["drives_off"] == (known or Path("brakes.mcap"))
    assert found["logs"] == [Path("a.mcap"), *([Path("new.mcap")] if known else [])]


def test_after_a_planned_motion_the_next_commands_record_and_diagnose():
    planned = {
        "program": "my plan/program.pdl",
        "payload": "5 kg, 0 mm, 0 mm, 60 mm",
        "motion": "a loop",
        "drives_off": True,
    }
    result = {"verdict": "ambiguous", "causes": [{"effect": "stribeck"}], "next_experiment": planned}
    record, again = after_diagnosis(result, "my robot.yaml", [Path("a b.mcap")], ASKED)
    words = shlex.split(record.command)
    assert words[:3] == ["agent", "record", str(ASKED.next_recipe)]
    assert words[3:] == ["--program", "my plan/program.pdl", "--payload", planned["payload"]]
    assert record.what.startswith("mount 5 kg, 0 mm, 0 mm, 60 mm at the flange, then run")
    assert "--drives-off LOG" in again.what
    assert read(again.command)["logs"] == [Path("a b.mcap"), Path("my plan/program.mcap")]


def test_another_path_asks_to_learn_the_interpolator():
    result = {"verdict": "explained", "causes": [{"effect": "interpolator_mismatch"}], "next_experiment": None}
    (step,) = after_diagnosis(result, "my robot.yaml", [Path("a b.mcap")], ASKED)
    assert step.command == "agent learn-interpolator --robot 'my robot.yaml' -o law.yaml 'a b.mcap'"


@pytest.mark.parametrize("program", ["my plan/program.pdl", None])
def test_proposes_a_mass_with_the_command_that_plans_for_it(program):
    mass = {"payload": "5 kg, 0 mm, 0 mm, 0 mm", "text": "A known mass would tell more", "after": 0.9}
    planned = {"program": program, "motion": "a loop", "with_a_mass": mass}
    result = {"verdict": "ambiguous", "causes": [{"effect": "stribeck"}], "next_experiment": planned}
    *_, loaded = after_diagnosis(result, "my robot.yaml", [Path("a b.mcap")], ASKED, Path("next.yaml"))
    found = read(loaded.command)
    assert (found["next_recipe"], found["load"]) == (Path("next.yaml"), mass["payload"])
    assert found["out"] == Path("out_with_a_mass"), "the folder of the bare arm's motion is taken"
    assert found["logs"] == [Path("a b.mcap")]
    steps = after_diagnosis(result, "my robot.yaml", [Path("a.mcap")], ASKED)
    assert len(steps) == (2 if program else 1), "no recipe, no plan"


def test_the_command_to_repeat_a_recalibration_has_its_authorisation(run: RunFolder, tmp_path: Path):
    run.note(kind="recalibrate", options=["--authorisation", "a person's word.yaml"])
    words = shlex.split(resume_advice(run, "record", STOPPED).partition("start again with: ")[2])
    assert words[3:] == ["--logs", str(tmp_path / "logs"), "--authorisation", "a person's word.yaml"]


@pytest.mark.parametrize(
    ("error", "planned", "goes_on"),
    [
        (InputError("the sub-region is out of reach"), False, False),
        (MismatchError("another sampling rate"), False, False),
        (ControllerError("the drives are off"), False, True),
        (InputError("nobody confirmed that the cell is clear"), True, True),
        (STOPPED, False, True),
    ],
)
def test_proposes_no_resume_for_a_calibration_stopped_by_its_recipe(run, error, planned: bool, goes_on: bool):
    run.note(kind="calibrate")
    if planned:
        run.finish("plan")
    said = resume_advice(run, "plan", error)
    assert ("; continue with: agent calibrate " in said) is goes_on
    assert ("--resume" in said) is goes_on


@pytest.mark.parametrize(("model", "out"), [("m.json", "with.json"), ("arm.xml", "fixed.xml")])
def test_a_model_that_is_written_is_not_asked_for_again(model, out):
    result = {"verdict": "explained", "causes": [{"effect": "stribeck"}], "next_experiment": None}
    asked = replace(ASKED, next_recipe=None, next_payload=None, model=Path(model), out=None)
    (step,) = after_diagnosis(result, None, [Path("a.mcap")], asked)
    assert "-o" in shlex.split(step.command)
    (step,) = after_diagnosis(result, None, [Path("a.mcap")], replace(asked, out=Path(out)))
    assert shlex.split(step.command)[2:] == ["--model", out, "new.mcap"]


def test_where_logs_could_not_show_a_change_the_model_is_asked_what_it_lacks():
    blind = {"verdict": "no_gap", "causes": [], "next_experiment": None, "model_error": 0.4, "warnings": []}
    (step,) = after_diagnosis(blind, "my robot.yaml", [Path("a b.mcap")], GapQuestion())
    assert read(step.command)["next_recipe"] == Path("RECIPE"), "without a model, another motion has to show more"
    (step,) = after_diagnosis({**blind, "model_error": 0.1}, "my robot.yaml", [Path("a b.mcap")], GapQuestion())
    assert step.what == "nothing to do: keep the model."
