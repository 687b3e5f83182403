"""The first screen of a run's page: what was asked, what comes next, and of which machine and model it is."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from agent.pipeline.ending import next_steps, whose
from agent.pipeline.gap_question import PLANNING_BUDGET, GapQuestion
from agent.pipeline.other_tests import BRAKES, DRIVES_OFF
from agent.recipe import Recipe
from agent.report import About, NextStep

#: Names for logs that are still to be recorded, in commands that are copied.
_NEW_LOG, _BRAKES_LOG = "new.mcap", "brakes.mcap"
_ASKED = {
    "calibrate": "How well does a model from the arm's own motion predict its torque in the sub-region?",
    "recalibrate": "Is the model still true? If not, what changed?",
}


def about_run(kind: str, recipe: Recipe, result: dict[str, Any], run: Path) -> About:
    """Of a calibration or recalibration, from the content of its `result.json`."""
    steps = next_steps(
        kind, result["accepted"] is not False, run, recipe, recipe.path.resolve(), result["current_model"]
    )
    return About(
        asked=_ASKED[kind],
        next=[NextStep(what, command) for command, what in steps],
        identity=identity(recipe, result, run.name),
    )


def identity(recipe: Recipe, result: dict[str, Any], run: str) -> list[tuple[str, str]]:
    """(what, value) of the machine, its model and the program."""
    provenance = result["provenance"]
    return [
        ("robot", result["robot"]),
        ("serial", result["serial"] or "not reported"),
        ("tool", "none" if recipe.tool is None else recipe.tool.text()),
        ("controller", f"{recipe.controller.driver} {recipe.controller.place}"),
        ("date", provenance["started"].replace("T", " ").removesuffix("+00:00")[:16] + " UTC"),
        ("run", run),
        ("current model", whose(result["current_model"], run)),
        ("program", f"calibration-agent {provenance.get('version of calibration-agent', '')}".strip()),
    ]


def after_diagnosis(
    result: Mapping[str, Any],
    robot: str | None,
    logs: Sequence[Path],
    question: GapQuestion,
    recipe: Path | None = None,
) -> list[NextStep]:
    """What may come after a diagnosis of these logs: commands that take what was found further; `recipe` is where
    further motions may lie, if anybody said."""
    model = question.model
    asked = replace(
        question, report=None, out=None, next_recipe=None, next_payload=None, planning_budget=PLANNING_BUDGET
    )
    named = ["--robot", robot] if robot else []
    words = ["agent", "diagnose", *named, *asked.options()]
    again = shlex.join([*words, *map(str, logs)])
    if result["verdict"] == "no_gap":
        return [NextStep("nothing to do: keep the model.")]
    from agent.model import CATALOGUE, PAYLOAD
    from agent.simulators import is_simulator

    experiment = result["next_experiment"] or {}
    loaded = []
    if "with_a_mass" in experiment and recipe is not None:
        mass = experiment["with_a_mass"][PAYLOAD]
        folder = f"{question.out or 'next'}_with_a_mass"
        planned = [*words, "--next", str(recipe), "--payload", mass, "-o", folder, *map(str, logs)]
        what = f"or, for a clearer answer, mount {mass} (or the mass you have) at the flange and plan for it:"
        loaded = [NextStep(what, shlex.join(planned))]
    if question.next_recipe is not None and experiment.get("program"):
        program = Path(experiment["program"])
        mounted = ["--payload", experiment[PAYLOAD]] if PAYLOAD in experiment else []
        first = f"mount {experiment[PAYLOAD]} at the flange, then " if mounted else ""
        record = ["agent", "record", str(question.next_recipe), "--program", str(program), *mounted]
        with_it = f"{again} {shlex.quote(str(program.with_suffix('.mcap')))}"
        on_brakes = BRAKES in experiment["motion"] and " and --drives-off LOG"
        return [
            NextStep(f"{first}run the planned motion:", shlex.join(record)),
            NextStep(f"diagnose again with its log{on_brakes or ''}:", with_it),
            *loaded,
        ]
    if not result["causes"] or result["verdict"] == "ambiguous":
        if DRIVES_OFF in experiment.get("motion", "") and question.drives_off is None:
            again = shlex.join([*words, DRIVES_OFF, _BRAKES_LOG, *map(str, logs)])
            return [NextStep(f"record 1 s with the drives off as {_BRAKES_LOG}, then diagnose again:", again), *loaded]
        return [NextStep(f"record the next motion as {_NEW_LOG}, then diagnose again:", f"{again} {_NEW_LOG}"), *loaded]
    if all(CATALOGUE[cause["effect"]].once for cause in result["causes"]):
        return [NextStep("record again with nothing touching the arm: a single event is not added to a model.")]
    if model is not None and is_simulator(model):
        return [NextStep("correct the simulator:", f"{again} -o fixed{model.suffix}")]
    return [NextStep("add the effect to the model:", f"{again} -o model_with_effects.json")]
