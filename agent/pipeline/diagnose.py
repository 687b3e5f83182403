"""From files, or from a robot, to a diagnosis, and what it says to people."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core.console import Console
from agent.core.errors import InputError
from agent.pipeline.corrected_simulator import check_simulator_out, run_forward, write_simulator
from agent.pipeline.identify import check_one_machine, check_output, check_plausible, read_logs, say_used
from agent.robot import RobotDescription, load_robot

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.diagnosis.forward import Simulated
    from agent.model.identified import IdentifiedModel
    from agent.model.simulators import Simulator

#: The model that was the simulator, as a run folder keeps it: the file that was named may be another one later.
_SIMULATOR = "simulator.json"
#: Slow motions beside the excitation loop: enough to hold one out, few enough to wait for.
_VALIDATION_MOTIONS = 3

_VERDICTS = {
    "no_gap": "no gap: nothing of practical size beyond what the model's own prediction error allows",
    "explained": "explained",
    "ambiguous": "ambiguous: the data cannot tell the first cause from its equivalents",
    "unknown": "unknown: there is a gap, and no effect of the catalogue closes it",
}


@dataclass(frozen=True)
class Question:
    """What is asked of logs: against which model (None: one fitted to them), what is left out, what is written.

    `model` is a model file, an MJCF or a URDF; `joint_map` says how joints of the latter two are called in the logs.
    `report` is the page, `out` the file of the model with the effects found, or of the simulator corrected (its own
    format); None: neither. `allow_mixed`: logs and
    model may be of several machines or tools; `force`: go on although a log is implausible.
    """

    model: Path | None = None
    joint_map: Path | None = None
    cutoff: float | None = None
    without: tuple[str, ...] = ()
    report: Path | None = None
    out: Path | None = None
    allow_mixed: bool = False
    force: bool = False


def diagnose_files(robot: str | None, paths: Sequence[Path], question: Question, console: Console) -> dict[str, Any]:
    """Diagnose logs; returns the result of docs/diagnosis.md, and writes what is asked for.

    Without a `robot` the model says what the arm is.

    Raises:
        InputError: a robot, model or log that cannot be used, an unknown effect, or an output that cannot be written.
    """
    return _diagnose(None if robot is None else load_robot(robot), paths, question, console, robot)


def diagnose_recording(recipe: Path, question: Question, console: Console, runs: Path, yes: bool) -> dict[str, Any]:
    """Record the recipe's motions into a run folder, then diagnose them; result and report are in the folder too.

    Raises:
        AgentError, DriverError: as in `agent calibrate`, before anything moves or after a controlled stop.
    """
    from agent.pipeline import planning
    from agent.pipeline.calibrate import step
    from agent.pipeline.ending import ending_text
    from agent.pipeline.record_plan import record_plan
    from agent.pipeline.reports import refresh_index
    from agent.recipe import load_recipe
    from agent.runs.approved import approve
    from agent.runs.folder import RunFolder, write_atomically
    from agent.runs.lock import robot_lock

    loaded = load_recipe(recipe)
    _check(question, [])
    reference, simulator = _simulator(loaded.robot, [], question, console)
    few = min(loaded.validate.motions, _VALIDATION_MOTIONS)
    loaded = replace(loaded, validate=loaded.validate.model_copy(update={"motions": few}))
    with robot_lock(loaded.controller.driver, loaded.controller.address):
        run = RunFolder.create(runs, loaded.robot.name, loaded.path)
        run.note(kind="diagnose", question={"cutoff": question.cutoff, "without": question.without})
        approve(run, loaded)
        if reference is not None:
            run.write_text(_SIMULATOR, json.dumps(reference.to_dict(), allow_nan=False))
            question = replace(question, model=run.file(_SIMULATOR), joint_map=None)
        console.say(f"run {run.path}")
        with step(run, "plan", console):
            plan = planning.plan_once(loaded, run, console)
        with step(run, "record", console):
            recordings = record_plan(loaded, plan, run, console, runs, yes)
        with step(run, "diagnose", console):
            report = run.file("report.html")
            here = replace(question, report=report)
            recorded = [recording.path for recording in recordings]
            result = _diagnose(loaded.robot, recorded, here, console, loaded.robot_source, simulator)
            run.write_json("result.json", result)
            if question.report is not None:
                write_atomically(question.report, report.read_text(encoding="utf-8"))
        run.complete(True)
        refresh_index(runs, console)
    console.say(ending_text(run, loaded))
    return result


def diagnose_again(run: Path, robot: RobotDescription, source: str, console: Console) -> str:
    """HTML of the page of a recorded diagnosis, from the run's files; `source` is what names the robot.

    Raises:
        InputError: a log or the model cannot be read.
        KeyError: the run does not say what was asked.
    """
    from agent.pipeline.first_screen import after_diagnosis
    from agent.report.diagnosis_page import diagnosis_report

    asked = json.loads((run / "state.json").read_text(encoding="utf-8"))["question"]
    model = run / _SIMULATOR
    question = Question(model if model.exists() else None, cutoff=asked["cutoff"], without=tuple(asked["without"]))
    logs = [run / "excitation.mcap", *sorted(run.glob("validation_[0-9][0-9].mcap"))]
    found, simulated, _ = _find(robot, logs, question, console)
    return diagnosis_report(found, simulated, next_steps=after_diagnosis(found.result, source, logs, question.model))


def _diagnose(
    robot: RobotDescription | None,
    paths: Sequence[Path],
    question: Question,
    console: Console,
    source: str | None,
    simulator: Simulator | None = None,
) -> dict[str, Any]:
    """`source` names the robot for whoever asks again; `simulator` is the file that was read, and checked, before."""
    from agent.diagnosis import simulation_part

    if simulator is None:
        _check(question, paths)
    found, simulated, read = _find(robot, paths, question, console)
    simulator = simulator or read
    for warning in found.warnings:
        console.warn(warning)
    result = {**found.result, "simulation": simulation_part(found, simulated)}
    if simulator is not None:
        result |= run_forward(found, simulator, console)
    if question.report is not None:
        from agent.pipeline.first_screen import after_diagnosis
        from agent.report.diagnosis_page import diagnosis_report
        from agent.runs.folder import write_atomically

        steps = after_diagnosis(found.result, source, paths, question.model)
        page = diagnosis_report(found, simulated, result.get("forward"), steps)
        write_atomically(question.report, page)
    if question.out is not None:
        if simulator is not None:
            write_simulator(found, simulator, question.out, console)
        else:
            _write_model(found, question.out, console)
    return result


def _find(
    robot: RobotDescription | None, paths: Sequence[Path], question: Question, console: Console
) -> tuple[Diagnosis, list[Simulated], Simulator | None]:
    from agent.diagnosis import diagnose, simulate
    from agent.model.simulators import SIMULATOR

    reference, simulator = _simulator(robot, paths, question, console)
    if reference is not None and (robot is None or reference.method == SIMULATOR):
        robot = reference.robot  # of the file, with the drives of the description
    if robot is None:
        raise InputError("diagnose: name the robot (--robot R), or a model that says what the arm is (--model MODEL)")
    console.step(f"reading {len(paths)} logs")
    logs = read_logs(list(paths), robot, console)
    check_one_machine(logs, reference, question.allow_mixed)
    check_plausible(robot, logs, question.force, console)
    console.step("searching for what model and robot disagree in")
    found = diagnose(robot, logs, reference, question.cutoff, question.without, console.progress)
    say_used(logs, found.dataset.cutoff, found.dataset.model.order, console)
    console.step("simulating with and without it")
    return found, simulate(found), simulator


def _simulator(
    robot: RobotDescription | None, paths: Sequence[Path], question: Question, console: Console
) -> tuple[IdentifiedModel | None, Simulator | None]:
    """The model that is the simulator, and the file that it was read from; None where none is named.

    Raises:
        InputError: a file that cannot be used, or of another arm.
    """
    from agent.model.identified import IdentifiedModel
    from agent.model.simulators import is_simulator, load_joint_map, load_simulator
    from agent.recording import read_log

    if question.model is None or not is_simulator(question.model):
        if question.joint_map is not None:
            raise InputError("diagnose: --map names joints of an MJCF or URDF: give one with --model arm.xml|arm.urdf")
        return (None if question.model is None else IdentifiedModel.load(question.model)), None
    names = None if question.joint_map is None else load_joint_map(question.joint_map)
    log_joints = () if robot is not None else read_log(paths[0]).joint_names
    found = load_simulator(question.model, robot, log_joints, names)
    for note in found.notes:
        console.warn(f"{question.model.name}: {note}")
    return found.model, found


def _check(question: Question, logs: Sequence[Path]) -> None:
    """What makes no sense is refused before the work, and before anything moves.

    Raises:
        InputError: an output that cannot be written or would overwrite an input, an unknown effect, or no model.
    """
    from agent.diagnosis import check_effects

    check_effects(question.without)
    inputs = [*logs, *(path for path in (question.model, question.joint_map) if path)]
    for out in (question.report, question.out):
        if out is not None:
            check_output(out, inputs)
    if question.out is not None:
        check_simulator_out(question.model, question.out, inputs)


def _write_model(found: Diagnosis, out: Path, console: Console) -> None:
    """The model with the effects found; what cannot be part of a model is said."""
    from agent.diagnosis import extended_model

    model = extended_model(found)
    left_out = [c["effect"] for c in found.result["causes"] if c["effect"] not in {e.effect for e in model.effects}]
    if left_out:
        console.warn(
            f"{out}: {' and '.join(left_out)} is left out of the model: it happens once, or in the set-points only"
        )
    if not found.finding.causes:
        console.warn(f"{out}: no effect was found, so nothing is added to the model")
        model = found.dataset.model
    model.save(out)


def diagnosis_text(result: dict[str, Any]) -> str:
    """A diagnosis for people."""
    from agent.diagnosis.labels import closes, torque_gap
    from agent.diagnosis.sizes import size_text, told
    from agent.robot.torque_figures import SHARE, figure_text

    lines = [_VERDICTS[result["verdict"]]]
    for cause in result["causes"]:
        joints = ", ".join(cause["joints"]) or "the whole arm"
        closed = f", {closes(cause)}" if closes(cause) else ""
        lines.append(f"  {cause['effect']} on {joints}{closed}, probability {cause['probability']:.2f}")
        sizes = (f"{key} {size_text(cause['effect'], key, cause['parameters'][key], None)}" for key in told(cause))
        parameters = "  ".join(sizes)
        lines.append(f"    {parameters}")
        for other in cause["equivalent_to"]:
            lines.append(f"    as good: {other['effect']} on {', '.join(other['joints']) or 'the whole arm'}")
    gap = result["gap"]
    lines.append("torque error held out, in % of nominal torque where there is one; floor: what no cycle repeats")
    lines.append(f"{'joint':12} {'before':>11} {'after':>11} {'floor':>11} {'share':>7}   mostly in")
    shares = {entry["joint"]: entry for entry in result["where"]}
    somewhere = torque_gap(result)
    for k, name in enumerate(gap["joints"]):
        before, after, floor = (
            "-" if gap[side] is None else figure_text(gap[side][k], gap["units"][k])
            for side in ("before", "after", "floor")
        )
        regimes = [r["name"] for r in shares[name]["regimes"] if somewhere and r["share"] > 1.5 * r["of_samples"]][:2]
        share = f"{100 * shares[name]['share']:6.1f}%" if somewhere else f"{'-':>7}"
        lines.append(f"{name:12} {before:>11} {after:>11} {floor:>11} {share}   {', '.join(regimes)}".rstrip())
    if result["closure"] is not None and somewhere:
        lines.append(f"closed: {100 * result['closure']:.1f} % of the gap in torque")
    lines += list(_waterfall_lines(result.get("waterfall", [])))
    if result.get("simulation"):
        torque, units = result["simulation"]["torque"], gap["units"]
        worst = max(range(len(units)), key=lambda k: (units[k] == SHARE, torque["before"][k]))
        before, after = (figure_text(torque[side][worst], units[worst]) for side in ("before", "after"))
        lines.append(f"torque error of {gap['joints'][worst]} in forward simulation: {before}, then {after}")
    if result.get("forward"):
        from agent.diagnosis.forward_windows import forward_lines

        lines += list(forward_lines(result["forward"]))
    if result["next_experiment"] is not None:
        lines.append(f"run next: {result['next_experiment']['motion']}")
    if result["not_testable"]:
        names = sorted({entry["effect"] for entry in result["not_testable"]})
        lines.append(f"not testable on some joints here: {', '.join(names)}")
    return "\n".join(lines)


def _waterfall_lines(steps: Sequence[dict[str, Any]]) -> Iterator[str]:
    """A bar for what each step closes of the held-out gap, in the order found."""
    if not steps:
        return
    yield "what closes the gap of the simulator, in the order found, held out (90 % interval), and alone"
    width = max(len(entry["step"]) for entry in steps)
    for entry in steps:
        closes, (low, high) = 100 * entry["closes"], entry["interval"]
        alone = "" if entry["alone"] is None else f"{100 * entry['alone']:6.1f} %"
        bar = "#" * round(max(closes, 0) * 0.3)
        inside = f"({100 * low:5.1f} to {100 * high:5.1f})"
        yield f"  {entry['step']:{width}} {closes:6.1f} % {inside} {alone:>9}  {bar}".rstrip()
