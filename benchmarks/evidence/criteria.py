"""What a loop should be searched for: criteria, numbers of points, stops and speeds, judged by the models they lead to.

Every loop is the best that a genetic search of equal size finds for its setting. It is run on the emulator's machine as
it is, and models of two lengths of it are judged by motions in the sub-region that no fit saw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from agent.excitation import Criterion
from agent.motion import Trajectory, ViaRegions
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe
from benchmarks.evidence.emulation import record, repeated
from benchmarks.evidence.judging import error, fitted
from benchmarks.evidence.loops import (
    LocalLoops,
    ScaledCriterion,
    StoppingLoops,
    WeightedCriterion,
    found_loop,
    unseen_motions,
)
from benchmarks.evidence.results import Results
from benchmarks.evidence.tables import PageSection, each, ratio_of, text, verdict
from fake_controller.plant import Plant

#: Seconds of motion that the models are fitted to.
SECONDS = (10.0, 30.0)
SHORT, _LONG = (f"{seconds:g}" for seconds in SECONDS)
DEFAULT = "torque-weighted D"


@dataclass(frozen=True)
class Setting:
    """How a loop is searched: its criterion by recipe and joint noise (n,), number of points, speed [m/s]; the recipe's
    own where None."""

    criterion: Callable[[Recipe, np.ndarray], Criterion] | None = None
    points: int | None = None
    speed: float | None = None
    stops: bool = False
    noise: bool = False


def _nominal(recipe: Recipe) -> np.ndarray:
    return recipe.robot.nominal_torque


SETTINGS = {
    DEFAULT: Setting(),
    "inverse-torque D": Setting(lambda recipe, _: WeightedCriterion(recipe.robot, 1 / _nominal(recipe))),
    "learned-noise D": Setting(lambda recipe, noise: WeightedCriterion(recipe.robot, 1 / noise), noise=True),
    "unweighted D": Setting(lambda recipe, _: WeightedCriterion(recipe.robot, np.ones(recipe.robot.dof))),
    "A": Setting(lambda recipe, _: ScaledCriterion(recipe.robot, "A")),
    "E": Setting(lambda recipe, _: ScaledCriterion(recipe.robot, "E")),
    "condition number": Setting(lambda recipe, _: ScaledCriterion(recipe.robot, "condition")),
    "4 points": Setting(points=4),
    "8 points": Setting(points=8),
    "12 points": Setting(points=12),
    "stops at every point": Setting(stops=True),
    "0.25 m/s": Setting(speed=0.25),
    "0.5 m/s": Setting(speed=0.5),
    "1.5 m/s": Setting(speed=1.5),
}


def measure(recipe: Recipe, machine: int, name: str, loops: Results, memory: dict) -> dict:
    """What the loop of a setting is worth on one machine."""
    setting = SETTINGS[name]
    default = LocalLoops(loop_problem(recipe, recipe.motion.speed))
    noise = np.ones(recipe.robot.dof)
    if setting.noise:  # RMS of what a first calibration by the default's loop leaves [N·m]
        loop = found_loop(recipe, machine, _kept_as(DEFAULT), default, loops)
        noise = fitted(recipe, repeated(Plant(recipe.robot, machine), loop, SECONDS[0]), SECONDS[0]).residual_rmse
    problem, via = loop_problem(recipe, setting.speed or recipe.motion.speed), recipe.motion.via_points
    if setting.points is not None:
        box = ViaRegions.from_box(setting.points, via.box.centre, via.box.size, via.box.orientation, via.box.cone)
        problem = replace(problem, regions=box)
    kind = StoppingLoops if setting.stops else LocalLoops
    candidates = kind(problem, setting.criterion(recipe, noise) if setting.criterion else None)
    loop = found_loop(recipe, machine, _kept_as(name), candidates, loops)
    return judged(recipe, machine, loop, memory)


def judged(recipe: Recipe, machine: int, loop: Trajectory, memory: dict) -> dict:
    """Error of models of the first seconds of a loop, run again and again; `memory` keeps the motions that judge."""
    if ("near", machine) not in memory:
        memory["near", machine] = [
            record(Plant(recipe.robot, machine), [motion]) for motion in unseen_motions(recipe, machine)
        ]
    log = repeated(Plant(recipe.robot, machine), loop, max(SECONDS))
    return {
        f"{seconds:g}": {"error": error(fitted(recipe, log, seconds), memory["near", machine])} for seconds in SECONDS
    }


def _kept_as(name: str) -> str:
    """The default's loop is that of the sub-region, wherever it is used."""
    return "sub-region" if name == DEFAULT else name


def section(results: Results) -> PageSection:
    """What a loop is searched for."""
    part = PageSection()
    part.say("## What a loop is searched for")
    kept = {name: lines for name in SETTINGS if (lines := results.of(name))}
    if DEFAULT not in kept:
        part.weak.append("criteria, numbers of points, stops and speeds: not run")
        return part
    part.say(
        "Equal genetic searches, each with one change from the default: log det of HᵀH/M with rows weighted by nominal "
        f"torque, 6 points, FLY, 1 m/s. Models use {SHORT} and {_LONG} s of each loop. Ratios are over the default. "
        "Inverse torque is the metric of the paper's eq. 8. Learned noise is what a first fit leaves of each joint."
    )
    rows = []
    for name, lines in kept.items():
        ratios = [
            ratio_of(*(each(of, lambda v, s=s: v[s]["error"]) for of in (lines, kept[DEFAULT]))) for s in (SHORT, _LONG)
        ]
        rows.append([name, str(len(lines)), *map(text, ratios)])
        if name != DEFAULT and "better" in [verdict(ratio, len(lines)) for ratio in ratios]:
            part.weak.append(
                f"{name} led to better models than the default: {text(ratios[0])} times its error after "
                f"{SHORT} s, {text(ratios[1])} after {_LONG} s ({len(lines)} machines)"
            )
    part.table(["loop", "machines", f"ratio, {SHORT} s", f"ratio, {_LONG} s"], rows)
    return part
