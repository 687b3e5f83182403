"""Where the runs with further motions happen: behind the fake controller, or on arms in MuJoCo.

The fake controller runs the programs. The second world has no controller: its servo is given the set-points that the
programs were planned to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from agent.blind_check import ask_world
from agent.core import Console, InputError
from agent.model import CATALOGUE
from agent.pipeline.plan import checked_chains
from agent.recipe import Recipe, load_recipe, template
from agent.robot import Tool, kinematics_for, load_robot
from fake_controller.withheld.cases import Case, Mix, draw_cases
from fake_controller.withheld.runs import fake_controller

if TYPE_CHECKING:
    from agent.recording import Log

_QUIET = Console(verbosity=-1)
#: Weak effects of every kind that a further motion meets again: what a short first recording may leave open. A push
#: happens once, and a path that is not the planned one shows in set-points at once.
OPEN = Mix(
    {"one": 0.9, "none": 0.1},
    (0.15, 0.8),
    tuple(sorted(name for name, effect in CATALOGUE.items() if effect.shows_in == "torque" and not effect.once)),
)
_NOWHERE = "127.0.0.1:9"
#: The second world's servo, and so its set-points [Hz].
_SERVO_RATE = 1000.0
#: Sides of the sub-region over what an arm reaches, and joints [rad] in the middle of it, the wrist bent.
_REGION = 0.2
_POSTURES = (
    (0.2, -0.5, 1.2, 0.3, 0.8, 0.2),
    (0.2, 0.4, 1.0, 0.3, 0.9, 0.2),
    (0.2, 0.6, 0.3, -1.3, 0.4, 0.9, 0.2),
    (0.2, -0.6, -1.0, 0.3, -0.8, 0.2),
)


#: Seconds on the brakes, and the noise of a torque channel there over what it shows in motion.
_ON_BRAKES, _CHANNEL_NOISE = 4.0, 0.01


@dataclass(frozen=True)
class Job:
    """Programs (`texts`, by name) that a case's machine runs one after the other with `effects`, and which of their
    logs to `keep`, as `<name>.mcap` in `folder`."""

    case: Case
    effects: Sequence[Mapping[str, Any]]
    recipe: Recipe
    texts: Mapping[str, str]
    keep: Sequence[str]
    folder: Path


class ActiveWorld(Protocol):
    """Machines that run programs."""

    @property
    def title(self) -> str:
        """What the key and the scores call it."""

    def draw(self, count: int, seed: int) -> list[Case]:
        """The runs, the same for the same seed."""

    def recipe(self, case: Case, machine: Path) -> Recipe:
        """Robot and sub-region of the case's machine; what is kept of it lies in the folder `machine`."""

    def run(self, job: Job) -> None:
        """Run the programs and record them.

        Raises:
            AgentError, DriverError: the arm did not do it.
        """


@dataclass(frozen=True)
class ControllerMachines:
    """The fake controller over its TCP link."""

    robot: str
    title = "the fake controller"

    def draw(self, count: int, seed: int) -> list[Case]:
        return draw_cases(count, seed, load_robot(self.robot), OPEN)

    def recipe(self, case: Case, machine: Path) -> Recipe:
        return _written(machine, template(self.robot, _NOWHERE, cycles=2))

    def run(self, job: Job) -> None:
        from agent.link import open_link

        with fake_controller(self.robot, job.case.machine, job.effects, ("--interpolator", "ours")) as address:
            there = replace(job.recipe, controller=job.recipe.controller.model_copy(update={"address": address}))
            with open_link(there, _QUIET, True, job.folder) as link:
                for name, text in job.texts.items():
                    program, chains = checked_chains(there, text, f"{name}.pdl", link.position())
                    log = job.folder / f"{name}.mcap"
                    link.run(program, text, log, name, chains)
                    if name not in job.keep:
                        log.unlink()


@dataclass(frozen=True)
class MujocoMachines:
    """Arms of four builds; each has a sub-region around a bent posture of its own."""

    title = "MuJoCo"

    def draw(self, count: int, seed: int) -> list[Case]:
        asked = {"count": count, "seed": seed, "laws": "development", "mix": asdict(OPEN)}
        drawn = ask_world(["-m", "second_world", "draw"], asked)
        names = {field.name for field in fields(Case)}
        kept = [{name: value for name, value in case.items() if name in names} for case in drawn]
        return [Case(**{**case, "effects": tuple(case["effects"])}) for case in kept]

    def recipe(self, case: Case, machine: Path) -> Recipe:
        robot = machine / "robot.yaml"
        if not robot.exists():
            job = {"machine": case.machine, "motion": 0, "effects": [], "set_points": {}}
            ask_world(["-m", "second_world", "run"], {**job, "describe": str(machine), "folder": str(machine)})
        return _written(machine, _region_text(robot))

    def run(self, job: Job) -> None:
        files, cycles, at = {}, {}, kinematics_for(job.recipe.robot, job.recipe.tool).middle
        for name, text in job.texts.items():
            points, cycles[name] = _set_points(job.recipe, text, name, at)
            files[name], at = job.folder / f"{name}.npy", points[-1]
            np.save(files[name], points)
        machine = {"machine": job.case.machine, "motion": job.case.motion, "effects": list(job.effects)}
        paths = {name: str(path) for name, path in files.items()}
        ask_world(
            ["-m", "second_world", "run"], {**machine, "folder": str(job.folder), "set_points": paths, "cycles": cycles}
        )
        for name, path in files.items():
            path.unlink()
            if name not in job.keep:
                (job.folder / f"{name}.mcap").unlink()


def mounted(load: Tool) -> dict[str, Any]:
    """A known mass at the flange as machines are given it: as an effect."""
    centre = np.zeros(3) if load.centre_of_mass is None else load.centre_of_mass
    return {"effect": "payload", "joints": [], "parameters": {"mass": load.mass, "centre": centre.tolist()}}


def on_brakes(log: Log, effects: Sequence[Mapping[str, Any]]) -> Log:
    """A log of the arm on its brakes where another ended, with an offset where one of the channels has one."""
    assert log.effort is not None
    count = round(_ON_BRAKES * log.sample_rate)
    position = np.tile(log.position[-1], (count, 1))
    zero = np.zeros(position.shape[1])
    for effect in effects:
        if effect["effect"] in CATALOGUE and CATALOGUE[effect["effect"]].adds_to_report:
            zero[log.joint_names.index(effect["joints"][0])] += sum(effect["parameters"].values())
    noise = _CHANNEL_NOISE * np.std(log.effort, axis=0) * np.random.default_rng(count).normal(size=position.shape)
    return replace(
        log,
        t=np.arange(count) / log.sample_rate,
        position=position,
        velocity=0 * position,
        effort=zero + noise,
        reference_position=None,
        planned_position=None,
        segments=((0, count),),
        cycle_starts=(),
    )


def _written(machine: Path, text: str) -> Recipe:
    from agent.core import write_atomically

    machine.mkdir(parents=True, exist_ok=True)
    return load_recipe(write_atomically(machine / "recipe.yaml", text))


def _region_text(robot: Path) -> str:
    """A recipe whose sub-region has something to search in.

    Raises:
        InputError: no posture has.
    """
    from agent.excitation import Candidates
    from agent.motion import pose_to_pos
    from agent.pipeline.plan import loop_problem

    arm = load_robot(str(robot))
    kinematics = kinematics_for(arm, None)
    middle = kinematics.middle
    reach = float(np.linalg.norm(kinematics.forward(np.zeros((1, arm.dof)))[0, :3, 3]))
    rng = np.random.default_rng(1)
    for bent in _POSTURES:
        posture = middle + np.pad(bent, (0, arm.dof - len(bent)))
        x, y, z, *angles = pose_to_pos(kinematics.forward(posture[None])[0])
        text = template(
            "robot.yaml",
            _NOWHERE,
            cycles=2,
            centre=[f"{value:.1f} mm" for value in (x, y, z)],
            size=[f"{1000 * _REGION * reach:.0f} mm"] * 3,
            orientation=[f"{angle:.2f} deg" for angle in angles],
        )
        recipe = _written(robot.parent, text)
        try:
            candidates = Candidates(loop_problem(recipe, recipe.motion.speed))
        except InputError:
            continue
        if sum(candidates.score(rng.uniform(size=candidates.problem.genes)).feasible for _ in range(10)) >= 3:
            return text
    raise InputError(f"{robot}: no sub-region was found in which this arm moves freely")


def _set_points(recipe: Recipe, text: str, name: str, start: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """(S, n) at the servo's rate, rests included, from `start` (n,) on, and when the cycles of a program without rests
    begin [s], as the log of a link says."""
    from agent.motion import create_interpolator, parse_program

    interpolator = create_interpolator(recipe.search.interpolator, recipe.robot, recipe.tool, period=1.0 / _SERVO_RATE)
    trajectory = interpolator.plan(list(parse_program(text, name, recipe.robot).run()), start)
    _, chains = checked_chains(recipe, text, f"{name}.pdl", start)
    begins = np.cumsum([0.0, *(chain.duration for chain in chains)])
    return trajectory.q, [float(at) for at, chain in zip(begins, chains, strict=False) if chain is chains[-1]]
