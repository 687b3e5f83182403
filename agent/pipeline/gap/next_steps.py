"""Commands that may follow a diagnosis."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from agent.diagnosis import NextKind, could_show
from agent.experiment import DRIVES_OFF
from agent.model import CATALOGUE, PAYLOAD, IdentifiedModel
from agent.pages import NextStep
from agent.pipeline.gap.diagnosis_question import PLANNING_BUDGET, GapQuestion
from agent.pipeline.identify import what_a_model_lacks
from agent.simulators import is_simulator

#: Name of a log that is still to be recorded, in commands that people copy.
_BRAKES_LOG = "brakes.mcap"


def after_diagnosis(
    result: Mapping[str, Any],
    robot: str | None,
    logs: Sequence[Path],
    question: GapQuestion,
    recipe: Path | None = None,
) -> list[NextStep]:
    """Steps that take further what a diagnosis of these logs found; further motions lie in the `recipe`, if any."""
    asked = replace(
        question, report=None, out=None, next_recipe=None, next_payload=None, planning_budget=PLANNING_BUDGET
    )
    named = ["--robot", robot] if robot else []
    if result["verdict"] == "no_gap":
        return [_after_no_gap(result, named, question, logs)]
    new, experiment = _new_log(logs), result["next_experiment"] or {}
    replaced = experiment.get("kind") == NextKind.REPEAT  # by logs with a torque that can be judged
    words, paths = ["agent", "diagnose", *named, *asked.options()], [] if replaced else list(map(str, logs))
    again = shlex.join([*words, *paths])
    loaded = []
    if "with_a_mass" in experiment and recipe is not None:
        mass = experiment["with_a_mass"][PAYLOAD]
        folder = f"{question.out or 'next'}_with_a_mass"
        what = f"or, for a clearer answer, mount {mass} (or the mass you have) at the flange and plan for it:"
        loaded = [NextStep(what, shlex.join([*words, "--next", str(recipe), "--payload", mass, "-o", folder, *paths]))]
    if question.next_recipe is not None and experiment.get("program"):
        return [*_run_planned(experiment, question.next_recipe, again, new), *loaded]
    if experiment.get("kind") == NextKind.TOGETHER:
        return [_estimate_again(named, question.model, new)]
    if not result["causes"] or result["verdict"] == "ambiguous":
        if experiment.get("drives_off") and question.drives_off is None:
            again = shlex.join([*words, DRIVES_OFF, _BRAKES_LOG, *paths])
            return [NextStep(f"record 1 s with the drives off as {_BRAKES_LOG}, then diagnose again:", again), *loaded]
        return [NextStep(f"record the next motion as {new}, then diagnose again:", f"{again} {new}"), *loaded]
    if all(CATALOGUE[cause["effect"]].shows_in == "path" for cause in result["causes"]):
        learn = ["agent", "learn-interpolator", "--robot", robot or "ROBOT", "-o", "law.yaml", *paths]
        return [NextStep("learn the controller's interpolator:", shlex.join(learn))]
    if all(CATALOGUE[cause["effect"]].transient for cause in result["causes"]):
        return [NextStep("record again with nothing touching the arm: a single event is not added to a model.")]
    written = question.out if question.next_recipe is None else None
    if question.model is not None and is_simulator(question.model):
        if written is not None:
            compared = shlex.join(["agent", "diagnose", "--model", str(written), new])
            return [NextStep("use the corrected file; compare it with a log that took no part:", compared)]
        return [NextStep("correct the simulator:", f"{again} -o fixed{question.model.suffix}")]
    if written is not None:
        check = shlex.join(["agent", "validate", "--model", str(written), new])
        return [NextStep("check the model with its effects on a log that took no part:", check)]
    effects = "effects" if len(result["causes"]) > 1 else "effect"
    return [NextStep(f"add the {effects} to the model:", f"{again} -o model_with_effects.json")]


def _run_planned(experiment: Mapping[str, Any], planned_for: Path, again: str, new: str) -> list[NextStep]:
    """The steps after a motion was planned for a recipe, or for an arm's file."""
    if is_simulator(planned_for):
        return [NextStep(f"send the planned set-points and record each motion as {new}, then:", f"{again} {new}")]
    program, mass = Path(experiment["program"]), experiment.get(PAYLOAD)
    record = ["agent", "record", str(planned_for), "--program", str(program)]
    record += [] if mass is None else ["--payload", mass]
    first = "" if mass is None else f"mount {mass} at the flange, then "
    on_brakes = " and --drives-off LOG" if experiment.get("drives_off") else ""
    with_it = f"{again} {shlex.quote(str(program.with_suffix('.mcap')))}"
    return [
        NextStep(f"{first}run the planned motion:", shlex.join(record)),
        NextStep(f"diagnose again with its log{on_brakes}:", with_it),
    ]


def _estimate_again(named: Sequence[str], path: Path | None, new: str) -> NextStep:
    """The step where the fit of a model leaves open what the logs move through."""
    assert path is not None
    model = IdentifiedModel.load(path)
    robot = named or ["--robot", model.robot.name]
    logs = [entry["log"] for entry in model.provenance["logs"]]
    command = shlex.join(["agent", "estimate", *robot, "-o", f"new_{path.name}", *logs, new])
    return NextStep(f"record it as {new}, then estimate again and diagnose with the new model:", command)


def _new_log(logs: Sequence[Path]) -> str:
    """Name of a log that is still to be recorded, in commands that people copy: what these are, file or folder."""
    return "new/" if logs[-1].is_dir() else f"new{logs[-1].suffix}"


def _after_no_gap(
    result: Mapping[str, Any], named: Sequence[str], question: GapQuestion, logs: Sequence[Path]
) -> NextStep:
    """The step after a diagnosis that found nothing, also where its logs could not show a change."""
    if could_show(result):
        more = result.get("large_error")
        return NextStep("record more logs, or estimate again." if more else "nothing to do: keep the model.")
    if question.model is None:
        more = shlex.join(["agent", "diagnose", *named, "--next", "RECIPE", "-o", "next", *map(str, logs)])
        return NextStep("plan a motion that shows more:", more)
    if is_simulator(question.model):
        return NextStep("record faster motions of every joint, then diagnose again.")
    model = IdentifiedModel.load(question.model)
    logs_of_fit = [entry["log"] for entry in model.provenance["logs"]]
    command = what_a_model_lacks(named[-1] if named else model.robot.name, logs_of_fit)
    return NextStep("ask what the model itself lacks:", command)
