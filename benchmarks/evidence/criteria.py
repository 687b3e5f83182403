"""What a loop should be searched for: criteria, numbers of points, stops and speeds, judged by the models they lead to.

Every loop is the best that a genetic search of equal size finds for its setting. It is run on the emulator's machine as
it is, and models of two lengths of it are judged by motions in the sub-region that no fit saw.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agent.excitation import Candidates, Criterion
from agent.motion import Trajectory, ViaRegions
from agent.pipeline.plan import loop_problem
from agent.recipe import Recipe
from benchmarks.evidence import figures
from benchmarks.evidence.emulation import plant, record, repeated
from benchmarks.evidence.judging import error, intervals
from benchmarks.evidence.local import fitted
from benchmarks.evidence.loops import (
    LocalLoops,
    ScaledCriterion,
    StoppingLoops,
    WeightedCriterion,
    found_loop,
    unseen_motions,
)
from benchmarks.evidence.results import Results
from benchmarks.evidence.statistics import each, ratio_of, text, verdict

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


def settings(recipe: Recipe) -> list[str]:
    """Names of `SETTINGS`."""
    return list(SETTINGS)


def measure(recipe: Recipe, machine: int, name: str, loops: Results, memory: dict) -> dict:
    """What the loop of a setting is worth on one machine."""
    setting = SETTINGS[name]
    noise = _noise(recipe, machine, loops, memory) if setting.noise else np.ones(recipe.robot.dof)
    loop = found_loop(recipe, machine, _kept_as(name), _candidates(recipe, setting, noise), loops)
    return judged(recipe, machine, loop, memory)


def judged(recipe: Recipe, machine: int, loop: Trajectory, memory: dict) -> dict:
    """Error and intervals of models of the first seconds of a loop, run again and again."""
    near = memory.setdefault(("near", machine), [])
    if not near:
        near += [record(plant(recipe.robot, machine), [motion]) for motion in unseen_motions(recipe, machine)]
    arm = plant(recipe.robot, machine)
    log = repeated(arm, loop, max(SECONDS))
    found: dict = {}
    for seconds in SECONDS:
        model = fitted(recipe, log, seconds)
        found[f"{seconds:g}"] = {"error": error(model, near)} | intervals(model, near[:1])
    return found


def _kept_as(name: str) -> str:
    """The default's loop is that of the sub-region, wherever it is used."""
    return "sub-region" if name == DEFAULT else name


def _candidates(recipe: Recipe, setting: Setting, noise: np.ndarray) -> Candidates:
    problem = loop_problem(recipe, setting.speed or recipe.motion.speed)
    via = recipe.motion.via_points
    if setting.points is not None:
        box = ViaRegions.from_box(setting.points, via.box.centre, via.box.size, via.box.orientation, via.box.cone)
        problem = replace(problem, regions=box)
    kind = StoppingLoops if setting.stops else LocalLoops
    return kind(problem, setting.criterion(recipe, noise) if setting.criterion else None)


def _noise(recipe: Recipe, machine: int, loops: Results, memory: dict) -> np.ndarray:
    """(n,) RMS of what a first calibration of ten seconds by the default's loop leaves [N·m]."""
    default = LocalLoops(loop_problem(recipe, recipe.motion.speed))
    loop = found_loop(recipe, machine, _kept_as(DEFAULT), default, loops)
    return fitted(recipe, repeated(plant(recipe.robot, machine), loop, SECONDS[0]), SECONDS[0]).residual_rmse


def section(results: Results, pictures: Path) -> figures.PageSection:
    """What a loop is searched for."""
    part = figures.PageSection()
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
    rows, picture = [], {}
    for name, lines in kept.items():
        errors = {s: each(lines, lambda v, s=s: v[s]["error"]) for s in (SHORT, _LONG)}
        ratios = {s: ratio_of(errors[s], each(kept[DEFAULT], lambda v, s=s: v[s]["error"])) for s in errors}
        rows.append([name, str(len(lines)), *(text(r) for r in ratios.values())])
        if name != DEFAULT:
            said = {s: verdict(ratio, len(lines)) for s, ratio in ratios.items()}
            picture[name] = ratios[SHORT], said[SHORT]
            if "better" in said.values():
                part.weak.append(
                    f"{name} led to better models than the default: {text(ratios[SHORT])} times its error after "
                    f"{SHORT} s, {text(ratios[_LONG])} after {_LONG} s ({len(lines)} machines)"
                )
    part.table(
        ["loop", "machines", f"ratio, {SHORT} s", f"ratio, {_LONG} s"],
        rows,
    )
    if picture:
        figures.ratios(pictures / "criteria.svg", picture, f"error after {SHORT} s over that of the default")
        part.picture("criteria", "Ratio of errors by what the loop was searched for")
    return part
