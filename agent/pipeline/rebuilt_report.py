"""The page of a run, made again from its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from agent.core import Console, InputError, sha256_file, write_atomically
from agent.model import IdentifiedModel
from agent.pages import LogHealth
from agent.pipeline.checked_logs import read_logs
from agent.pipeline.ending import current_run
from agent.pipeline.gap.diagnose import diagnose_again
from agent.pipeline.job import EXCITATION, validation_logs
from agent.pipeline.planning.plan import replan
from agent.pipeline.reports import calibration_page, recalibration_page
from agent.recipe import Recipe, load_recipe
from agent.recording import read_log
from agent.runs import PastRun, read_object, read_run, readable
from agent.validation import Comparison, predict_log

_AGAIN = {
    "calibrate": "`agent calibrate RECIPE --resume {}` continues it",
    "recalibrate": "`agent recalibrate RECIPE` starts a new one",
    "diagnose": "`agent diagnose --record RECIPE` starts a new one",
}


def rebuild_report(run: Path, console: Console) -> Path:
    """Make the page of a complete run from its files; returns its path. A diagnosis is computed again.

    Raises:
        InputError: the run is not complete, something the page needs is missing, or another version wrote the run.
    """
    past = read_run(run)
    if not past.complete:
        raise InputError(f"{run}: {_unfinished(run, past)}; there is nothing to report yet")
    with readable(run):
        recipe = recipe_of(run)
        if past.kind == "diagnose":
            page = diagnose_again(run, recipe.robot, recipe.robot_source, console)
        else:
            model, result = IdentifiedModel.load(run / "model.json"), read_object(run / "result.json")
            result["current_model"] = current_run(run.parent, result["robot"], result["serial"])
            make = {"calibrate": _calibration, "recalibrate": _recalibration}[past.kind]
            page = make(run, recipe, model, result, console)
    return write_atomically(run / "report.html", page)


def _unfinished(run: Path, past: PastRun) -> str:
    how = _AGAIN.get(past.kind, "start a new one").format(run)
    if past.status == "stopped":
        return f"this run stopped before its end ({past.reason}); {how}"
    return f"this run has not ended; if nothing runs any more it was killed, and {how}"


def _calibration(run: Path, recipe: Recipe, model: IdentifiedModel, result: dict[str, Any], _: Console) -> str:
    logs = [read_log(path, recipe.robot) for path in validation_logs(run)]
    if not logs:
        raise InputError(f"{run}: its validation logs are gone, so its page cannot be made again")
    predictions = [predict_log(model, log) for log in logs]
    plan, health = replan(recipe, run / "plan.json"), [LogHealth.of(log) for log in logs]
    log = read_log(run / EXCITATION, recipe.robot)
    return calibration_page(recipe, plan, result, predictions, health, log, run)


def _recalibration(run: Path, recipe: Recipe, model: IdentifiedModel, result: dict[str, Any], console: Console) -> str:
    (log,) = read_logs([run / EXCITATION], recipe.robot, console)
    comparison = Comparison.from_dict(read_object(run / "comparison.json"))
    program = (run / f"program{recipe.dialect.suffix}").read_text(encoding="utf-8")
    return recalibration_page(recipe, program, result, comparison, log, predict_log(model, log), run)


def recipe_of(run: Path) -> Recipe:
    """The run's own recipe: the original while it is unchanged, as it may name files next to it; else the copy."""
    state = read_object(run / "state.json")
    original, copy = Path(state["recipe"]), run / "recipe.yaml"
    unchanged = original.is_file() and sha256_file(original) == state["inputs_sha256"]["recipe.yaml"]
    return load_recipe(original if unchanged else copy)
