"""Motions that go on until a diagnosis is sure: what is kept of them, whatever ends them, and what the page says."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from agent.core import AgentError, InputError, RejectedError, sha256_text, write_atomically
from agent.core.console import Console
from agent.experiment.next_motion import NextMotion, NoMotion, advice_without_motion
from agent.model import CATALOGUE
from agent.motion import Delay
from agent.motion.pdl2 import write_program
from agent.motion.pdl2.dialect import Pdl2
from agent.pages import in_short
from agent.pages.diagnosis.summary import planned_section, rounds_section
from agent.pages.elements import Page, render
from agent.pages.phrasing import next_text
from agent.pipeline.gap import until_sure as module
from agent.pipeline.gap.diagnosis_run import DiagnosisRun
from agent.pipeline.gap.next_experiment import check_next
from agent.pipeline.gap.until_sure import until_sure
from agent.pipeline.job import Job
from agent.recipe import load_recipe, template
from agent.recording import PARTS, PLANNED_PARTS
from agent.robot import load_robot
from agent.runs.folder import RunFolder
from agent.safety import PlannedProgram
from agent.safety.authorisation import Authorisation, AuthorisationDocument
from agent.safety.first_run import FIRST_SPEED
from drivers.errors import DriverError

PROBLEM = "cd" * 32
PAIR = {
    "pair": ["stribeck on joint_2", "presliding on joint_2"],
    "before": 0.51,
    "after": 0.93,
    "after_if": [0.93, 0.93],
}
NONE = NoMotion("no motion would tell them apart. What may: another load", ("presliding", "stribeck"))
CAUSE = {"effect": "stribeck", "joints": ["joint_2"], "probability": 0.9}


@dataclass(frozen=True)
class Motion:
    """A planned motion of 20 s, before which somebody is asked for seconds on the brakes."""

    brakes: bool = True
    text: str = "PROGRAM experiment\n"

    def to_dict(self, program: str) -> dict:
        said = "seconds on the brakes; then reversals of joint_2" if self.brakes else "reversals of joint_2"
        return {"separates": ["presliding", "stribeck"], "motion": said, "program": program} | {
            "duration_s": 20.0,
            "probability": [PAIR],
        }


@pytest.fixture
def ask(tmp_path: Path, monkeypatch):
    """`ask(verdicts, ends, budget)`: rounds whose diagnoses say these verdicts, whose recordings end as said."""

    def run(verdicts, ends, budget=100.0, allowed=None, motions=(), given=True):
        recipe = tmp_path / "job.yaml"
        recipe.write_text("robot: comau_ns16\n", encoding="utf-8")
        folder = RunFolder.create(tmp_path / "logs", "comau_ns16", recipe)
        ends = iter(ends)

        def record(*_):
            end = next(ends)
            if isinstance(end, BaseException):
                raise end
            return SimpleNamespace(path=tmp_path / f"{end}.mcap", duration=20.0)

        answers = iter(verdicts)
        seen = []

        def find(logs):
            seen.append(len(logs))
            verdict = next(answers)
            if isinstance(verdict, BaseException):
                raise verdict
            causes = [CAUSE] if verdict in ("explained", "ambiguous") else []
            dataset = SimpleNamespace(has_reference=given)
            return DiagnosisRun(SimpleNamespace(result={"verdict": verdict, "causes": causes}, dataset=dataset))  # type: ignore[arg-type]

        plans = iter(motions or [Motion(), Motion(), NONE])
        made.clear()

        def plan(found, recipe, console, seconds, name, **_):
            made.append((recipe.motion.speed, seconds))
            motion = next(plans)
            if isinstance(motion, BaseException):
                raise motion
            return motion

        def link(recipe, console, yes, runs, word=None, facts=None):
            assert facts == {PARTS: PLANNED_PARTS}
            made.append((recipe.motion.speed, word))
            return nullcontext()

        monkeypatch.setattr(module, "plan_next", plan)
        monkeypatch.setattr(module, "open_link", link)
        monkeypatch.setattr(module, "run_key", lambda recipe: {"loop": PROBLEM})
        monkeypatch.setattr(Job, "record_program", record)
        first = [tmp_path / "excitation.mcap"]
        job = load_recipe(write_atomically(recipe, template()))
        found = until_sure(find, first, Job(job, folder, Console(-1), True, allowed), budget)  # type: ignore[arg-type]
        return found, seen

    run.made = made = []
    return run


def test_rounds_end_when_settled_and_use_all_logs(ask):
    found, seen = ask(["ambiguous", "unknown", "explained"], ["one", "two"])
    assert seen == [1, 2, 3]
    assert [one["after"] for one in found.asked] == ["ambiguous", "unknown"]
    assert [one["verdict"] for one in found.asked] == ["unknown", "explained"]
    assert found.asked[-1]["causes"] == [CAUSE]
    assert {one["motion"] for one in found.asked} == {"reversals of joint_2"}, (
        "what was run, not what a person was not asked"
    )
    assert found.end == "settled: explained"
    assert in_short(found.last.result) == "explained: friction rises as the joint slows down (stribeck) on joint_2"
    assert found.cut_short is None


def test_a_refused_log_ends_the_rounds_and_keeps_the_result(ask):
    refused = RejectedError("experiment_02.mcap: joint_5 looks flipped")
    found, seen = ask(["ambiguous", "ambiguous", refused], ["one", "two"])
    assert seen == [1, 2, 3]
    assert found.last.result["verdict"] == "ambiguous"
    assert found.cut_short is refused
    assert found.end == "cut short: experiment_02.mcap: joint_5 looks flipped"
    assert [path.name for path in found.logs] == ["one.mcap"]
    assert [one["verdict"] for one in found.asked] == ["ambiguous", None]
    assert found.uncounted is not None
    assert found.uncounted.name == "two.mcap", "it is there, and whoever asks again is told so"


def test_no_gap_without_a_model_is_limited_to_what_a_fit_does_not_absorb(ask):
    assert ask(["no_gap"], [])[0].end == "settled: no_gap"
    assert "name an earlier model with --model" in ask(["no_gap"], [], given=False)[0].end
    assert ask(["explained"], [], given=False)[0].end == "settled: explained"


def test_rounds_end_with_the_budget_or_if_no_motion_helps(ask):
    end = ask(["ambiguous"] * 2, ["one"], budget=25.0)[0].end
    assert end == "the motion budget is used up: 5 s are left, and a motion takes 10 to 60 s"
    found, _ = ask(["ambiguous"] * 3, ["one", "two"])
    assert found.end == NONE.text
    assert found.to_dict()["next_experiment"] == {**NONE.to_dict(), "program": None}, "what else may, nothing to run"
    assert len(found.logs) == 2


@pytest.mark.parametrize("why", [KeyboardInterrupt(), InputError("the cell leaves no room")])
def test_an_error_in_planning_keeps_the_earlier_result(ask, why):
    found, _ = ask(["ambiguous", "ambiguous"], ["one"], motions=[Motion(), why])
    assert found.cut_short is why
    assert found.end == f"cut short: {'interrupted' if isinstance(why, KeyboardInterrupt) else why}"
    assert [one["verdict"] for one in found.asked] == ["ambiguous"]
    assert found.uncounted is None


@pytest.mark.parametrize("why", [DriverError("the link dropped"), KeyboardInterrupt()])
def test_an_interrupted_round_keeps_the_earlier_result(ask, why):
    found, seen = ask(["ambiguous", "ambiguous"], ["one", why])
    assert found.cut_short is why
    assert found.last.result["verdict"] == "ambiguous"
    assert seen == [1, 2]
    assert len(found.logs) == 1
    assert found.asked[-1]["verdict"] is None
    assert found.asked[-1]["causes"] == []
    assert found.end == f"cut short: {'interrupted' if isinstance(why, KeyboardInterrupt) else why}"
    assert found.uncounted is None, "nothing was recorded whole"


def word(**released):
    said = {
        "robot": "comau_ns16",
        "serial": "NS16-42",
        "program": "ab" * 32,
        "problem": PROBLEM,
        "limits": {"speed": "1 m/s", "duration": "20 min"},
        "expires": "2026-12-31",
        "written_by": "M. Rossi",
    }
    return Authorisation(Path("word.yaml"), AuthorisationDocument.model_validate(said | released))


def test_unattended_motions_are_slow_and_authorised_one_by_one(ask):
    found, _ = ask(["ambiguous"] * 3, ["one", "two"], allowed=word(new_motions={"duration": "90 s"}))
    (slow, _), (there, first), _, (_, second), *_ = ask.made
    assert slow == pytest.approx(0.98 * FIRST_SPEED), "planned as slowly as a first run"
    assert there == 1.0, "the problem is the recipe's own"
    assert first.document.program == sha256_text(Motion.text)
    assert [one.document.limits.duration for one in (first, second)] == [90.0, 70.0]
    assert first.unseen
    assert len(found.logs) == 2


def test_unauthorised_motions_end_the_rounds_and_keep_the_result(ask):
    found, _ = ask(["ambiguous"], ["one"], allowed=word())
    assert "releases no new motions" in found.end
    assert found.logs == []
    assert found.last.result["verdict"] == "ambiguous"


@pytest.mark.parametrize(("before", "after", "helps"), [(0.0, 0.6, True), (0.0, 0.2, False), (0.9, 0.92, False)])
def test_a_motion_that_separates_one_side_only_still_helps(before, after, helps):
    expected = [SimpleNamespace(before_if=(before, None), after_if=(after, None))]
    expected += [SimpleNamespace(before_if=(1.0, 0.0), after_if=(1.0, 0.1))]
    experiment = SimpleNamespace(expected=expected)
    assert NextMotion(experiment, PlannedProgram("experiment", "", ()), None, Pdl2()).helps() is helps  # type: ignore[arg-type]


def pair(first: str, second: str):
    sides = [SimpleNamespace(effect=name, text=lambda name=name: f"{name} on joint_2") for name in (first, second)]
    return SimpleNamespace(names=(first, second), first=sides[0], second=sides[1])


def found_with(zero_known: bool):
    return SimpleNamespace(selected=SimpleNamespace(zero_known=zero_known))


def test_names_where_to_look_for_either_cause_if_no_motion_helps():
    pairs = [pair("torque_offset", "none"), pair("stribeck", "presliding")]
    text = advice_without_motion(found_with(False), pairs)  # type: ignore[arg-type]
    assert f"for torque_offset on joint_2, {CATALOGUE['torque_offset'].look_at}" in text
    assert CATALOGUE["stribeck"].look_at not in text, "the most urgent pair"
    assert "--drives-off" in text
    assert "--drives-off" not in advice_without_motion(found_with(True), pairs), "it is there"  # type: ignore[arg-type]
    no_channel = advice_without_motion(found_with(False), pairs[1:])  # type: ignore[arg-type]
    assert "--drives-off" not in no_channel, "no motor's current is in it"


@pytest.mark.parametrize("brakes", [False, True])
def test_a_planned_motion_asks_for_the_drives_off_record_first(brakes):
    robot, piece = load_robot("comau_ns16"), SimpleNamespace(text=lambda robot: "reversals of joint_2")
    experiment, text = SimpleNamespace(expected=(), pieces=[piece]), write_program("experiment", [Delay(4.0)], robot)
    motion = NextMotion(experiment, PlannedProgram("experiment", text, ()), robot, Pdl2(), brakes=brakes)  # type: ignore[arg-type]
    said = motion.to_dict("program.pdl")["motion"]
    assert said.endswith("reversals of joint_2")
    assert ("--drives-off" in said) is brakes


def test_the_page_has_question_motion_and_answer_of_every_round(ask):
    found, _ = ask(["ambiguous", "explained"], ["one"])
    page = render(Page("Gap", "it is", "plain", [rounds_section(**to_sections(found))]))
    for text in ("stribeck on joint_2 or presliding on joint_2", "reversals of joint_2 (20 s)", "0.51, 0.93"):
        assert text in page
    assert "explained: " in page
    cut, _ = ask(["ambiguous"], [DriverError("the link dropped")])
    assert "cut short" in render(Page("Gap", "it is", "plain", [rounds_section(**to_sections(cut))]))
    assert rounds_section(None, "") is None
    assert "No further motion was run." in rounds_section([], "settled: no_gap").text


def test_the_page_has_the_motion_that_was_planned_and_what_it_is_expected_to_tell():
    planned = {**Motion(brakes=False).to_dict("next/program.pdl"), "separates": []}
    planned["probability"] = [{**PAIR, "smallest_over_practical": 0.4}]
    page = render(Page("Gap", "it is", "plain", [planned_section(planned)]))
    for text in ("reversals of joint_2 (20 s, next/program.pdl)", "stribeck on joint_2 or presliding on joint_2"):
        assert text in page
    assert all(figure in page for figure in ("0.51", "0.93", "0.4"))
    assert planned_section(None) is planned_section(NONE.to_dict()) is None
    assert next_text(NONE.to_dict()).startswith("No motion would tell"), "there is nothing to run"


def to_sections(found) -> dict:
    result = found.to_dict()
    return {"rounds": result["rounds"], "end": result["rounds_end"]}


@pytest.mark.parametrize("kept", ["experiment.json", "program.pdl"])
def test_refuses_an_unusable_experiment_folder_before_diagnosing(tmp_path: Path, kept, monkeypatch):
    """Somebody's program is not written over, and a file that is in the way is found whatever lies below it."""
    (tmp_path / kept).write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="already; name another folder"):
        check_next(tmp_path / "job.yaml", tmp_path)
    for folder in (tmp_path / kept, tmp_path / kept / "plan" / "deep"):
        with pytest.raises(InputError, match=f"{kept}: is a file"):
            check_next(tmp_path / "job.yaml", folder)
    assert (tmp_path / kept).read_text(encoding="utf-8") == "mine"
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(AgentError, match="nothing can be written there") as refused:
        check_next(tmp_path / "job.yaml", tmp_path / "new")
    assert refused.value.exit_code == 1


def test_a_run_with_a_failing_disk_still_reports_what_ended_it(tmp_path: Path, monkeypatch):
    recipe = tmp_path / "job.yaml"
    recipe.write_text("robot: comau_ns16\n", encoding="utf-8")
    run = RunFolder.create(tmp_path / "logs", "comau_ns16", recipe)
    run.note(kind="diagnose")
    ended = DriverError("the link dropped")
    monkeypatch.setattr(RunFolder, "_save", lambda self: (_ for _ in ()).throw(AgentError("no space left")))
    job = Job(load_recipe(write_atomically(recipe, template())), run, Console(-1))
    with pytest.raises(DriverError) as raised, job.step("rounds"):
        raise ended
    assert raised.value is ended
