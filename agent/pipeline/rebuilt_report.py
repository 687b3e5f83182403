"""The page of a run made again from what lies in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Console, InputError, sha256_file, write_atomically
from agent.pipeline.reports import recalibration_page
from agent.recipe import Recipe, load_recipe
from agent.runs import PastRun, read_object, read_run, readable

if TYPE_CHECKING:
    from agent.model import IdentifiedModel


def rebuild_report(run: Path, console: Console) -> Path:
    """Make the page of a complete run from its files; returns its path. A diagnosis is made again for it.

    Raises:
        InputError: the run is not complete, something the page needs is missing, or another version wrote the run.
    """
    past, _ = read_run(run)
    if not past.complete:
        raise InputError(f"{run}: {_unfinished(run, past)}; there is nothing to report yet")
    with readable(run):
        make = {"calibrate": _calibration, "recalibrate": _recalibration, "diagnose": _diagnosis}[past.kind]
        page = make(run, recipe_of(run), console)
    return write_atomically(run / "report.html", page)


def _unfinished(run: Path, past: PastRun) -> str:
    again = {
        "calibrate": f"`agent calibrate RECIPE --resume {run}` goes on with it",
        "recalibrate": "`agent recalibrate RECIPE` starts a new one",
        "diagnose": "`agent diagnose --record RECIPE` starts a new one",
    }
    how = again.get(past.kind, "start a new one")
    if past.status == "stopped":
        return f"this run stopped before its end ({past.reason}); {how}"
    return f"this run has not ended; if nothing runs any more it was killed, and {how}"


def _calibration(run: Path, recipe: Recipe, console: Console) -> str:
    from agent.pipeline.planning import replan
    from agent.pipeline.result import run_data
    from agent.recording import read_log
    from agent.report import LogHealth, RunContent, further_sections, run_report
    from agent.validation import predict_log

    model = _model(run)
    logs = sorted(run.glob("validation_[0-9][0-9].mcap"))
    if not logs:
        raise InputError(f"{run}: its validation logs are gone, so its page cannot be made again")
    predictions, health = [], []
    for path in logs:
        log = read_log(path, recipe.robot)
        predictions.append(predict_log(model, log))
        health.append(LogHealth.of(log))
    plan = replan(recipe, run / "plan.json")
    further = further_sections(RunContent(run, recipe, model, predictions, health))
    return run_report(run_data(recipe, plan, _result(run), model, predictions, further, run))


def _recalibration(run: Path, recipe: Recipe, console: Console) -> str:
    from agent.pipeline.identify import read_logs
    from agent.validation import Comparison, predict_log

    (log,) = read_logs([run / "excitation.mcap"], recipe.robot, console)
    comparison = Comparison.from_dict(read_object(run / "comparison.json"))
    program = (run / f"program{recipe.dialect.suffix}").read_text(encoding="utf-8")
    prediction = predict_log(_model(run), log)
    return recalibration_page(recipe, program, _result(run), comparison, log, prediction, run)


def _diagnosis(run: Path, recipe: Recipe, console: Console) -> str:
    from agent.pipeline.diagnose import diagnose_again

    return diagnose_again(run, recipe.robot, recipe.robot_source, console)


def _model(run: Path) -> IdentifiedModel:
    from agent.model import IdentifiedModel

    return IdentifiedModel.load(run / "model.json")


def _result(run: Path) -> dict[str, Any]:
    """The run's result, with the model that is current now."""
    from agent.pipeline.ending import current_run

    result = read_object(run / "result.json")
    return {**result, "current_model": current_run(run.parent, result["robot"], result["serial"])}


def recipe_of(run: Path) -> Recipe:
    """The run's own recipe; where it names files beside it, the original must still be what it was."""
    state = read_object(run / "state.json")
    original, copy = Path(state["recipe"]), run / "recipe.yaml"
    unchanged = original.is_file() and sha256_file(original) == state["inputs_sha256"]["recipe.yaml"]
    return load_recipe(original if unchanged else copy)
