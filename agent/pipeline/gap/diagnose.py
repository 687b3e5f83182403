"""From logs, or from a robot, to a diagnosis and what it writes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import Any

from agent.core import AgentError, Console, InputError, counted, words_of, write_atomically
from agent.diagnosis import (
    Diagnosis,
    Simulated,
    channel_zero,
    diagnose,
    extended_model,
    simulate,
    simulation_part,
    with_servo_torque,
)
from agent.experiment import Deadline
from agent.model import CATALOGUE, IdentifiedModel, payload_of
from agent.pipeline.gap.corrected_simulator import run_forward, write_simulator
from agent.pipeline.gap.next_experiment import NoMotion, check_arm, check_tool, clearer_with_mass, plan_next, write_next
from agent.pipeline.gap.next_steps import after_diagnosis
from agent.pipeline.gap.question import GapQuestion, options_of
from agent.pipeline.gap.until_sure import Found, Rounds, until_sure
from agent.pipeline.identify import check_one_machine, check_plausible, load_arm, read_logs, say_used
from agent.pipeline.job import Job, validation_logs
from agent.pipeline.plan import plan_once
from agent.recipe import load_recipe
from agent.recording import Log, read_log
from agent.report import NextStep, diagnosis_report, summary
from agent.robot import RobotDescription
from agent.runs import robot_lock
from agent.simulators import SIMULATOR, Simulator, is_simulator, load_joint_map, load_simulator

#: Copies in the run folder of the model to compare with and of the log with the drives off.
_SIMULATOR, _DRIVES_OFF = "simulator.json", "drives_off.mcap"
#: Slow motions recorded in addition to the excitation loop: enough to hold one out, few enough to wait for.
_VALIDATION_MOTIONS = 3


def diagnose_files(
    robot: str | RobotDescription | None,
    paths: Sequence[Path],
    question: GapQuestion,
    console: Console,
    told: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Diagnose logs; returns the result of docs/diagnosis.md, and writes what is asked for.

    Without a `robot` the model describes the arm. `told` is called with the result, once the page is written: before a
    further motion is planned, after that, and if the planning fails or is stopped.

    Raises:
        InputError: a robot, model or log that cannot be used, an unknown effect, or an output that cannot be written.
    """
    source = robot.name if isinstance(robot, RobotDescription) else robot
    arm = load_arm(robot, paths, question.topic) if isinstance(robot, str) else robot
    question.check(paths)
    found = _find(arm, paths, question, console)

    def publish(result: dict[str, Any]) -> None:
        steps = after_diagnosis(result, source, paths, question, question.next_recipe)
        _publish(found, result, steps, question.report)
        told(dict(result))

    return _conclude(found, question, console, publish)


def diagnose_recording(
    recipe: Path,
    question: GapQuestion,
    console: Console,
    runs: Path,
    yes: bool,
    budget: float | None = None,
    told: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Record the recipe's motions into a run folder, then diagnose them; result and report are in the folder too.

    With a `budget` [s of motion], further motions follow until the cause is settled (`until_sure`). `told` is called
    once the result is in the run folder, also if a further motion is cut short.

    Raises:
        AgentError, DriverError: as in `agent calibrate`, before anything moves or after a controlled stop.
    """
    loaded = load_recipe(recipe)
    question.check([])
    reference, simulator = _simulator(loaded.robot, [], question, console)
    _at_rest(loaded.robot, reference, question, console)
    few = min(loaded.validate.motions, _VALIDATION_MOTIONS)
    loaded = replace(loaded, validate=loaded.validate.model_copy(update={"motions": few}))
    with robot_lock(loaded.controller.driver, loaded.controller.address):
        asked = {"cutoff": question.cutoff, "without": question.without, "budget": budget}
        options = [*question.options(), *options_of(budget)]
        facts = {"robot_source": loaded.robot_source, "question": asked, "options": options}
        job = Job.start("diagnose", loaded, console, runs, facts, yes)
        run = job.run
        if reference is not None:
            run.write_text(_SIMULATOR, json.dumps(reference.to_dict(), allow_nan=False))
            question = replace(question, model=run.file(_SIMULATOR), joint_map=None)
        if question.drives_off is not None:
            question = replace(question, drives_off=Path(copyfile(question.drives_off, run.file(_DRIVES_OFF))))
        console.say(f"run {run.path}")
        with job.step("plan"):
            plan = plan_once(loaded, run, console)
        with job.step("record"):
            recordings = job.record(plan)
        paths = [recording.path for recording in recordings]

        def conclude(rounds: Rounds | None) -> dict[str, Any]:
            """Write result and page of all motions into the run folder."""
            logs = [*paths, *(rounds.logs if rounds else ())]
            found = rounds.last if rounds else _find(loaded.robot, logs, question, console)
            found = replace(found, simulator=simulator)
            shown = [*logs, *([rounds.uncounted] if rounds and rounds.uncounted else [])]
            where = question.next_recipe if rounds is None else rounds.recipe

            def publish(result: dict[str, Any]) -> None:
                steps = after_diagnosis(result, loaded.robot_source, shown, question, where)
                _publish(found, result, steps, run.file("report.html"), question.report)
                run.write_json("result.json", result)
                told(dict(result))

            return _conclude(found, question, console, publish, rounds)

        rounds = None
        if budget is not None:
            left = budget - sum(one.duration for one in recordings)
            with job.step("rounds"):
                find = partial(_find, loaded.robot, question=question, console=console)
                rounds = until_sure(find, paths, job, left, question.planning_budget)
                if rounds.cut_short is not None:
                    more = rounds.uncounted and f"; {rounds.uncounted.name} is recorded but not counted"
                    console.say(f"result of the earlier motions: {rounds.said}{more or ''}")
                    try:
                        conclude(rounds)
                        console.say(f"the full result is in {run.path}")
                    except AgentError as error:  # a full disk both cuts a motion short and prevents this
                        console.warn(f"the result could not be saved: {error}")
                    raise rounds.cut_short
        with job.step("diagnose"):
            result = conclude(rounds)
        run.complete(True)
        ended = job.end(result, f"{'page':20}{run.file('report.html')}")
    console.say(ended.text)
    return result


def diagnose_again(run: Path, robot: RobotDescription, source: str, console: Console) -> str:
    """HTML of the page of a recorded diagnosis, from the run's files; `source` is what names the robot.

    Raises:
        InputError: a log or the model cannot be read.
        KeyError: the run does not say what was asked.
    """
    asked = json.loads((run / "state.json").read_text(encoding="utf-8"))["question"]
    kept = [path if path.exists() else None for path in (run / _SIMULATOR, run / _DRIVES_OFF)]
    question = GapQuestion(kept[0], cutoff=asked["cutoff"], without=tuple(asked["without"]), drives_off=kept[1])
    recorded = json.loads((run / "result.json").read_text(encoding="utf-8"))
    # the log of a round that was cut short does not count in the result
    further = [Path(one["program"]).stem for one in recorded.get("rounds", ()) if one.get("verdict")]
    logs = [run / "excitation.mcap", *validation_logs(run), *(run / f"{name}.mcap" for name in further)]
    found = _find(robot, logs, question, console)
    return diagnosis_report(
        found.diagnosis, found.simulated, after_diagnosis(recorded, source, logs, question), recorded
    )


def _conclude(
    found: Found,
    question: GapQuestion,
    console: Console,
    publish: Callable[[dict[str, Any]], None],
    rounds: Rounds | None = None,
) -> dict[str, Any]:
    """Make the result, publish it, then plan the next motion or write the model; `rounds` are those of these logs."""
    diagnosis, simulator = found.diagnosis, found.simulator
    for warning in diagnosis.warnings:
        console.warn(warning)
    result = {**found.result, "simulation": simulation_part(diagnosis, found.simulated)}
    result |= rounds.to_dict() if rounds is not None else {}
    result |= {} if simulator is None else run_forward(diagnosis, simulator, console)
    publish(result)
    if question.next_recipe is not None:
        _plan(diagnosis, question, console, result, publish)
    elif question.out is not None and simulator is not None:
        write_simulator(diagnosis, simulator, question.out, console)
    elif question.out is not None:
        _write_model(diagnosis, question.out, console)
    return result


def _publish(found: Found, result: dict[str, Any], steps: Sequence[NextStep], *pages: Path | None) -> None:
    """Put the summary into the result, and write the pages that are asked for."""
    result["summary"] = summary(result, steps)
    if wanted := [page for page in pages if page is not None]:
        html = diagnosis_report(found.diagnosis, found.simulated, steps, result)
        for page in wanted:
            write_atomically(page, html)


def _plan(
    found: Diagnosis,
    question: GapQuestion,
    console: Console,
    result: dict[str, Any],
    publish: Callable[[dict[str, Any]], None],
) -> None:
    """Plan the next motion, then whether a known mass makes its answer clearer.

    The result is published with each of them, and with what stopped the planning.
    """
    assert question.next_recipe is not None
    assert question.out is not None
    left = "the next motion"
    try:
        load = None if question.next_payload is None else payload_of(question.next_payload)
        recipe = load_recipe(question.next_recipe)
        deadline = Deadline(console.progress, question.planning_budget)
        motion = plan_next(found, recipe, console, load=load, deadline=deadline)
        if isinstance(motion, NoMotion):
            if not motion.separates:
                console.warn(f"{motion.text}; nothing is written to {question.out}")
            result["next_experiment"] = motion.to_dict()
            publish(result)
            return
        result["next_experiment"] = planned = write_next(motion, question.out)
        left = "the motion with a known mass"
        publish(result)
        if (mass := clearer_with_mass(found, recipe, motion, console, deadline)) is not None:
            result["next_experiment"] = {**planned, "with_a_mass": mass.to_dict()}
            publish(result)
    except BaseException as error:
        result["warnings"] = [*result["warnings"], f"{left} was not planned: {words_of(error)}"]
        publish(result)
        raise


def _find(robot: RobotDescription | None, paths: Sequence[Path], question: GapQuestion, console: Console) -> Found:
    """Read logs and model, check that they fit together, diagnose and simulate."""
    reference, simulator = _simulator(robot, paths, question, console)
    described = robot is not None or simulator is None
    if reference is not None and (robot is None or reference.method == SIMULATOR):
        robot = reference.robot  # of the file, with the drives of the description
    if robot is not None and reference is not None and robot.name != reference.robot.name:
        console.warn(
            f"{question.model} is a model of {reference.robot.name}, but --robot names {robot.name}, whose "
            "nominal torques scale the errors: leave --robot out, or name a model of that arm"
        )
    if robot is None:
        raise InputError("diagnose: name the robot (--robot R), or a model that describes the arm (--model MODEL)")
    further = None if question.next_recipe is None else load_recipe(question.next_recipe)
    if further is not None:
        check_arm(further, robot)
    console.step(f"reading {counted(len(paths), 'log')}")
    logs = read_logs(list(paths), robot, console, question.topic)
    if further is not None and not question.allow_mixed:
        check_tool(further, logs, {} if reference is None else reference.provenance)
    at_rest = _at_rest(robot, reference, question, console)
    of_machine = logs if at_rest is None else [*logs, at_rest]
    check_one_machine(of_machine, reference, question.allow_mixed, payload_counts=True)
    said: tuple[str, ...] = ()
    if simulator is not None:
        simulator, logs, said = with_servo_torque(simulator, logs)
    if not said:
        check_plausible(robot, logs, question.force, console, described=described, model=reference)
    console.step("comparing model and robot")
    found = diagnose(robot, logs, reference, question.cutoff, question.without, console.progress, drives_off=at_rest)
    say_used(logs, found.dataset.cutoff, found.dataset.model.order, console)
    console.step("simulating with and without the effects")
    warnings, simulated = (*said, *found.warnings), list[Simulated]()
    try:
        simulated = simulate(found)
    except (AgentError, ArithmeticError, ValueError) as error:
        warnings += (f"the forward simulation failed; the verdict does not depend on it: {error}",)
    return Found(replace(found, document=replace(found.document, warnings=warnings)), simulated, simulator)


def _at_rest(
    robot: RobotDescription, reference: IdentifiedModel | None, question: GapQuestion, console: Console
) -> Log | None:
    """The log with the drives off, which has to show a zero; None if none is named.

    Raises:
        InputError: it cannot be read, or shows none.
    """
    if question.drives_off is None:
        return None
    (log,) = read_logs([question.drives_off], robot, console, question.topic)
    channel_zero(robot, log, reference)
    return log


def _simulator(
    robot: RobotDescription | None, paths: Sequence[Path], question: GapQuestion, console: Console
) -> tuple[IdentifiedModel | None, Simulator | None]:
    """The model to compare with, and the simulator's file that it was read from; None if none is named.

    Raises:
        InputError: a file that cannot be used, or of another arm.
    """
    if question.model is None or not is_simulator(question.model):
        if question.joint_map is not None:
            raise InputError("diagnose: --map names joints of an MJCF or URDF: give one with --model arm.xml|arm.urdf")
        return (None if question.model is None else IdentifiedModel.load(question.model)), None
    names = None if question.joint_map is None else load_joint_map(question.joint_map)
    log_joints = () if robot is not None else read_log(paths[0], topic=question.topic).joint_names
    found = load_simulator(question.model, robot, log_joints, names)
    for note in found.notes:
        console.warn(f"{question.model.name}: {note}")
    return found.model, found


def _write_model(found: Diagnosis, out: Path, console: Console) -> None:
    """Write the model with the effects found; warns of effects that no model holds."""
    model = extended_model(found)
    left_out = [c["effect"] for c in found.result["causes"] if c["effect"] not in {e.effect for e in model.effects}]
    for name in left_out:
        why = "it happened once" if CATALOGUE[name].once else "it is in the set-points only"
        console.warn(f"{out}: {name} is left out of the model: {why}")
    if not found.finding.causes:
        console.warn(f"{out}: no effect was found, so the model is unchanged")
    if len(model.effects) == len(found.dataset.model.effects):
        model = found.dataset.model
    model.save(out)
