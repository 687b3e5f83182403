"""From logs and a model to what a diagnosis found, and what it was compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from agent.core import AgentError, Console, InputError, counted
from agent.diagnosis import Diagnosis, Simulated, channel_zero, diagnose, simulate, without_torque
from agent.model import IdentifiedModel
from agent.pipeline.checked_logs import check_one_machine, check_plausible, joints_of, read_logs, say_used
from agent.pipeline.declared_effort import check_torque
from agent.pipeline.gap.diagnosis_question import GapQuestion
from agent.pipeline.gap.next_experiment import check_arm, check_tool
from agent.recipe import load_recipe
from agent.recording import Log, is_dataset, is_nameless, read_log
from agent.robot import RobotDescription
from agent.simulators import Simulator, is_simulator, load_joint_map, load_simulator


@dataclass(frozen=True, eq=False)
class DiagnosisRun:
    """A diagnosis, its simulations, and the simulator's file that was read."""

    diagnosis: Diagnosis
    simulated: Sequence[Simulated] = ()
    simulator: Simulator | None = None

    @property
    def result(self) -> dict[str, Any]:
        """That of the diagnosis."""
        return self.diagnosis.result


def run_diagnosis(
    robot: RobotDescription | None, paths: Sequence[Path], question: GapQuestion, console: Console
) -> DiagnosisRun:
    """Read logs and model, check that they fit together, diagnose and simulate."""
    reference, simulator = read_reference(robot, paths, question, console)
    described = robot is not None or simulator is None
    if reference is not None and (robot is None or reference.of_file):
        robot = reference.robot  # of the file, with the drives of the description
    if robot is not None and reference is not None and robot.name != reference.robot.name:
        console.warn(
            f"{question.model} is a model of {reference.robot.name}, but --robot names {robot.name}, whose "
            "nominal torques scale the errors: leave --robot out, or name a model of that arm"
        )
    if robot is None:
        raise InputError("diagnose: name the robot (--robot R), or a model that describes the arm (--model MODEL)")
    further = None
    if question.next_recipe is not None and not is_simulator(question.next_recipe):
        further = load_recipe(question.next_recipe)
    if further is not None:
        check_arm(further, robot)
    console.step(f"reading {counted(len(paths), 'log')}")
    logs = read_logs(list(paths), robot, console, question.topic, question.effort, question.force)
    if further is not None and not question.allow_mixed:
        check_tool(further, logs, {} if reference is None else reference.provenance)
    at_rest = read_at_rest(robot, reference, question, console)
    of_machine = logs if at_rest is None else [*logs, at_rest]
    check_one_machine(of_machine, reference, question.allow_mixed, payload_counts=True)
    by_position = simulator is not None and without_torque(simulator, logs)
    if not by_position:
        check_torque(logs)
        check_plausible(robot, logs, question.force, console, described=described, model=reference)
    console.step("comparing model and robot")
    diagnosis = diagnose(
        robot,
        logs,
        reference,
        question.cutoff,
        question.without,
        console.progress,
        drives_off=at_rest,
        simulator=simulator,
        known_kp="kp" in question.known,
    )
    if by_position:
        return DiagnosisRun(diagnosis, [], simulator)
    say_used(logs, diagnosis.dataset.cutoff, diagnosis.dataset.model.order, console)
    console.step("simulating with and without the effects")
    simulated: list[Simulated] = []
    failed = ""
    try:
        simulated = simulate(diagnosis)
    except (AgentError, ArithmeticError, ValueError) as error:
        failed = f"the forward simulation failed; the verdict does not depend on it: {error}"
    warnings = (*diagnosis.warnings, *filter(None, [failed]))
    return DiagnosisRun(
        replace(diagnosis, document=replace(diagnosis.document, warnings=warnings)), simulated, simulator
    )


def read_at_rest(
    robot: RobotDescription, reference: IdentifiedModel | None, question: GapQuestion, console: Console
) -> Log | None:
    """The log with the drives off, which has to show a zero; None if none is named.

    Raises:
        InputError: it cannot be read, or shows none.
    """
    if question.drives_off is None:
        return None
    (log,) = read_logs([question.drives_off], robot, console, question.topic, question.effort, question.force)
    channel_zero(robot, log, reference)
    return log


def read_reference(
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
    if robot is not None:
        log_joints: tuple[str, ...] = ()
    elif is_dataset(paths[0]):
        log_joints = joints_of(paths[0], question.model, question.topic)
    else:
        log_joints = read_log(paths[0], topic=question.topic).joint_names
        if is_nameless(log_joints):
            log_joints = joints_of(paths[0], question.model, question.topic)
    simulator = load_simulator(question.model, robot, log_joints, names)
    for note in simulator.notes:
        console.warn(f"{question.model.name}: {note}")
    return simulator.model, simulator
