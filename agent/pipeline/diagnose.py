"""From files, or from a robot, to a diagnosis, and what it says to people."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Any

from agent.core import AgentError, Console, InputError, counted, words_of
from agent.pipeline.corrected_simulator import run_forward, write_simulator
from agent.pipeline.gap_question import GapQuestion
from agent.pipeline.identify import check_one_machine, check_plausible, load_arm, read_logs, say_used
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.model import IdentifiedModel
    from agent.pipeline.until_sure import Found, Rounds
    from agent.recording import Log
    from agent.simulators import Simulator


#: The model that was the simulator, as a run folder keeps it: the file that was named may be another one later.
_SIMULATOR = "simulator.json"
_DRIVES_OFF = "drives_off.mcap"
#: Slow motions beside the excitation loop: enough to hold one out, few enough to wait for.
_VALIDATION_MOTIONS = 3


def diagnose_files(
    robot: str | RobotDescription | None,
    paths: Sequence[Path],
    question: GapQuestion,
    console: Console,
    told: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """Diagnose logs; returns the result of docs/diagnosis.md, and writes what is asked for.

    Without a `robot` the model says what the arm is. `told` is called with the result, once the page is written: before
    a further motion is planned, after that, and where the planning fails or is stopped.

    Raises:
        InputError: a robot, model or log that cannot be used, an unknown effect, or an output that cannot be written.
    """
    if robot is None or isinstance(robot, str):
        there = None if robot is None else load_arm(robot, paths, question.topic)
        return _diagnose(there, paths, question, console, robot, told=told)
    return _diagnose(robot, paths, question, console, robot.name, told=told)


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

    With a `budget` [s of motion], what is left open is asked of further motions until it is settled (`until_sure`).
    `told` is called as by `diagnose_files`, once the result is in the run folder; also where rounds are cut short.

    Raises:
        AgentError, DriverError: as in `agent calibrate`, before anything moves or after a controlled stop.
    """
    from agent.core import write_atomically
    from agent.pipeline import planning
    from agent.pipeline.calibrate import step
    from agent.pipeline.ending import ending_text
    from agent.pipeline.record_plan import record_plan
    from agent.pipeline.reports import refresh_index
    from agent.pipeline.until_sure import options_of, until_sure
    from agent.recipe import load_recipe
    from agent.runs import RunFolder, approve, robot_lock

    loaded = load_recipe(recipe)
    question.check([])
    reference, simulator = _simulator(loaded.robot, [], question, console)
    _at_rest(loaded.robot, reference, question, console)
    few = min(loaded.validate.motions, _VALIDATION_MOTIONS)
    loaded = replace(loaded, validate=loaded.validate.model_copy(update={"motions": few}))
    with robot_lock(loaded.controller.driver, loaded.controller.address):
        run = RunFolder.create(runs, loaded.robot.name, loaded.path)
        run.note(kind="diagnose", robot_source=loaded.robot_source)
        run.note(question={"cutoff": question.cutoff, "without": question.without, "budget": budget})
        run.note(options=[*question.options(), *options_of(budget)])
        approve(run, loaded)
        if reference is not None:
            run.write_text(_SIMULATOR, json.dumps(reference.to_dict(), allow_nan=False))
            question = replace(question, model=run.file(_SIMULATOR), joint_map=None)
        if question.drives_off is not None:
            question = replace(question, drives_off=Path(copyfile(question.drives_off, run.file(_DRIVES_OFF))))
        console.say(f"run {run.path}")
        with step(run, "plan", console):
            plan = planning.plan_once(loaded, run, console)
        with step(run, "record", console):
            recordings = record_plan(loaded, plan, run, console, runs, yes)
        paths, rounds = [recording.path for recording in recordings], None

        def answer() -> dict[str, Any]:
            """Result and page in the run folder, of all motions that there are."""
            report = run.file("report.html")
            here = replace(question, report=report)

            def keep(result: dict[str, Any]) -> None:
                run.write_json("result.json", result)
                if question.report is not None:
                    write_atomically(question.report, report.read_text(encoding="utf-8"))
                told(result)

            return _diagnose(loaded.robot, paths, here, console, loaded.robot_source, simulator, rounds, keep)

        if budget is not None:
            with step(run, "rounds", console):
                rounds = until_sure(
                    lambda logs: _find(loaded.robot, logs, question, console),
                    paths, loaded, run, console, runs, yes, budget - sum(one.duration for one in recordings),
                    planning=question.planning_budget,
                )  # fmt: skip
                paths += rounds.logs
                if rounds.cut_short is not None:
                    more = rounds.uncounted and f"; {rounds.uncounted.name} is recorded but not counted"
                    console.say(f"result of the earlier motions: {rounds.said}{more or ''}")
                    try:
                        answer()
                        console.say(f"the full result is in {run.path}")
                    except AgentError as error:  # what cut the round short may be what forbids to write
                        console.warn(f"the result could not be saved: {error}")
                    raise rounds.cut_short
        with step(run, "diagnose", console):
            result = answer()
        run.complete(True)
        refresh_index(runs, console)
    console.say(f"{'page':20}{run.file('report.html')}\n{ending_text(run, loaded)}")
    return result


def diagnose_again(run: Path, robot: RobotDescription, source: str, console: Console) -> str:
    """HTML of the page of a recorded diagnosis, from the run's files; `source` is what names the robot.

    Raises:
        InputError: a log or the model cannot be read.
        KeyError: the run does not say what was asked.
    """
    from agent.pipeline.first_screen import after_diagnosis
    from agent.report import diagnosis_report

    asked = json.loads((run / "state.json").read_text(encoding="utf-8"))["question"]
    kept = [path if path.exists() else None for path in (run / _SIMULATOR, run / _DRIVES_OFF)]
    question = GapQuestion(kept[0], cutoff=asked["cutoff"], without=tuple(asked["without"]), drives_off=kept[1])
    recorded = json.loads((run / "result.json").read_text(encoding="utf-8"))
    # the log of a round that was cut short is none of the result's
    further = [Path(one["program"]).stem for one in recorded.get("rounds", ()) if one.get("verdict")]
    validation = sorted(run.glob("validation_[0-9][0-9].mcap"))
    logs = [run / "excitation.mcap", *validation, *(run / f"{name}.mcap" for name in further)]
    found, simulated, _ = _find(robot, logs, question, console)
    steps = after_diagnosis(recorded, source, logs, question)
    return diagnosis_report(found, simulated, steps, recorded)


def _diagnose(
    robot: RobotDescription | None,
    paths: Sequence[Path],
    question: GapQuestion,
    console: Console,
    source: str | None,
    simulator: Simulator | None = None,
    rounds: Rounds | None = None,
    told: Callable[[dict[str, Any]], None] = lambda result: None,
) -> dict[str, Any]:
    """`source` names the robot for whoever asks again; `simulator` is the file that was read, and checked, before;
    `rounds` are those of these very logs, which say already what they were found to say."""
    from agent.diagnosis import simulation_part

    if simulator is None:
        question.check(paths)
    found, simulated, read = _find(robot, paths, question, console) if rounds is None else rounds.last
    simulator = simulator or read
    for warning in found.warnings:
        console.warn(warning)
    result = {**found.result, "simulation": simulation_part(found, simulated)}
    result |= rounds.to_dict() if rounds is not None else {}
    if simulator is not None:
        result |= run_forward(found, simulator, console)
    uncounted = [rounds.uncounted] if rounds is not None and rounds.uncounted else []
    recipe = question.next_recipe if rounds is None else rounds.recipe

    def tell() -> None:
        from agent.pipeline.first_screen import after_diagnosis
        from agent.report import diagnosis_report, summary

        steps = after_diagnosis(result, source, [*paths, *uncounted], question, recipe)
        result["summary"] = summary(result, steps)
        if question.report is not None:
            from agent.core import write_atomically

            write_atomically(question.report, diagnosis_report(found, simulated, steps, result))
        told(dict(result))

    tell()
    if question.next_recipe is not None:
        _plan(found, question, console, result, tell)
    elif question.out is not None and simulator is not None:
        write_simulator(found, simulator, question.out, console)
    elif question.out is not None:
        _write_model(found, question.out, console)
    return result


def _plan(
    found: Diagnosis, question: GapQuestion, console: Console, result: dict[str, Any], tell: Callable[[], None]
) -> None:
    """Plan the motion that tells more, and tell the result with it; also with what stopped the planning."""
    try:
        for said in _next(found, question, console):
            result["next_experiment"] = said
            tell()
    except BaseException as error:
        planned = (result["next_experiment"] or {}).get("program")
        left = "the motion with a known mass" if planned else "the next motion"
        result["warnings"] = [*result["warnings"], f"{left} was not planned: {words_of(error)}"]
        tell()
        raise


def _next(found: Diagnosis, question: GapQuestion, console: Console) -> Iterator[dict[str, Any] | None]:
    """The motion that tells more, written into its folder, or what else may; None where nothing is open. Once more with
    the mass that would tell more, where one would: that takes as long again."""
    from agent.experiment import Deadline
    from agent.model import payload_of
    from agent.pipeline.next_experiment import NoMotion, mass_beside, plan_next, write_next
    from agent.recipe import load_recipe

    assert question.next_recipe is not None
    assert question.out is not None
    load = None if question.next_payload is None else payload_of(question.next_payload)
    recipe = load_recipe(question.next_recipe)
    deadline = Deadline(console.progress, question.planning_budget)
    motion = plan_next(found, recipe, console, load=load, deadline=deadline)
    if isinstance(motion, NoMotion):
        if not motion.separates:
            console.warn(f"{motion.text}; nothing is written to {question.out}")
        yield motion.to_dict()
        return
    yield (planned := write_next(motion, question.out))
    if (mass := mass_beside(found, recipe, motion, console, deadline)) is not None:
        yield {**planned, "with_a_mass": mass.to_dict()}


def _find(robot: RobotDescription | None, paths: Sequence[Path], question: GapQuestion, console: Console) -> Found:
    from agent.diagnosis import diagnose, simulate, with_servo_torque
    from agent.simulators import SIMULATOR

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
    if question.next_recipe is not None:
        from agent.pipeline.next_checks import check_arm
        from agent.recipe import load_recipe

        check_arm(load_recipe(question.next_recipe), robot)
    console.step(f"reading {counted(len(paths), 'log')}")
    logs = read_logs(list(paths), robot, console, question.topic)
    if question.next_recipe is not None and not question.allow_mixed:
        from agent.pipeline.next_checks import check_tool

        check_tool(load_recipe(question.next_recipe), logs, {} if reference is None else reference.provenance)
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
    found = replace(found, answer=replace(found.answer, warnings=(*said, *found.answer.warnings)))
    say_used(logs, found.dataset.cutoff, found.dataset.model.order, console)
    console.step("simulating with and without the effects")
    try:
        return found, simulate(found), simulator
    except (AgentError, ArithmeticError, ValueError) as error:  # that the verdict needs nothing of
        unsimulated = f"the forward simulation failed; the verdict does not depend on it: {error}"
        answer = replace(found.answer, warnings=(*found.answer.warnings, unsimulated))
        return replace(found, answer=answer), [], simulator


def _at_rest(
    robot: RobotDescription, reference: IdentifiedModel | None, question: GapQuestion, console: Console
) -> Log | None:
    """The log with the drives off, which has a zero; None where none is named.

    Raises:
        InputError: it cannot be read, or has none.
    """
    from agent.diagnosis import channel_zero

    if question.drives_off is None:
        return None
    (log,) = read_logs([question.drives_off], robot, console, question.topic)
    channel_zero(robot, log, reference)
    return log


def _simulator(
    robot: RobotDescription | None, paths: Sequence[Path], question: GapQuestion, console: Console
) -> tuple[IdentifiedModel | None, Simulator | None]:
    """The model that is the simulator, and the file that it was read from; None where none is named.

    Raises:
        InputError: a file that cannot be used, or of another arm.
    """
    from agent.model import IdentifiedModel
    from agent.recording import read_log
    from agent.simulators import is_simulator, load_joint_map, load_simulator

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
    """The model with the effects found; what cannot be part of a model is said."""
    from agent.diagnosis import extended_model
    from agent.model import CATALOGUE

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
