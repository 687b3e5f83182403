"""Local against global: the same machine calibrated in the sub-region and over the whole workspace, in every world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from agent.core import InputError
from agent.estimation import EstimationSettings, estimate
from agent.motion import Trajectory, ViaRegions
from agent.pipeline.planning import loop_problem
from agent.recipe import Recipe
from agent.recording import Log
from agent.robot import KinematicsError
from benchmarks.evidence.emulation import WORLDS, effects, plant, record, repeated, true_parameters
from benchmarks.evidence.judging import error, figures, intervals
from benchmarks.evidence.loops import GlobalLoops, LocalLoops, found_loop, random_loops, unseen_motions
from benchmarks.evidence.results import Results

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
            "near": figures(whole, near, truth),
            "intervals": intervals(whole, near[:1]),
            "far": error(whole, far),
            "away": {f"{distance:g}": error(whole, logs) for distance, logs in away.items()},
        }
    return found


def fitted(recipe: Recipe, log: Log, seconds: float, method: str = "weighted"):
    """The model of the first so many seconds of a log."""
    return estimate(recipe.robot, [log.between(0.0, seconds)], EstimationSettings.create(method=method))
