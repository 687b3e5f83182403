"""From logs, or from a robot, to a diagnosis and what it writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

from agent.core import AgentError, Console, read_json, words_of, write_atomically
from agent.diagnosis import Diagnosis, extended_model, simulation_part, supported_correction
from agent.experiment import Deadline, NoMotion
from agent.model import CATALOGUE, IdentifiedModel, payload_of
from agent.pages import diagnosis_report, in_short, summary
from agent.pipeline.checked_logs import load_arm
from agent.pipeline.gap.corrected_output import run_forward, write_simulator
from agent.pipeline.gap.diagnosis_question import GapQuestion, options_of
from agent.pipeline.gap.diagnosis_run import DiagnosisRun, read_at_rest, read_reference, run_diagnosis
from agent.pipeline.gap.next_experiment import clearer_loaded, plan_next, write_next
from agent.pipeline.gap.next_steps import after_diagnosis
from agent.pipeline.gap.set_point_files import next_set_points
from agent.pipeline.gap.until_sure import Rounds, until_sure
from agent.pipeline.job import Job, validation_logs
from agent.pipeline.planning.plan import plan_once
from agent.recipe import load_recipe
from agent.robot import RobotDescription
from agent.runs import RunFolder, robot_lock
from agent.simulators import Simulator, is_simulator

#: Copies in the run folder of the model to compare with and of the log with the drives off.
_SIMULATOR, _DRIVES_OFF = "simulator.json", "drives_off.mcap"
#: Slow motions recorded in addition to the excitation loop: enough to hold one out, few enough to wait for.
_VALIDATION_MOTIONS = 3


def diagnose_files(
    robot: str | RobotDescription | None,
    paths: Sequence[Path],
    question: GapQuestion,
    console: Console,
    on_result: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Diagnose logs; returns the result of docs/diagnosis.md, and writes what is asked for.

    Without a `robot` the model describes the arm. `on_result` is called with the result, once the page is written:
    before a further motion is planned, after that, and if the planning fails or is stopped.

    Args:
        robot: description, its name or file; None: the model describes the arm.
        paths: of the logs.
        question: model, what to leave out, and what to write.
        console: where progress and warnings are shown.
        on_result: called with every result.

    Raises:
        InputError: a robot, model or log that cannot be used, an unknown effect, or an output that cannot be written.
    """
    source = robot.name if isinstance(robot, RobotDescription) else robot
    arm = load_arm(robot, paths, question.topic) if isinstance(robot, str) else robot
    question.check(paths)
    run = run_diagnosis(arm, paths, question, console)
    for result in _published(run, question, console, source, paths):
        on_result(result)
    return result


def diagnose_recording(
    recipe: Path,
    question: GapQuestion,
    console: Console,
    runs: Path,
    yes: bool,
    budget: float | None = None,
    on_result: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Record the recipe's motions into a run folder, then diagnose them; result and report are in the folder too.

    With a `budget` [s of motion], further motions follow until the cause is settled (`until_sure`). `on_result` is
    called once the result is in the run folder, also if a further motion is cut short.

    Args:
        recipe: whose motions are recorded.
        question: as of `diagnose_files`.
        console: where progress and warnings are shown.
        runs: folder of runs.
        yes: whether motion may begin without a question.
        budget: further motion that is allowed [s]; None: none.
        on_result: called with every result.

    Raises:
        AgentError, DriverError: as in `agent calibrate`, before anything moves or after a controlled stop.
    """
    loaded = load_recipe(recipe)
    question.check([])
    reference, simulator = read_reference(loaded.robot, [], question, console)
    read_at_rest(loaded.robot, reference, question, console)
    validation_motions = min(loaded.validate.motions, _VALIDATION_MOTIONS)
    loaded = replace(loaded, validate=loaded.validate.model_copy(update={"motions": validation_motions}))
    with robot_lock(loaded.controller.driver, loaded.controller.address):
        asked = {"cutoff": question.cutoff, "without": question.without, "budget": budget}
        options = [*question.options(), *options_of(budget)]
        facts = {"robot_source": loaded.robot_source, "question": asked, "options": options}
        job = Job.start("diagnose", loaded, console, runs, facts, yes)
        run = job.run
        question = _with_copies(question, reference, run)
        console.say(f"run {run.path}")
        with job.step("plan"):
            plan = plan_once(loaded, run, console)
        with job.step("record"):
            recordings = job.record(plan)
        paths = [recording.path for recording in recordings]
        rounds = None
        if budget is not None:
            remaining = budget - sum(recorded.duration for recorded in recordings)
            with job.step("rounds"):
                diagnose = partial(run_diagnosis, loaded.robot, question=question, console=console)
                rounds = until_sure(diagnose, paths, job, remaining, question.planning_budget)
                if rounds.cut_short is not None:
                    _save_cut_short(job, question, paths, simulator, on_result, rounds)
                    raise rounds.cut_short
        with job.step("diagnose"):
            result = _answer_run(job, question, paths, simulator, on_result, rounds)
        run.complete(True)
        ended = job.end(result, f"{'page':20}{run.file('report.html')}")
    console.say(ended.text)
    return result


def _with_copies(question: GapQuestion, reference: IdentifiedModel | None, run: RunFolder) -> GapQuestion:
    """The question with the model to compare with and the log with the drives off as files of the run."""
    if reference is not None:
        run.write_text(_SIMULATOR, json.dumps(reference.to_dict(), allow_nan=False))
        question = replace(question, model=run.file(_SIMULATOR), joint_map=None)
    if question.drives_off is not None:
        question = replace(question, drives_off=Path(copyfile(question.drives_off, run.file(_DRIVES_OFF))))
    return question


def _save_cut_short(
    job: Job,
    question: GapQuestion,
    paths: Sequence[Path],
    simulator: Simulator | None,
    on_result: Callable[[dict[str, Any]], None],
    rounds: Rounds,
) -> None:
    """Say and save what the motions before one that was cut short show."""
    uncounted_text = f"; {rounds.uncounted.name} is recorded but not counted" if rounds.uncounted else ""
    job.console.say(f"result of the earlier motions: {in_short(rounds.last.result)}{uncounted_text}")
    try:
        _answer_run(job, question, paths, simulator, on_result, rounds)
        job.console.say(f"the full result is in {job.run.path}")
    except AgentError as error:  # a full disk both cuts a motion short and prevents this
        job.console.warn(f"the result could not be saved: {error}")


def diagnose_again(run: Path, robot: RobotDescription, source: str, console: Console) -> str:
    """HTML of the page of a recorded diagnosis, from the run's files; `source` is what names the robot.

    Raises:
        InputError: a log or the model cannot be read.
        KeyError: the run does not say what was asked.
    """
    asked = read_json(run / "state.json")["question"]
    files = [path if path.exists() else None for path in (run / _SIMULATOR, run / _DRIVES_OFF)]
    question = GapQuestion(model=files[0], cutoff=asked["cutoff"], without=tuple(asked["without"]), drives_off=files[1])
    recorded = read_json(run / "result.json")
    # the log of a round that was cut short does not count in the result
    further = [Path(round_["program"]).stem for round_ in recorded.get("rounds", ()) if round_.get("verdict")]
    logs = [run / "excitation.mcap", *validation_logs(run), *(run / f"{name}.mcap" for name in further)]
    diagnosed = run_diagnosis(robot, logs, question, console)
    steps = after_diagnosis(recorded, source, logs, question)
    return diagnosis_report(diagnosed.diagnosis, diagnosed.simulated, steps, recorded)


def _answer_run(
    job: Job,
    question: GapQuestion,
    paths: Sequence[Path],
    simulator: Simulator | None,
    on_result: Callable[[dict[str, Any]], None],
    rounds: Rounds | None,
) -> dict[str, Any]:
    """Result and page of all motions of a run, written into its folder; `paths` are the logs before the `rounds`."""
    logs = [*paths, *(rounds.logs if rounds else ())]
    diagnosed = rounds.last if rounds else run_diagnosis(job.recipe.robot, logs, question, job.console)
    diagnosed = replace(diagnosed, simulator=simulator)
    all_logs = [*logs, *([rounds.uncounted] if rounds and rounds.uncounted else [])]
    page = job.run.file("report.html")
    for result in _published(diagnosed, question, job.console, job.recipe.robot_source, all_logs, rounds, page):
        job.run.write_json("result.json", result)
        on_result(result)
    return result


def _published(
    run: DiagnosisRun,
    question: GapQuestion,
    console: Console,
    source: str | None,
    logs: Sequence[Path],
    rounds: Rounds | None = None,
    page: Path | None = None,
) -> Iterator[dict[str, Any]]:
    """The result each time it has grown, with its summary; then the pages that are asked for, which a disk may refuse.

    `source` names the robot, `page` is one in addition to that of the question.
    """
    recipe = question.next_recipe if rounds is None else rounds.recipe
    for result in _results(run, question, console, rounds):
        steps = after_diagnosis(result, source, logs, question, recipe)
        result = {**result, "summary": summary(result, steps)}
        yield result
        if wanted := [page_path for page_path in (page, question.report) if page_path is not None]:
            html = diagnosis_report(run.diagnosis, run.simulated, steps, result)
            for page_path in wanted:
                write_atomically(page_path, html)


def _results(
    run: DiagnosisRun, question: GapQuestion, console: Console, rounds: Rounds | None
) -> Iterator[dict[str, Any]]:
    """The result of a diagnosis, and again with each motion that is planned, and with what stopped the planning.

    Last, the model or the simulator that is asked for is written. `rounds` are those of the diagnosed logs.
    """
    diagnosis, simulator = run.diagnosis, run.simulator
    for warning in diagnosis.warnings:
        console.warn(warning)
    result = {**run.result, "simulation": simulation_part(diagnosis, run.simulated)}
    result |= rounds.to_dict() if rounds is not None else {}
    correction = None if simulator is None else supported_correction(diagnosis, simulator)
    if simulator is not None and correction is not None and diagnosis.dataset.servos is None:
        result |= run_forward(diagnosis, simulator, correction, console)
    yield result
    if question.next_recipe is not None:
        motions = _planned(diagnosis, simulator, question, console)
        for what in ("the next motion", "the motion with a known mass"):
            try:
                planned = next(motions, {})
            except BaseException as error:
                warning = f"{what} was not planned: {words_of(error)}"
                yield {**result, "warnings": [*result["warnings"], warning]}
                raise
            if planned:
                result = {**result, **planned}
                yield result
    elif question.out is not None and simulator is not None and correction is not None:
        write_simulator(diagnosis, simulator, correction, question.out, console)
    elif question.out is not None:
        _write_model(diagnosis, question.out, console)


def _planned(
    diagnosis: Diagnosis, simulator: Simulator | None, question: GapQuestion, console: Console
) -> Iterator[dict[str, Any]]:
    """`next_experiment`: the next motion, then that with a known mass if it makes the answer clearer."""
    assert question.next_recipe is not None
    assert question.out is not None
    if is_simulator(question.next_recipe):
        yield {"next_experiment": next_set_points(diagnosis, simulator, question.next_recipe, question.out, console)}
        return
    load = None if question.next_payload is None else payload_of(question.next_payload)
    recipe = load_recipe(question.next_recipe)
    deadline = Deadline(console.progress, question.planning_budget)
    motion = plan_next(diagnosis, recipe, console, load=load, deadline=deadline)
    if isinstance(motion, NoMotion):
        if not motion.separates:
            console.warn(f"{motion.text}; nothing is written to {question.out}")
        yield {"next_experiment": motion.to_dict()}
        return
    planned = write_next(motion, question.out)
    yield {"next_experiment": planned}
    if (mass := clearer_loaded(diagnosis, recipe, motion, console, deadline)) is not None:
        yield {"next_experiment": {**planned, "with_a_mass": mass.to_dict()}}


def _write_model(diagnosis: Diagnosis, out: Path, console: Console) -> None:
    """Write the model with the effects found; warns of effects that no model holds."""
    model = extended_model(diagnosis)
    left_out = [c["effect"] for c in diagnosis.result["causes"] if c["effect"] not in {e.effect for e in model.effects}]
    for name in left_out:
        why = "it happened once" if CATALOGUE[name].transient else "it is in the set-points only"
        console.warn(f"{out}: {name} is left out of the model: {why}")
    if not diagnosis.result["causes"]:
        console.warn(f"{out}: no effect was found, so the model is unchanged")
    if len(model.effects) == len(diagnosis.dataset.model.effects):
        model = diagnosis.dataset.model
    model.save(out)
