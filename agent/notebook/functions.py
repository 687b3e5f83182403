"""Functions for notebooks. Robots, logs, models and recipes are paths or loaded objects."""

from __future__ import annotations

import glob
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

from agent import diagnosis, pipeline, recipe as recipes, simulators
from agent.core import InputError, write_atomically
from agent.model import CATALOGUE, IdentifiedModel
from agent.notebook.results import Calibration, GapDiagnosis, Listing, Logs, Model, PlannedLoop, TorqueValidation, quiet
from agent.pages import Page, Section, diagnosis_report, parameters_section, render, residual_section
from agent.recipe import Recipe
from agent.recording import Log
from agent.robot import RobotDescription
from agent.runs import check_output, find_run
from agent.validation import predict_log
from drivers.registry import available

RobotLike = RobotDescription | str | Path
LogsLike = Log | str | Path | Iterable[Log | str | Path]
ModelLike = IdentifiedModel | str | Path


def load_robot(robot: RobotLike) -> RobotDescription:
    """A robot description: a built-in name, or the path of a robot.yaml, a URDF or an MJCF.

    Raises:
        InputError: no such robot, or a file that is wrong.
    """
    return robot if isinstance(robot, RobotDescription) else pipeline.load_arm(str(robot))


def load_recipe(recipe: Recipe | str | Path) -> Recipe:
    """A recipe file, checked, with the robot it names.

    Raises:
        InputError: every fault with its line.
    """
    return recipes.load_recipe(recipe) if isinstance(recipe, (str, Path)) else recipe


def read_logs(logs: LogsLike, robot: RobotLike) -> Logs:
    """Logs of a robot: a path, a pattern ("logs/*.mcap"), loaded logs, or several of these.

    Raises:
        InputError: nothing matches, or a file that cannot be read as a log of this robot.
    """
    description = load_robot(robot)
    opened: list[Log] = []
    for source in [logs] if isinstance(logs, (str, Path, Log)) else logs:
        opened += [source] if isinstance(source, Log) else pipeline.read_logs(_paths(source), description, quiet())
    return Logs(opened)


def estimate(
    robot: RobotLike,
    logs: LogsLike,
    method: str | None = None,
    cutoff: float | None = None,
    *,
    allow_mixed: bool = False,
    force: bool = False,
) -> Model:
    """Identify base parameters and friction from logs, as `agent estimate` does; `cutoff` in Hz.

    Args:
        robot: description, its name or file.
        logs: in memory, or paths and patterns of files.
        method: weighted, paper, consistent or another of `agent estimate --method`.
        cutoff: of the torque filter [Hz]; None: chosen from the logs.
        allow_mixed: take logs of several machines or tools.
        force: go on although a log is implausible.

    Raises:
        InputError: logs that cannot be used, of several machines (unless `allow_mixed`), or an unknown method.
        RejectedError: logs that no motion of this robot can have made, or with too little of it, unless `force`.
    """
    question = pipeline.FitQuestion(cutoff, method, allow_mixed=allow_mixed, force=force)
    description = load_robot(robot)
    return Model.of(pipeline.fit_logs(description, read_logs(logs, description), question, quiet())[0])


def validate(
    model: ModelLike, logs: LogsLike, cutoff: float | None = None, *, allow_mixed: bool = False
) -> TorqueValidation:
    """Predict the torque of logs that took no part in the fit.

    Args:
        model: in memory, or its file.
        logs: in memory, or paths and patterns of files.
        cutoff: of the torque filter [Hz]; None: the model's.
        allow_mixed: take logs of several machines or tools.

    Raises:
        InputError: a model or log that cannot be used, or (unless `allow_mixed`) logs of another machine.
    """
    known = _model(model)
    recorded = read_logs(logs, known.robot)
    if not recorded:
        raise InputError("no logs were given, so there is nothing to validate on")
    pipeline.check_one_machine(recorded, known, allow_mixed)
    return TorqueValidation(tuple(predict_log(known, log, cutoff) for log in recorded))


def diagnose(
    robot: RobotLike,
    logs: LogsLike,
    model: ModelLike | None = None,
    cutoff: float | None = None,
    without: Sequence[str] = (),
    *,
    allow_mixed: bool = False,
    force: bool = False,
) -> GapDiagnosis:
    """Where model and robot disagree and why; without a model, against one fitted to the same logs.

    Args:
        robot: description, its name or file.
        logs: in memory, or paths and patterns of files.
        model: to compare with, in memory or its file; None: one fitted to the logs.
        cutoff: of the torque filter [Hz]; None: chosen from the logs.
        without: effects to ignore.
        allow_mixed: take logs of several machines or tools.
        force: go on although a log is implausible.

    Raises:
        InputError: as in `estimate`, or an unknown effect in `without`.
        RejectedError: as in `estimate`.
    """
    description, reference = load_robot(robot), None if model is None else _model(model)
    recorded = read_logs(logs, description)
    pipeline.check_one_machine(recorded, reference, allow_mixed, payload_counts=True)
    pipeline.check_plausible(description, recorded, force, quiet(), model=reference)
    return GapDiagnosis(diagnosis.diagnose(description, recorded, reference, cutoff, without))


def report(result: GapDiagnosis | TorqueValidation | Calibration | str | Path, out: str | Path | None = None) -> Path:
    """Write the page of a diagnosis or a validation to `out`; of a calibration or a run folder, make it again there.

    Raises:
        InputError: `out` is missing or cannot be written, or the run folder is not complete.
    """
    if isinstance(result, (Calibration, str, Path)):
        return pipeline.rebuild_report(result.run if isinstance(result, Calibration) else Path(result), quiet())
    if out is None:
        raise InputError("report: name the page to write, as in report(result, 'page.html')")
    check_output(Path(out), [])
    return write_atomically(Path(out), _page(result))


def export(model: ModelLike, folder: str | Path) -> tuple[Path, ...]:
    """Write URDF, MuJoCo model and friction file of a model with physical links; returns their paths.

    What the files do not have of the model is issued as a warning.

    Raises:
        RejectedError: no physical links have the model's base parameters; fit with method="consistent".
    """
    return simulators.export_model(_model(model), Path(folder), warnings.warn)


def plan(recipe: Recipe | str | Path, folder: str | Path | None = None) -> PlannedLoop:
    """Search for the via-points of a recipe and write program, plan and page into a new folder. Opens no port.

    Raises:
        InputError: the recipe is wrong, out of reach, or the folder holds a plan.
    """
    loaded = load_recipe(recipe)
    return PlannedLoop(pipeline.plan_recipe(loaded, Path(folder or f"{loaded.path.stem}_plan"), quiet()))


def calibrate(
    recipe: Recipe | str | Path, logs: str | Path = "logs", resume: str | Path | None = None, *, yes: bool = False
) -> Calibration:
    """The whole job on the recipe's controller: the robot moves. `yes` answers the question before its first motion.

    Args:
        recipe: or its path.
        logs: folder of runs.
        resume: run to go on with; None: a new one.
        yes: answer to the question before the first motion.

    Raises:
        AgentError, DriverError: as `agent calibrate`, before anything moves or after a controlled stop.
    """
    stopped = None if resume is None else find_run(Path(logs), str(resume))
    return Calibration(pipeline.run_calibration(load_recipe(recipe), quiet(), Path(logs), stopped, yes))


def effects() -> Listing:
    """The effects that a diagnosis looks for, by name."""
    return Listing("effects", CATALOGUE, {name: effect.signature for name, effect in CATALOGUE.items()})


def drivers() -> Listing:
    """The drivers that recipes may name: built-in ones and those of installed packages."""
    names = {name: f"`controller: {{driver: {name}}}` in a recipe" for name in available()}
    return Listing("drivers", names, names)


def _paths(pattern: str | Path) -> list[Path]:
    """Files that a path or a pattern names.

    Raises:
        InputError: none.
    """
    text = str(pattern)
    if Path(text).exists() or not glob.has_magic(text):
        return [Path(text)]
    matching = sorted(Path(name) for name in glob.glob(text, recursive=True))
    if not matching:
        raise InputError(f"{text}: no file is named like that")
    return matching


def _model(model: ModelLike) -> IdentifiedModel:
    return IdentifiedModel.load(model) if isinstance(model, (str, Path)) else model


def _page(result: GapDiagnosis | TorqueValidation) -> str:
    if isinstance(result, GapDiagnosis):
        return diagnosis_report(result.diagnosis, diagnosis.simulate(result.diagnosis))
    model = result.predictions[0].model
    sections = (
        Section("Prediction", listing=result.text()),
        residual_section(result.predictions),
        parameters_section(model.rows(), model.notes),
    )
    headline = " ".join([*model.too_little_motion, result.headline()])
    return render(Page(f"Torque of {model.robot.name}", headline, "plain", sections))
