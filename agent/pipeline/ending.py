"""How a run ends for whoever started it: the robot's current model, and the command that comes next."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

from agent.core import InputError
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
    return {"current_model": current, "next": "; ".join(f"{command} {what}" for command, what in steps)}


def ending_text(run: RunFolder, recipe: Recipe) -> str:
    """The same as the last two lines of a summary."""
    end = ending(run, recipe)
    return f"{'current model':20}{whose(end['current_model'], run.path.name)}\n{'next':20}{end['next']}"


def whose(current: str | None, run: str) -> str:
    """The current model in words, beside one run."""
    if current is None:
        return "none yet: no accepted run of this robot"
    return "that of this run" if current == run else f"that of {current}, not of this run"


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
            (f"agent recalibrate {job}{where}", "when it is due"),
            (f"agent schedule {job}{where}", "sets up a timer"),
        ]
    apply = f"agent apply {name}{where}"
    if kind != "diagnose" and accepted and current is None:
        return [(apply, "makes this model the current one")]
    if kind != "diagnose" and accepted:
        compare = f"agent compare {current} {name}{where}"
        return [(compare, "says what changed"), (apply, "makes this model the current one")]
    calibrate = f"agent calibrate {job}{where}"
    if kind == "calibrate":
        folder = shlex.quote(str(run))
        logs_of = f"--model {folder}/model.json {folder}/validation_*.mcap"
        return [(f"agent diagnose --robot {recipe.robot_source} {logs_of}", "says why")]
    if kind == "recalibrate":
        return [(calibrate, "after what the report names is mended")]
    return [(f"agent history{where}", "lists what was found before"), (calibrate, "after a repair")]


def going_on(run: RunFolder, step: str) -> str:
    """What a run that stopped in a step has kept, and how it goes on."""
    motions = [name for name in run.state["steps"] if name.endswith(".mcap")]
    kept = f", {len(motions)} of its motions are recorded" if motions else ""
    recipe = shlex.quote(os.path.relpath(run.state["recipe"]))
    logs = run.path.parent
    where = "" if logs == _LOGS else f" --logs {shlex.quote(str(logs))}"
    budget = run.state.get("question", {}).get("budget")
    rounds = "" if budget is None else f" --until-sure --budget '{budget:g} s'"
    again = {
        "calibrate": f"go on with: agent calibrate {recipe}{where} --resume {run.path.name}",
        "recalibrate": f"start again with: agent recalibrate {recipe}{where}",
        "diagnose": f"start again with: agent diagnose --record {recipe}{where}{rounds}",
    }[run.state["kind"]]
    return f"stopped in the step {step!r}; what was finished is kept in {run.path}{kept}; {again}"
