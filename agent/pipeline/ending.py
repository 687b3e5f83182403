"""End of a run in words: the robot's current model, and the next command."""

from __future__ import annotations

import os
import shlex
from pathlib import Path

from agent.core import InputError, MismatchError
from agent.pages import NextStep
from agent.recipe import Recipe
from agent.runs import RunFolder, current_model

_LOGS = Path("logs")


def current_run(logs: Path, robot: str, serial: str) -> str | None:
    """Name of the run whose model is the robot's current one; None where there is none that can be read."""
    try:
        current = current_model(logs, robot, serial)
    except InputError:  # reported by the commands that use the model itself
        return None
    return None if current is None else current.run


def ending_text(run: RunFolder, recipe: Recipe) -> str:
    """Last two lines of the summary of a complete run: the robot's current model, and the next command."""
    current = current_run(run.path.parent, run.state["robot"], run.state["serial"])
    kind, accepted = run.state["kind"], run.state["status"] == "finished"
    steps = next_steps(kind, accepted, run.path, recipe, recipe.path, current)
    following = "; ".join(f"{step.what} {step.command}" for step in steps)
    return f"{'current model':20}{current_model_text(current, run.path.name)}\n{'next':20}{following}"


def current_model_text(current: str | None, run: str) -> str:
    """The current model in words, as seen from one run."""
    if current is None:
        return "none yet: no accepted run of this robot"
    return "this run" if current == run else f"unchanged (run {current})"


def next_steps(kind: str, accepted: bool, run: Path, recipe: Recipe, path: Path, current: str | None) -> list[NextStep]:
    """Commands that may follow a complete run.

    `path` is the recipe as the commands name it, `current` the run of the robot's current model.

    Args:
        kind: of the run.
        accepted: whether its gate passed.
        run: its folder.
        recipe: the recipe in it.
        path: of the recipe as commands name it.
        current: run of the current model; None: none.
    """
    logs = run.parent
    where = "" if logs == _LOGS else f" --logs {shlex.quote(str(logs))}"
    name, job = run.name, shlex.quote(str(path))
    apply = NextStep("to make this model the current one:", f"agent apply {name}{where}")
    if kind != "diagnose" and accepted:
        if current == name:
            repeat = NextStep("to repeat this automatically:", f"agent schedule {job}{where}")
            return [NextStep("when it is due:", f"agent recalibrate {job}{where}"), repeat]
        compare = NextStep("to see what changed:", f"agent compare {current} {name}{where}")
        return [apply] if current is None else [compare, apply]
    calibrate = f"agent calibrate {job}{where}"
    if kind == "calibrate":
        folder = shlex.quote(str(run))
        logs_of = f"--model {folder}/model.json {folder}/validation_*.mcap"
        diagnose = f"agent diagnose --robot {shlex.quote(recipe.robot_source)} {logs_of}"
        return [NextStep("to find the reason:", diagnose)]
    if kind == "recalibrate":
        return [NextStep("after fixing what the report names:", calibrate)]
    return [NextStep("to list earlier results:", f"agent history{where}"), NextStep("after a repair:", calibrate)]


def resume_advice(run: RunFolder, step: str, error: BaseException) -> str:
    """What a run that an error stopped in a step has kept, and the command that goes on.

    The command repeats the `options` noted in the run, but not `--yes`. A calibration is resumed, unless its recipe was
    refused. A diagnosis whose motions are all recorded needs no robot.
    """
    motions = [name for name in run.state["steps"] if name.endswith(".mcap")]
    recorded_text = f", {len(motions)} of its motions are recorded" if motions else ""
    kind, recipe, logs = run.state["kind"], os.path.relpath(run.state["recipe"]), run.path.parent
    options = run.state.get("options", [])
    words = ["agent", kind, *(["--record"] if kind == "diagnose" else []), recipe]
    words += [] if logs == _LOGS else ["--logs", str(logs)]
    words += options
    refused = isinstance(error, InputError | MismatchError) and run.finished("plan") is None
    if kind == "calibrate" and not refused:
        again = f"continue with: {shlex.join([*words, '--resume', run.path.name])}"
    else:
        again = f"start again with: {shlex.join(words)}"
    if kind == "diagnose" and run.finished("record") is not None:
        options = options[: options.index("--until-sure")] if "--until-sure" in options else options
        recorded = [str(run.file(name)) for name in motions]
        offline = ["agent", "diagnose", "--robot", run.state["robot_source"], *options, *recorded]
        again = f"diagnose them with: {shlex.join(offline)}; or {again}"
    return f"stopped in the step {step!r}; finished steps are in {run.path}{recorded_text}; {again}"
