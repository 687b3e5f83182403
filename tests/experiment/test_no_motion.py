"""Reasons for no planned motion, and the result of a diagnosis whose further motion cannot be planned."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import AgentError, Console, InputError, RejectedError, write_atomically
from agent.experiment import KINDS, LONGEST, Experiment, NextMotion, NoMotion, known_mass, next_motion
from agent.experiment.pieces import Pieces
from agent.motion.pdl2.dialect import Pdl2
from agent.pipeline import GapQuestion, check_plausible, diagnose_files
from agent.pipeline.gap import diagnose, diagnosis_run
from agent.pipeline.gap.next_experiment import check_arm, check_tool, plan_next
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import load_recipe, template
from agent.recording import write_log
from agent.robot import load_robot
from agent.safety import PlannedProgram
from benchmarks.active import run as active
from benchmarks.active.baselines import as_drawn
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

NOTHING = Experiment((), (), 0)


def side(effect: str, form: str | None = "one"):
    return SimpleNamespace(effect=effect, text=lambda: f"{effect} on joint_2", form=form)


RIVAL = side("presliding")


def pair(first, second):
    return SimpleNamespace(first=first, second=second, names=(first.effect, second.effect))


@pytest.fixture
def ask(tmp_path: Path, monkeypatch):
    """`ask(experiments, seconds, change, held)`: what is said where the searches come to these experiments."""

    def run(experiments, seconds=LONGEST, change=lambda text: text, held=None, second=RIVAL):
        recipe = load_recipe(write_atomically(tmp_path / "job.yaml", change(template())))
        found = SimpleNamespace(
            stuck_torque=held,
            selected=SimpleNamespace(zero_known=False),
            dataset=SimpleNamespace(
                robot=recipe.robot,
                has_reference=False,
                model=SimpleNamespace(provenance={}),
                fit=SimpleNamespace(reference=SimpleNamespace(scale=np.full(6, 100.0), reach=2.0)),
            ),
        )
        answers = iter(experiments)
        monkeypatch.setattr(next_motion, "open_pairs", lambda found: [pair(side("stribeck"), second)])
        for module in (next_motion, known_mass):
            monkeypatch.setattr(module, "plan_experiment", lambda *_: next(answers))
        return plan_next(found, recipe, Console(-1), seconds)  # type: ignore[arg-type]

    return run


def test_reports_what_no_motion_separates_and_where_to_look(ask):
    in_time = ask([replace(NOTHING, weighed=2, cut_short=True)]).text
    assert "(2 pieces tried): allow more with --planning-budget" in in_time
    assert "Try" not in in_time, "nobody knows that no motion would"
    said = ask([replace(NOTHING, weighed=200), NOTHING])
    assert "distinguishes stribeck on joint_2 from presliding on joint_2. Try another posture" in said.text
    assert said.separates == ("presliding", "stribeck")
    assert said.to_dict()["program"] is None
    alone = ask([replace(NOTHING, weighed=200), NOTHING], second=side("none", form=None))
    assert "shows stribeck on joint_2. Try" in alone.text


def test_a_doubtful_cause_without_an_alternative_is_not_settled(tmp_path: Path, monkeypatch):
    recipe = load_recipe(write_atomically(tmp_path / "job.yaml", template()))
    cause = SimpleNamespace(key=("torque_ripple", (5,)), effect=SimpleNamespace(name="torque_ripple"))
    dataset = SimpleNamespace(robot=recipe.robot)
    found = SimpleNamespace(verdict="ambiguous", selected=SimpleNamespace(causes=(cause,)), dataset=dataset)
    monkeypatch.setattr(next_motion, "open_pairs", lambda found: [])
    said = plan_next(found, recipe, Console(-1))  # type: ignore[arg-type]
    assert said.text.startswith("torque_ripple on joint_6 closes too little of the gap to be sure. ")
    assert said.to_dict()["separates"] == ["torque_ripple"]
    found.verdict = "explained"
    assert plan_next(found, recipe, Console(-1)) == NoMotion("nothing is open: no further motion is needed")  # type: ignore[arg-type]


def test_names_the_limit_if_no_motion_is_feasible(ask):
    box = "cell: {keep_out: [{name: post, box: {min: [0.9 m, -0.3 m, 0 m], max: [1.1 m, 0.3 m, 1.5 m]}}]}\n"
    said = ask([NOTHING], change=lambda text: box + text)
    assert "no motion found in the sub-region of" in said.text
    assert "keeps all limits" in said.text
    assert "post" in said.text
    assert "agent check" in said.text
    assert "Try" not in said.text


def test_asks_for_more_time_if_too_little_is_left(ask):
    said = ask([replace(NOTHING, weighed=200)], seconds=12.0)
    assert said.text == "no motion of the remaining 12 s settles it: allow more motion"


def test_plans_no_motion_for_a_held_torque_sensor(ask):
    held = SimpleNamespace(motion="the same motions again, after you repair the torque measurement of joint_3")
    said = ask([], held=held)
    assert said == NoMotion(held.motion, ("presliding", "stribeck"))


@pytest.fixture(scope="module")
def arm():
    return make_arm("RR")


@pytest.fixture(scope="module")
def logs(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]


def test_finds_a_log_with_inverted_torque_among_good_ones(arm, logs):
    model = learn(arm)
    good, bad = logs[0], replace(logs[1], effort=-logs[1].effort)
    check_plausible(arm, [good, logs[1]], False, Console(-1), model=model)
    with pytest.raises(RejectedError, match=r"two\.mcap: the torque of joint_1, joint_2 has the opposite sign"):
        check_plausible(arm, [good, good, bad], False, Console(-1), model=model)


def fails(why):
    def step(*_, **__):
        raise why

    return step


@pytest.fixture
def asked(arm, logs, tmp_path: Path, monkeypatch):
    """`asked()`: a diagnosis with a further motion that what is set before stops; the question, and what was shown."""
    learn(arm).save(tmp_path / "model.json")
    paths = [tmp_path / log.name for log in logs]
    for path, log in zip(paths, logs, strict=True):
        write_log(path, log)
    monkeypatch.setattr(GapQuestion, "check", lambda *_: None)
    for module in (diagnose, diagnosis_run):
        monkeypatch.setattr(module, "load_recipe", lambda path: path)
    monkeypatch.setattr(diagnosis_run, "check_arm", lambda *_: None)
    monkeypatch.setattr(diagnosis_run, "check_tool", lambda *_: None)
    question = GapQuestion(
        tmp_path / "model.json", report=tmp_path / "page.html", out=tmp_path / "next", next_recipe=tmp_path / "job.yaml"
    )

    def run(why):
        shown: list[dict] = []
        with nullcontext() if why is None else pytest.raises(type(why)):
            diagnose_files(arm, paths, question, Console(-1), shown.append)
        assert len(shown) > 1, "what came of the planning is shown too"
        assert shown[0]["verdict"] == shown[-1]["verdict"]
        assert not any("found out" in text for text in shown[0]["warnings"]), "the verdict comes before the planning"
        return question, shown[-1]

    return run


def test_keeps_the_verdict_if_the_forward_simulation_fails(arm, logs, tmp_path: Path, monkeypatch):
    learn(arm).save(tmp_path / "model.json")
    for log in logs:
        write_log(tmp_path / log.name, log)
    question = GapQuestion(tmp_path / "model.json", report=tmp_path / "page.html")
    monkeypatch.setattr(diagnosis_run, "simulate", fails(InputError("the effect gives no finite torque")))
    result = diagnose_files(arm, [tmp_path / log.name for log in logs], question, Console(-1))
    assert (result["verdict"], result["simulation"]) == ("no_gap", None)
    assert any("the forward simulation failed" in text and "finite torque" in text for text in result["warnings"])
    shown: list[dict] = []
    monkeypatch.setattr(diagnose, "write_atomically", fails(AgentError("the disk is full")))
    with pytest.raises(AgentError, match="the disk is full"):
        diagnose_files(arm, [tmp_path / log.name for log in logs], question, Console(-1), shown.append)
    assert [one["verdict"] for one in shown] == ["no_gap"], "a page that the disk refuses comes after the verdict"
    assert "the forward simulation failed" in question.report.read_text(encoding="utf-8")


STOPS = [KeyboardInterrupt(), InputError("a box that nothing keeps clear of")]


@pytest.mark.parametrize("why", STOPS)
def test_keeps_diagnosis_and_page_if_planning_is_stopped(asked, monkeypatch, why):
    monkeypatch.setattr(diagnose, "plan_next", fails(why))
    question, shown = asked(why)
    assert shown["verdict"] == "no_gap"
    assert any("the next motion was not planned" in text for text in shown["warnings"])
    assert "Gap between model and" in question.report.read_text(encoding="utf-8")
    assert not question.out.exists()


def test_shows_the_diagnosis_again_if_nothing_is_open(asked, monkeypatch):
    monkeypatch.setattr(diagnose, "plan_next", lambda *_, **__: NoMotion("nothing is open"))
    assert asked(None)[1]["next_experiment"] is None


@pytest.mark.parametrize("why", STOPS)
def test_keeps_the_bare_arm_motion_if_planning_with_a_mass_is_stopped(asked, monkeypatch, why):
    piece = SimpleNamespace(text=lambda robot: "a loop of the bare arm")
    experiment = SimpleNamespace(expected=(), pieces=[piece])
    text = "PROGRAM x\nBEGIN\n  DELAY 4000\nEND x\n"
    planned = NextMotion(experiment, PlannedProgram("experiment", text, ()), load_robot("comau_ns16"), Pdl2())  # type: ignore[arg-type]
    monkeypatch.setattr(diagnose, "plan_next", lambda *_, **__: planned)
    monkeypatch.setattr(diagnose, "clearer_loaded", fails(why))
    question, shown = asked(why)
    assert shown["next_experiment"]["motion"] == "a loop of the bare arm"
    assert any("the motion with a known mass was not planned" in text for text in shown["warnings"])
    assert (question.out / "program.pdl").read_text(encoding="utf-8") == text
    assert "a loop of the bare arm" in question.report.read_text(encoding="utf-8")


def test_a_recipe_with_another_tool_than_the_logs_or_the_model_is_refused(tmp_path: Path):
    """It had been planned and run; its log was refused among the others."""
    bare = load_recipe(write_atomically(tmp_path / "bare.yaml", template()))
    tooled = load_recipe(write_atomically(tmp_path / "tool.yaml", template() + "\ntool: {mass: 4 kg}\n"))
    log = SimpleNamespace(name="a.mcap", metadata={"tool": "none"})
    unsaid = SimpleNamespace(name="b.mcap", metadata={})
    check_tool(bare, [log, unsaid], {"tool": ["none"]})  # type: ignore[list-item]
    check_tool(tooled, [unsaid], {})  # type: ignore[list-item]
    with pytest.raises(InputError, match=r"its tool is .*4 kg.*, but that of a\.mcap is none"):
        check_tool(tooled, [log], {})  # type: ignore[list-item]
    with pytest.raises(InputError, match="that of the model is none"):
        check_tool(tooled, [unsaid], {"tool": ["none"]})  # type: ignore[list-item]


def test_plans_within_the_fitted_and_logged_range():
    recipe_problem = SimpleNamespace(robot=make_arm("RR"), joint_ranges={"joint_2": (-0.4, 3.0)})
    fitted = {"lowest": [-1.0, -1.0], "highest": [1.0, 1.0], "fastest": [1.0, 1.0]}
    found = SimpleNamespace(
        dataset=SimpleNamespace(
            has_reference=True,
            model=SimpleNamespace(provenance={"range": fitted}),
            fit=SimpleNamespace(signals=[SimpleNamespace(q=np.array([[-1.8, 0.0], [0.3, 0.2]]))]),
        )
    )
    kept: dict[str, tuple[float, float]] = {}

    def replaced(problem, joint_ranges):
        kept.update(joint_ranges)
        return problem

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(next_motion, "replace", replaced)
        next_motion._where_known(recipe_problem, found)  # type: ignore[arg-type]
    assert kept["joint_1"] == (-1.8, 1.5), "a quarter further than the fit, and as far as the logs"
    assert kept["joint_2"] == (-0.4, 1.5), "and never further than the cell allows"
    found.dataset.model.provenance = {}
    assert next_motion._where_known(recipe_problem, found) is recipe_problem  # type: ignore[arg-type]


def test_transfers_between_pieces_count_towards_the_time(tmp_path: Path, monkeypatch):
    """Two pieces that alone would fill it leave no time for the way from one to the other."""
    recipe = load_recipe(write_atomically(tmp_path / "job.yaml", template()))
    asked: list[tuple[int, bool]] = []

    def both(pick, problem, seconds, seed, runnable, kinds):
        pieces = Pieces(problem, [0], 30.0, np.random.default_rng(seed))
        drawn = [piece for piece in (pieces.draw() for _ in range(12)) if piece is not None][:2]
        asked.append((2, runnable(drawn)))
        asked.append((1, runnable(drawn[:1])))
        return tuple(drawn[:1])

    monkeypatch.setattr(active, "pieces_otherwise", both)
    pieces = Pieces(loop_problem(recipe, recipe.motion.speed), [0], 30.0, np.random.default_rng(3))
    first, second = [piece for piece in (pieces.draw() for _ in range(12)) if piece is not None][:2]
    allowed = first.duration + second.duration
    text, took = active.run_otherwise(as_drawn, KINDS, recipe, allowed, "other", 3)
    assert asked == [(2, False), (1, True)]
    assert took <= allowed
    assert text.startswith("PROGRAM other")


def test_a_recipe_of_another_arm_whose_joints_have_the_same_names_is_refused(tmp_path: Path):
    recipe = load_recipe(write_atomically(tmp_path / "job.yaml", template()))
    check_arm(recipe, replace(recipe.robot, name="the same arm by another description"))
    other = make_arm("RRRRRR")
    assert other.joint_names == recipe.robot.joint_names
    with pytest.raises(InputError, match=r"is for comau_ns16, but the logs are of .* In the same posture, .* mm apart"):
        check_arm(recipe, other)
    with pytest.raises(InputError, match="In the same posture"):  # by its name it is the same
        check_arm(recipe, replace(other, name=recipe.robot.name))
