"""Local against global: the same machine calibrated in the sub-region and over the whole workspace, in every world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.motion import Trajectory, ViaRegions
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe
from agent.robot import KinematicsError
from benchmarks.evidence.emulation import WORLDS, effects, record, repeated
from benchmarks.evidence.judging import covered, error, fitted
from benchmarks.evidence.loops import GlobalLoops, LocalLoops, found_loop, random_loops, unseen_motions
from benchmarks.evidence.results import Results
from benchmarks.evidence.tables import Interval, PageSection, each, mean_of, ratio_of, text, verdict
from fake_controller.plant import Plant

#: Seconds of motion that a calibration gets.
SECONDS = 30.0
#: How far [m] the middle of the box that is judged lies from that of the sub-region.
DISTANCES = (0.0, 0.2, 0.4, 0.6)
#: Of the joints' speeds, of motions over the whole workspace.
OVERRIDE = 0.4
_AWAY_SPEED = 0.25  # m/s
LOCAL, GLOBAL = "sub-region", "workspace"
_ENOUGH = 90.0  # % of samples, of 95 % intervals
_ALIKE = 1.05  # a ratio that nobody would notice


def motions(recipe: Recipe, machine: int, loops: Results) -> dict[str, dict]:
    """What one machine runs, the same in every world: loops to calibrate by, and motions that judge.

    These are random motions in the sub-region at the speed of validation (`near`), over the whole workspace (`far`),
    and in boxes like the sub-region whose middle lies at each distance [m] from it, in a random direction (`away`).
    """
    fast = loop_problem(recipe, recipe.motion.speed)
    ways = {LOCAL: LocalLoops(fast), GLOBAL: GlobalLoops(fast, OVERRIDE)}
    rng = np.random.default_rng([machine, 23])
    return {
        "ways": {name: found_loop(recipe, machine, name, way, loops) for name, way in ways.items()},
        "near": dict(enumerate(unseen_motions(recipe, machine))),
        "far": dict(enumerate(random_loops(ways[GLOBAL], 1, np.random.default_rng([machine, 22])))),
        "away": {distance: _in_a_box(recipe, distance, rng) for distance in DISTANCES},
    }


def _in_a_box(recipe: Recipe, distance: float, rng: np.random.Generator) -> Trajectory:
    problem, via = loop_problem(recipe, _AWAY_SPEED), recipe.motion.via_points
    for _ in range(100):
        direction = rng.normal(size=3)
        centre = np.asarray(via.box.centre) + distance * direction / np.linalg.norm(direction)
        box = ViaRegions.from_box(via.count, centre, via.box.size, via.box.orientation, via.box.cone)
        try:
            return random_loops(LocalLoops(replace(problem, regions=box)), 1, rng)[0]
        except (InputError, KinematicsError, RuntimeError):
            continue
    raise RuntimeError(f"no box {distance} m away can be reached")


def measure(recipe: Recipe, machine: int, world: str, loops: Results, memory: dict) -> dict:
    """Errors of every way to calibrate this machine in this world; `memory` keeps what its worlds share."""
    if ("motions", machine) not in memory:
        memory["motions", machine] = motions(recipe, machine, loops)
    own = memory["motions", machine]
    calibrated, at_work = effects(world, recipe.robot, machine)
    worker = Plant(recipe.robot, machine, at_work)
    near, far, away = (
        {key: record(worker, [motion]) for key, motion in own[kind].items()} for kind in ("near", "far", "away")
    )
    found = {}
    for name, loop in own["ways"].items():
        model = fitted(recipe, repeated(Plant(recipe.robot, machine, calibrated), loop, SECONDS), SECONDS)
        found[name] = {
            "near": {"error": error(model, list(near.values()))},
            "intervals": {"covered": covered(model, near[0])},
            "far": error(model, list(far.values())),
            "away": {f"{distance:g}": error(model, [log]) for distance, log in away.items()},
        }
    return found


def section(results: Results) -> PageSection:
    """The section; it only says what is missing where nothing was run."""
    part = PageSection()
    part.say("## Local against global")
    worlds = {world: lines for world in WORLDS if (lines := results.of(world))}
    if not worlds:
        part.weak.append("local against global: not run")
        return part
    part.say(
        f"Each machine is calibrated from {SECONDS:g} s in the sub-region (straight lines at 1 m/s) and from the "
        "same time over the whole workspace (joint by joint, at 40 % of its speeds). Searches, criterion and estimator "
        "are the same. Ratios are local over global: below 1, local is better. `covered` is the share of moving "
        "samples within the 95 % intervals, local / global."
    )
    _errors(part, worlds)
    part.say(
        "### Away from the sub-region",
        "",
        "Ratios in boxes of the same size at growing distance, at 0.25 m/s, and over the whole workspace.",
    )
    heads = [*(f"{distance:g} m" for distance in DISTANCES), "whole workspace"]
    rows = [
        [
            world,
            *(text(_ratio(lines, lambda values, d=d: values["away"][f"{d:g}"])) for d in DISTANCES),
            text(_ratio(lines, lambda values: values["far"])),
        ]
        for world, lines in worlds.items()
    ]
    part.table(["world", *heads], rows)
    part.say("The worlds:", "", *(f"- **{name}**: {what}" for name, what in WORLDS.items()))
    return part


def _ratio(lines: dict, pick: Callable[[dict], list[float]]) -> Interval:
    return ratio_of(*(each(lines, lambda values, way=way: pick(values[way])) for way in (LOCAL, GLOBAL)))


def _errors(part: PageSection, worlds: dict) -> None:
    rows, better, short = [], 0, []
    for world, lines in worlds.items():
        local, wide = (each(lines, lambda values, way=way: values[way]["near"]["error"]) for way in (LOCAL, GLOBAL))
        ratio = ratio_of(local, wide)
        wins = sum(local[m] < wide[m] for m in lines)
        shares = [mean_of(each(lines, lambda v, way=way: v[way]["intervals"]["covered"]))[0] for way in (LOCAL, GLOBAL)]
        figures = [text(mean_of(local)), text(mean_of(wide)), text(ratio)]
        rows.append(
            [
                world,
                str(len(lines)),
                *figures,
                f"{wins} of {len(lines)}",
                " / ".join(f"{share:.0f}" for share in shares),
            ]
        )
        if shares[0] < _ENOUGH:
            short.append(f"{world} {shares[0]:.0f} % ({shares[1]:.0f} %)")
        said = verdict(ratio, len(lines))
        better += said == "better"
        if said != "better":
            compared = "worse than" if said == "worse" else "not shown to be better than"
            part.weak.append(
                f"{world}: local calibration is {'as wrong as' if ratio[2] < _ALIKE else compared} global in the "
                f"sub-region itself, {text(ratio)} times its error ({len(lines)} machines)"
            )
    if short:
        part.weak.append(
            "intervals know nothing of what the model has no term for; those of a local (global) calibration cover: "
            + ", ".join(short)
        )
    part.table(["world", "machines", "local [%]", "global [%]", "ratio", "local won", "covered [%]"], rows)
    part.say(f"Local calibration is better in {better} of {len(worlds)} worlds.")
