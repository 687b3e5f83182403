"""One run: recorded behind the fake controller, diagnosed, continued in several ways, every answer in its own file.

Every way starts from the same first recording, the excitation loop of a recipe, and gets the same robot time. Its
motion follows the first one on the same machine, which is then as warm as it would be. Diagnosis and planning get logs,
model and recipe, never the case.

Where the first answer may be an offset of a torque channel, the tool asks for seconds with the drives off, which are
then recorded before the planned motion. Where it asks for a known mass at the flange, a motion is planned with it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import AgentError, Console, finite, write_atomically
from agent.diagnosis import Diagnosis, diagnose
from agent.estimation import estimate
from agent.experiment import KINDS, LONGEST, ExperimentScorer, NextMotion, Pick, d_optimal
from agent.experiment.next_motion import RunnablePieces
from agent.link import planned_load
from agent.model import CATALOGUE, PAYLOAD, IdentifiedModel, payload_of, payload_text
from agent.pipeline.gap.next_experiment import clearer_loaded, plan_next
from agent.pipeline.planning.plan import Plan, loop_problem, make_plan
from agent.recipe import Recipe, load_recipe, template
from agent.recording import PARTS, PLANNED_PARTS, Log, read_log
from agent.robot import Tool
from benchmarks.active.baselines import as_drawn, pieces_otherwise
from benchmarks.active.scoring import WAYS, class_of
from drivers.errors import DriverError
from fake_controller.withheld.cases import Case
from fake_controller.withheld.runs import record_motions

ROBOT = "comau_ns16"
_QUIET = Console(verbosity=-1)
#: Seconds with the drives off, and the noise of a torque channel there over what it shows in motion.
_DRIVES_OFF, _CHANNEL_NOISE = 4.0, 0.01


@dataclass(frozen=True)
class WayMotion:
    """A further motion: its program (empty where there is none), duration [s], expectation, and the mass asked for."""

    text: str
    seconds: float
    expected: Sequence[Mapping[str, Any]] = ()
    mass: str | None = None


class ActiveRun:
    """Verdicts on a case after its first motions, and after a further motion of every strategy."""

    def __init__(self, case: Case, folder: Path):
        self._case = case
        self._folder = folder / "runs" / f"{case.number:04d}"
        self._machine = folder / "machines" / f"{case.number:04d}"

    @property
    def ambiguous(self) -> bool:
        """Whether that is the verdict on its first motions."""
        return self._read("first").get("verdict") == "ambiguous"

    def begin(self) -> None:
        """Record the first motions and diagnose them."""
        self._kept("first", self._first)

    def go_on(self) -> None:
        """Add a further motion of every way, and the tests that the tool asks for."""
        first = self._read("first")
        if first.get("verdict") in (None, "explained"):
            return
        mass = self._kept("planned", partial(self._moved, "planned", "planned", LONGEST)).get("mass")
        if mass:
            self._kept("planned_mass", partial(self._moved, "planned", "planned_mass", LONGEST, load=payload_of(mass)))
        took = [said["seconds"] for name in ("planned", "planned_mass") if "result" in (said := self._read(name))]
        for way in WAYS[1:] if took else ():  # no robot time is spent where no motion would tell
            self._kept(way, partial(self._moved, way, way, took[0]))
        named = [place["effect"] for cause in first["causes"] for place in class_of(cause)]
        if any(CATALOGUE[name].adds_to_report for name in named):
            self._kept("planned_brakes", self._with_drives_off)

    def entry(self) -> dict[str, Any]:
        """The case with everything that was said."""
        first = self._read("first")
        if "error" in first:
            return {**asdict(self._case), **first}
        said = {way: self._read(way) for way in WAYS}
        tests = [self._read(name).get("result") for name in ("planned_brakes", "planned_mass")]
        return {
            **asdict(self._case),
            "first": first,
            "ways": {way: one for way, one in said.items() if "result" in one},
            "tests": next((result for result in tests if result), None),
            "missing": [f"{way}: {one['error']}" for way, one in said.items() if "error" in one],
        }

    def _read(self, name: str) -> dict[str, Any]:
        path = self._folder / f"{name}.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def _kept(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """An answer, made where it is not there yet."""
        path = self._folder / f"{name}.json"
        if not path.exists():
            try:
                said = make()
            except (AgentError, DriverError) as error:
                said = {"error": str(error)}
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, json.dumps(finite(said)) + "\n")
        return self._read(name)

    def _first(self) -> dict[str, Any]:
        self._record(self._case.effects, self._texts, list(self._texts), self._folder)
        return _said(self._diagnose(self._first_logs))

    def _moved(
        self, way: str, name: str, seconds: float, drives_off: bool = False, load: Tool | None = None
    ) -> dict[str, Any]:
        """Verdict after a strategy's motion of at most `seconds`, and its requested mass; no result without a motion.

        `name` is that of the answer; `load` is a known mass at the flange.
        """
        found, started = self._diagnose(self._first_logs, drives_off), time.process_time()
        motion = self._motion(way, found, seconds, load, ask_mass=not drives_off and load is None)
        asked = {} if motion.mass is None else {"mass": motion.mass}
        if not motion.text:
            return asked
        planning = time.process_time() - started
        folder = self._folder / name
        on_it = [] if load is None else [mounted(load)]
        texts = {**self._texts, "further": motion.text}
        log = self._record([*self._case.effects, *on_it], texts, ["further"], folder)
        write_atomically(folder / "program.pdl", motion.text)
        result = _said(self._diagnose([*self._first_logs, *log], drives_off))
        planned = {"seconds": motion.seconds, "planning_s": planning, "expected": motion.expected}
        return {**planned, "result": result, **asked}

    def _with_drives_off(self) -> dict[str, Any]:
        """With seconds with the drives off, and with a motion planned for what they leave open."""
        first = {"result": _said(self._diagnose(self._first_logs, drives_off=True))}
        if first["result"]["verdict"] == "explained":
            return first
        said = self._moved("planned", "planned_brakes", LONGEST, drives_off=True)
        return said if "result" in said else first

    def _motion(self, way: str, found: Diagnosis, seconds: float, load: Tool | None, ask_mass: bool) -> WayMotion:
        """A way's motion of at most `seconds`, with a known `load` or none; `ask_mass`: whether another mass helps."""
        if way == "planned":
            motion = plan_next(found, self._recipe, _QUIET, seconds, "further", load)
            if not isinstance(motion, NextMotion):
                return WayMotion("", 0.0, mass=motion.mass and payload_text(motion.mass.load))
            mass = clearer_loaded(found, self._recipe, motion, _QUIET) if ask_mass else None
            expected = motion.to_dict("further")["probability"]
            return WayMotion(motion.text, motion.planned.duration, expected, mass and payload_text(mass.load))
        if way == "loop_again":
            cycle = self._plan.excitation.loop.trajectory.duration
            again = replace(self._plan.excitation, name="further", cycles=max(1, round(seconds / cycle)))
            return WayMotion(again.program, again.cycles * cycle)
        pick = as_drawn
        if way == "d_optimal_pieces":
            pick = d_optimal(
                found.dataset, ExperimentScorer(found.dataset, found.selected.evidence, ()).model_information
            )
        other = run_otherwise(pick, KINDS, self._recipe, seconds, "further", (self._case.motion + 1) % 1_000_000)
        return WayMotion("", 0.0) if other is None else WayMotion(*other)

    @cached_property
    def _recipe(self) -> Recipe:
        """Where further motions may lie."""
        self._machine.mkdir(parents=True, exist_ok=True)
        return load_recipe(write_atomically(self._machine / "recipe.yaml", template(ROBOT, "127.0.0.1:9", cycles=2)))

    @cached_property
    def _plan(self) -> Plan:
        """Program of the first motion: the recipe's excitation loop, after a short search."""
        return make_plan(_short(self._recipe, self._case.motion, 0), _QUIET)

    @cached_property
    def _texts(self) -> dict[str, str]:
        """Programs of the first motions."""
        return _programs(self._plan)

    @property
    def _first_logs(self) -> list[Path]:
        return [self._folder / f"{name}.mcap" for name in self._texts]

    @cached_property
    def _model(self) -> IdentifiedModel:
        """Model of the same machine without an effect, from other motions than those of its runs."""
        path = self._machine.with_suffix(".json")
        if not path.exists():
            recipe = _short(self._recipe, self._case.machine, 2)
            texts = _programs(make_plan(recipe, _QUIET))
            logs = self._record((), texts, list(texts), self._machine)
            estimate(recipe.robot, [read_log(log, recipe.robot) for log in logs]).save(path)
        return IdentifiedModel.load(path)

    def _record(
        self, effects: Sequence[Mapping[str, Any]], texts: Mapping[str, str], keep: Sequence[str], folder: Path
    ) -> list[Path]:
        """Run the programs one after the other on the case's machine; paths of the logs to keep."""
        logs = record_motions(ROBOT, self._case.machine, effects, texts, folder, self._recipe)
        for log in logs:
            if log.stem not in keep:
                log.unlink()
        return [log for log in logs if log.stem in keep]

    def _diagnose(self, logs: Sequence[Path], drives_off: bool = False) -> Diagnosis:
        robot = self._recipe.robot
        # This controller's path is not quite the planned one, with an effect or without.
        read = [replace(_as_recorded(read_log(log, robot)), planned_position=None) for log in logs]
        at_rest = with_drives_off(read[0], self._case.effects) if drives_off else None
        return diagnose(robot, read, self._model, drives_off=at_rest)


def mounted(load: Tool) -> dict[str, Any]:
    """A known mass at the flange as machines are given it: as an effect."""
    centre = np.zeros(3) if load.centre_of_mass is None else load.centre_of_mass
    return {"effect": "payload", "joints": [], "parameters": {"mass": load.mass, "centre": centre.tolist()}}


def with_drives_off(log: Log, effects: Sequence[Mapping[str, Any]]) -> Log:
    """A log of the resting arm where another log ended: noise about the zero of every channel, or about its offset."""
    assert log.effort is not None
    count = round(_DRIVES_OFF * log.sample_rate)
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


def _as_recorded(log: Log) -> Log:
    """What `agent record` notes in the log of a motion that was put together from pieces, and of a mass on it."""
    if log.path.stem != "further" or log.path.parent.name == "loop_again":
        return log
    load = planned_load(log.path.with_name("program.pdl").read_text(encoding="utf-8"))
    mass = {} if load is None else {PAYLOAD: load}
    return replace(log, metadata={**log.metadata, PARTS: PLANNED_PARTS, **mass})


def _short(recipe: Recipe, seed: int, motions: int) -> Recipe:
    """A short search, and a number of validation motions, of a seed."""
    seed %= 1_000_000
    search = recipe.search.model_copy(update={"population": 8, "generations": 3, "seed": seed})
    validate = recipe.validate.model_copy(update={"motions": motions, "speed": 0.4, "seed": seed})
    return replace(recipe, search=search, validate=validate)


def _programs(plan: Plan) -> dict[str, str]:
    return {motion.name: motion.program for motion in (plan.excitation, *plan.validation)}


def _said(found: Diagnosis) -> dict[str, Any]:
    return {key: found.result[key] for key in ("verdict", "causes", "closure")}


def run_otherwise(
    pick: Pick, kinds: Sequence[str], recipe: Recipe, seconds: float, name: str, seed: int
) -> tuple[str, float] | None:
    """Text and duration [s] of a motion chosen in another way than by what it separates; None where none can run.

    Pieces of the `kinds` are picked one after the other, while all of them with the moves
    between them take no longer than `seconds`.

    Raises:
        InputError: the recipe's cell allows no motion.
    """
    runs = RunnablePieces(recipe, name, seconds)
    if not pieces_otherwise(pick, loop_problem(recipe, recipe.motion.speed), seconds, seed, runs, kinds):
        return None
    assert runs.motion is not None
    return runs.motion.text, runs.motion.duration
