"""How a run ends for whoever started it: the robot's current model, and the command that comes next."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

from agent.core import InputError, MismatchError
from agent.recipe import Recipe
from agent.runs import RunFolder, current_model

_LOGS = Path("logs")


def current_run(logs: Path, robot: str, serial: str) -> str | None:
    """Name of the run whose model is the robot's current one; None where there is none that can be read."""
    try:
        current = current_model(logs, robot, serial)
    except InputError:  # said wherever somebody asks for the model itself
        return None
    return None if current is None else current.run


def ending(run: RunFolder, recipe: Recipe) -> dict[str, Any]:
    """Of a complete run: `current_model`, the run that the robot's current model is of, and `next`, a command."""
    current = current_run(run.path.parent, run.state["robot"], run.state["serial"])
    kind, accepted = run.state["kind"], run.state["status"] == "finished"
    steps = next_steps(kind, accepted, run.path, recipe, recipe.path, current)
    return {"current_model": current, "next": "; ".join(f"{what} {command}" for command, what in steps)}


def ending_text(run: RunFolder, recipe: Recipe) -> str:
    """The same as the last two lines of a summary."""
    end = ending(run, recipe)
    return f"{'current model':20}{whose(end['current_model'], run.path.name)}\n{'next':20}{end['next']}"


def whose(current: str | None, run: str) -> str:
    """The current model in words, seen from one run."""
    if current is None:
        return "none yet: no accepted run of this robot"
    return "this run" if current == run else f"unchanged (run {current})"


def next_steps(
    kind: str, accepted: bool, run: Path, recipe: Recipe, path: Path, current: str | None
) -> list[tuple[str, str]]:
    """Commands that may come after a complete run, and what each is for.

    `path` is what they call the recipe, `current` the run that the robot's current model is of.
    """
    logs = run.parent
    where = "" if logs == _LOGS else f" --logs {shlex.quote(str(logs))}"
    name, job = run.name, shlex.quote(str(path))
    if kind != "diagnose" and accepted and current == name:
        return [
            (f"agent recalibrate {job}{where}", "when it is due:"),
            (f"agent schedule {job}{where}", "to repeat this automatically:"),
        ]
    apply = f"agent apply {name}{where}"
    if kind != "diagnose" and accepted and current is None:
        return [(apply, "to make this model the current one:")]
    if kind != "diagnose" and accepted:
        compare = f"agent compare {current} {name}{where}"
        return [(compare, "to see what changed:"), (apply, "to make this model the current one:")]
    calibrate = f"agent calibrate {job}{where}"
    if kind == "calibrate":
        folder = shlex.quote(str(run))
        logs_of = f"--model {folder}/model.json {folder}/validation_*.mcap"
        return [(f"agent diagnose --robot {shlex.quote(recipe.robot_source)} {logs_of}", "to find the reason:")]
    if kind == "recalibrate":
        return [(calibrate, "after fixing what the report names:")]
    return [(f"agent history{where}", "to list earlier results:"), (calibrate, "after a repair:")]


def going_on(run: RunFolder, step: str, error: BaseException) -> str:
    """What a run that an error stopped in a step has kept, and how it goes on.

    The command is the one that started it, with the `options` that the run notes; how much is shown, and whether the
    cell is clear (`--yes`), is for whoever starts it again. A calibration is gone on with, unless it was refused for
    its recipe: with another one it is another run. Motions that were to be diagnosed, and are all recorded, can be
    without the robot.
    """
    motions = [name for name in run.state["steps"] if name.endswith(".mcap")]
    kept = f", {len(motions)} of its motions are recorded" if motions else ""
    kind, recipe, logs = run.state["kind"], os.path.relpath(run.state["recipe"]), run.path.parent
    words = ["agent", kind, *(["--record"] if kind == "diagnose" else []), recipe]
    words += [] if logs == _LOGS else ["--logs", str(logs)]
    words += run.state.get("options", [])
    refused = isinstance(error, InputError | MismatchError) and run.finished("plan") is None
    if kind == "calibrate" and not refused:
        again = f"continue with: {shlex.join([*words, '--resume', run.path.name])}"
    else:
        again = f"start again with: {shlex.join(words)}"
    if kind == "diagnose" and run.finished("record") is not None:
        again = f"diagnose them with: {shlex.join(_of_logs(run, motions))}; or {again}"
    return f"stopped in the step {step!r}; finished steps are in {run.path}{kept}; {again}"


def _of_logs(run: RunFolder, motions: list[str]) -> list[str]:
    """The words of a diagnosis of motions that a run has recorded."""
    options = run.state["options"]
    options = options[: options.index("--until-sure")] if "--until-sure" in options else options
    robot, logs = run.state["robot_source"], (str(run.file(name)) for name in motions)
    return ["agent", "diagnose", "--robot", robot, *options, *logs]
