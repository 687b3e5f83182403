"""Local against global: the same machine calibrated in the sub-region and over the whole workspace, in every world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from agent.core import InputError
from agent.estimation import EstimationSettings, estimate
from agent.motion import Trajectory, ViaRegions
from agent.pipeline.plan import loop_problem
from agent.recipe import Recipe
from agent.recording import Log
from agent.robot import KinematicsError
from benchmarks.evidence import figures
from benchmarks.evidence.emulation import WORLDS, effects, plant, record, repeated, true_parameters
from benchmarks.evidence.judging import error, error_figures, intervals
from benchmarks.evidence.loops import GlobalLoops, LocalLoops, found_loop, random_loops, unseen_motions
from benchmarks.evidence.results import Results
from benchmarks.evidence.statistics import each, mean_of, ratio_of, text, verdict

#: Seconds of motion that a calibration gets.
SECONDS = (6.0, 12.0, 30.0)
#: How far [m] the middle of the box that is judged lies from that of the sub-region.
DISTANCES = (0.0, 0.2, 0.4, 0.6)
#: Of the joints' speeds, of motions over the whole workspace.
OVERRIDE = 0.4
_AWAY_SPEED = 0.25  # m/s
_FAR, _AWAY = 1, 1  # motions over the whole workspace, and at each distance


@dataclass(frozen=True, eq=False)
class Place:
    """What one machine runs, the same in every world: loops to calibrate by, and motions that judge."""

    recipe: Recipe
    machine: int
    loops: Results

    @cached_property
    def ways(self) -> dict[str, Trajectory]:
        """The loop of every way to calibrate."""
        fast = loop_problem(self.recipe, self.recipe.motion.speed)
        ways = {
            "sub-region": LocalLoops(fast),
            "workspace": GlobalLoops(fast, OVERRIDE),
        }
        return {name: found_loop(self.recipe, self.machine, name, loops, self.loops) for name, loops in ways.items()}

    @cached_property
    def near(self) -> list[Trajectory]:
        """Random motions in the sub-region at the speed of validation."""
        return unseen_motions(self.recipe, self.machine)

    @cached_property
    def far(self) -> list[Trajectory]:
        """Random motions over the whole workspace."""
        anywhere = GlobalLoops(loop_problem(self.recipe, self.recipe.motion.speed), OVERRIDE)
        return random_loops(anywhere, _FAR, np.random.default_rng([self.machine, 22]))

    @cached_property
    def away(self) -> dict[float, list[Trajectory]]:
        """Random motions in boxes like the sub-region whose middle lies so far [m] from it, in random directions."""
        rng = np.random.default_rng([self.machine, 23])
        return {distance: [self._in_a_box(distance, rng) for _ in range(_AWAY)] for distance in DISTANCES}

    def _in_a_box(self, distance: float, rng: np.random.Generator) -> Trajectory:
        problem = loop_problem(self.recipe, _AWAY_SPEED)
        via = self.recipe.motion.via_points
        for _ in range(100):
            direction = rng.normal(size=3)
            centre = np.asarray(via.box.centre) + distance * direction / np.linalg.norm(direction)
            box = ViaRegions.from_box(via.count, centre, via.box.size, via.box.orientation, via.box.cone)
            try:
                return random_loops(LocalLoops(replace(problem, regions=box)), 1, rng)[0]
            except (InputError, KinematicsError, RuntimeError):
                continue
        raise RuntimeError(f"no box {distance} m away can be reached")


def settings(recipe: Recipe) -> list[str]:
    """One for each world."""
    return list(WORLDS)


def measure(recipe: Recipe, machine: int, world: str, loops: Results, memory: dict) -> dict:
    """Errors of every way to calibrate this machine in this world; `memory` keeps what its worlds share."""
    place = memory.setdefault(("place", machine), Place(recipe, machine, loops))
    robot = recipe.robot
    calibrated, at_work = effects(world, robot, machine)
    worker = plant(robot, machine, at_work)
    truth = true_parameters(worker)
    near = [record(worker, [motion]) for motion in place.near]
    far = [record(worker, [motion]) for motion in place.far]
    away = {distance: [record(worker, [m]) for m in motions] for distance, motions in place.away.items()}
    found = {}
    for name, loop in place.ways.items():
        log = repeated(plant(robot, machine, calibrated), loop, max(SECONDS))
        models = {seconds: fitted(recipe, log, seconds) for seconds in SECONDS}
        whole = models[max(SECONDS)]
        found[name] = {
            "after": {f"{seconds:g}": error(model, near) for seconds, model in models.items()},
            "near": error_figures(whole, near, truth),
            "intervals": intervals(whole, near[:1]),
            "far": error(whole, far),
            "away": {f"{distance:g}": error(whole, logs) for distance, logs in away.items()},
        }
    return found


def fitted(recipe: Recipe, log: Log, seconds: float, method: str = "weighted"):
    """The model of the first so many seconds of a log."""
    return estimate(recipe.robot, [log.between(0.0, seconds)], EstimationSettings.create(method=method))


LOCAL, GLOBAL = "sub-region", "workspace"
_ENOUGH = 90.0  # % of samples, of 95 % intervals
_ALIKE = 1.05  # a ratio that nobody would notice


def section(results: Results, pictures: Path) -> figures.PageSection:
    """The section; empty but for what is missing where nothing was run."""
    part = figures.PageSection()
    part.say("## Local against global")
    worlds = {world: lines for world in WORLDS if (lines := results.of(world))}
    if not worlds:
        part.weak.append("local against global: not run")
        return part
    part.say(
        f"Each machine is calibrated from {max(SECONDS):g} s in the sub-region (straight lines at 1 m/s) and from the "
        "same time over the whole workspace (joint by joint, at 40 % of its speeds). Searches, criterion and estimator "
        "are the same. Ratios are local over global: below 1, local is better. `covered` is the share of moving "
        "samples within the 95 % intervals, local / global."
    )
    _errors(part, worlds, pictures)
    _outside(part, worlds, pictures)
    part.say("The worlds:", "", *(f"- **{name}**: {what}" for name, what in WORLDS.items()))
    return part


def _near(way: str):
    return lambda lines: each(lines, lambda values: values[way]["near"]["error"])


def _errors(part: figures.PageSection, worlds: dict, pictures: Path) -> None:
    rows, found, short = [], {}, []
    for world, lines in worlds.items():
        local, wide = _near(LOCAL)(lines), _near(GLOBAL)(lines)
        ratio = ratio_of(local, wide)
        wins = sum(local[m] < wide[m] for m in lines)
        covered = [
            mean_of(each(lines, lambda v, way=way: v[way]["intervals"]["covered"]))[0] for way in (LOCAL, GLOBAL)
        ]
        rows.append(
            [
                world,
                str(len(lines)),
                text(mean_of(local)),
                text(mean_of(wide)),
                text(ratio),
                f"{wins} of {len(lines)}",
                " / ".join(f"{share:.0f}" for share in covered),
            ]
        )
        found[world] = ratio, verdict(ratio, len(lines))
        if covered[0] < _ENOUGH:
            short.append(f"{world} {covered[0]:.0f} % ({covered[1]:.0f} %)")
        if found[world][1] != "better":
            part.weak.append(
                f"{world}: local calibration is {_compared(*found[world])} global in the sub-region itself, "
                f"{text(ratio)} times its error ({len(lines)} machines)"
            )
    if short:
        part.weak.append(
            "intervals know nothing of what the model has no term for; those of a local (global) calibration cover: "
            + ", ".join(short)
        )
    part.table(
        [
            "world",
            "machines",
            "local [%]",
            "global [%]",
            "ratio",
            "local won",
            "covered [%]",
        ],
        rows,
    )
    better = sum(said == "better" for _, said in found.values())
    part.say(f"Local calibration is better in {better} of {len(found)} worlds.")
    figures.ratios(pictures / "local.svg", found, "error of local over error of global calibration")
    part.picture("local", "Ratio of errors by world")


def _compared(ratio: tuple[float, float, float], said: str) -> str:
    if ratio[2] < _ALIKE:
        return "as wrong as"
    return "worse than" if said == "worse" else "not shown to be better than"


def _outside(part: figures.PageSection, worlds: dict, pictures: Path) -> None:
    part.say(
        "### Away from the sub-region",
        "",
        "Boxes of the same size at growing distance, at 0.25 m/s; then motions over the whole workspace.",
    )
    at = {
        world: {
            d: ratio_of(*(each(lines, lambda v, way=way, d=d: v[way]["away"][f"{d:g}"]) for way in (LOCAL, GLOBAL)))
            for d in DISTANCES
        }
        for world, lines in worlds.items()
    }
    far = {
        world: ratio_of(*(each(lines, lambda v, way=way: v[way]["far"]) for way in (LOCAL, GLOBAL)))
        for world, lines in worlds.items()
    }
    figures.curves(pictures / "distance.svg", at, ("distance from the sub-region [m]", "error, local over global"), "y")
    part.picture("distance", "Ratio of errors against distance from the sub-region")
    part.table(["world", "motions over the whole workspace"], [[world, text(ratio)] for world, ratio in far.items()])
