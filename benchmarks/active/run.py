"""A run of a blind check with further motions: recorded, asked, answered, every answer in a file of its own."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import AgentError, Console, finite, write_atomically
from agent.experiment import Pick, pieces_otherwise
from agent.pipeline.gap.next_experiment import LONGEST, NextMotion, Runs, clearer_with_mass, motion_duration, plan_next
from agent.pipeline.plan import Plan, loop_problem, make_plan, program_text
from agent.recipe import Recipe
from benchmarks.active.machines import ActiveWorld, Job, mounted, on_brakes
from benchmarks.active.scoring import WAYS, class_of
from drivers.errors import DriverError

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.pipeline.gap.next_experiment import WithMass
    from agent.recording import Log
    from agent.robot import Tool
    from fake_controller.withheld.cases import Case

_QUIET = Console(verbosity=-1)
#: Further motions of a run.
ROUNDS = 2


@dataclass(frozen=True)
class WayMotion:
    """The next motion of a way: its program (empty where it has none), duration [s], what is expected of it, and the
    mass at the flange that is asked for, if any."""

    text: str
    seconds: float
    expected: Sequence[Mapping[str, Any]] = ()
    mass: str | None = None


class ActiveRun:
    """One run: what is said after its first motions, and after every further one of every way."""

    def __init__(self, world: ActiveWorld, case: Case, folder: Path):
        self._world, self._case = world, case
        self._folder = folder / "runs" / f"{case.number:04d}"
        self._machine = folder / "machines" / f"{case.number:04d}"
        self._found: dict[tuple[tuple[Path, ...], bool], Diagnosis] = {}

    @property
    def number(self) -> int:
        """As drawn."""
        return self._case.number

    @property
    def ambiguous(self) -> bool:
        """Whether that is what its first motions came to."""
        return self._read("first").get("verdict") == "ambiguous"

    def go_on(self, rounds: int) -> None:
        """Whatever is missing of the first motions and so many further ones of each way."""
        first = self._kept("first", self._begin)
        for way in WAYS if first.get("verdict") not in (None, "explained") else ():
            if way != "planned":
                if rounds and self._read("planned1").get("mass"):
                    self._kept("planned_mass", self._with_mass)
                if not self._seconds(1):
                    break  # no robot time is spent on it
            last = first
            for number in range(1, rounds + 1):
                if last["verdict"] == "explained" or (last["verdict"] == "no_gap" and number > 1):
                    break
                said = self._kept(f"{way}{number}", partial(self._further, way, number))
                if "result" not in said:
                    break
                last = said["result"]
        if rounds and first.get("verdict") not in (None, "explained") and _may_be_of_channel(first):
            self._kept("brakes", self._on_brakes)
            for way in WAYS:
                self._kept(f"{way}_brakes", partial(self._beside_brakes, way))
        self._found.clear()

    def entry(self) -> dict[str, Any]:
        """The case with everything that was said."""
        first = self._read("first")
        if "error" in first:
            return {**self._case.to_dict(), **first}
        ways: dict[str, list[dict[str, Any]]] = {}
        missing = []
        for way in WAYS:
            said = [self._read(f"{way}{number}") for number in range(1, ROUNDS + 1)]
            ways[way] = [one for one in said if "result" in one]
            missing += [f"{way}: {one['error']}" for one in said if "error" in one]
        answers = {way: self._read(f"{way}_brakes") for way in WAYS}
        beside = {way: answer["result"] for way, answer in answers.items() if "result" in answer}
        tests = {"brakes": beside, "mass": self._read("planned_mass").get("result")}
        return {**self._case.to_dict(), "first": first, "ways": ways, **tests, "missing": missing}

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

    def _begin(self) -> dict[str, Any]:
        logs = self._record(self._case.effects, self._texts, list(self._texts), self._folder)
        return _said(self._diagnose(logs))

    def _further(self, way: str, number: int) -> dict[str, Any]:
        """One further motion of a way: seconds, what was expected, what all logs then say; empty where it has none."""
        seconds = LONGEST if way == "planned" else self._seconds(number) or LONGEST
        before = {f"further{k}": self._folder / f"{way}{k}" for k in range(1, number)}
        return self._moved(way, f"{way}{number}", before, seconds)

    def _seconds(self, number: int) -> float | None:
        """What the planned motion of a round took, bare or with the mass that was asked for; None: there is none."""
        names = [f"planned{number}", *(["planned_mass"] if number == 1 else [])]
        return next((said["seconds"] for name in names if "result" in (said := self._read(name))), None)

    def _with_mass(self) -> dict[str, Any]:
        """What is said after the motion planned with the mass that was asked for."""
        from agent.model import payload_of

        return self._moved("planned", "planned_mass", {}, LONGEST, load=payload_of(self._read("planned1")["mass"]))

    def _moved(
        self,
        way: str,
        name: str,
        before: Mapping[str, Path],
        seconds: float,
        brakes: bool = False,
        load: Tool | None = None,
    ) -> dict[str, Any]:
        """What is said after a way's next motion of at most so many `seconds`, and the mass that it asks for; no result
        where it has none.

        `name` is that of the answer, `before` are the folders of its further motions until then, by name, `load` a mass
        at the flange.
        """
        logs = [self._folder / f"{program}.mcap" for program in self._texts]
        logs += [folder / f"{program}.mcap" for program, folder in before.items()]
        found, number = self._diagnose(logs, brakes), len(before) + 1
        started, program = time.process_time(), f"further{number}"
        mass = not before and not brakes and load is None
        motion = self._motion(way, found, seconds, program, self._case.motion + number, load, mass)
        asked = {} if motion.mass is None else {"mass": motion.mass}
        if not motion.text:
            return asked
        planning = time.process_time() - started
        texts = self._texts | {there: (folder / "program.pdl").read_text() for there, folder in before.items()}
        folder = self._folder / name
        on_it = [] if load is None else [mounted(load)]
        logs += self._record([*self._case.effects, *on_it], {**texts, program: motion.text}, [program], folder)
        write_atomically(folder / "program.pdl", motion.text)
        result = _said(self._diagnose(logs, brakes))
        planned = {"seconds": motion.seconds, "planning_s": planning, "expected": motion.expected}
        return {**planned, "result": result, **asked}

    def _on_brakes(self) -> dict[str, Any]:
        """What the first motions say with seconds on the brakes."""
        return {"result": _said(self._diagnose([self._folder / f"{name}.mcap" for name in self._texts], True))}

    def _beside_brakes(self, way: str) -> dict[str, Any]:
        """What a way's first further motion says with seconds on the brakes before it."""
        first = self._read("brakes")["result"]
        planned = self._read("planned_brakes")
        if first["verdict"] == "explained" or (way != "planned" and planned.get("seconds") is None):
            return {"result": first}  # no robot time is spent
        if way != "planned" and "result" in self._read(f"{way}1"):
            logs = [self._folder / f"{name}.mcap" for name in self._texts] + [
                self._folder / f"{way}1" / "further1.mcap"
            ]
            return {"result": _said(self._diagnose(logs, True))}
        seconds = LONGEST if way == "planned" else planned["seconds"]
        said = self._moved(way, f"{way}_brakes", {}, seconds, True)
        return said if "result" in said else {"result": first}

    def _motion(
        self,
        way: str,
        found: Diagnosis,
        seconds: float,
        name: str,
        seed: int,
        load: Tool | None = None,
        mass: bool = False,
    ) -> WayMotion:
        """A way's next motion of at most so many `seconds`, with a known `load` at the flange or none; `mass`: whether
        one beside it is asked about."""
        from agent.experiment import KINDS, LOOPS, Outlook, as_drawn, d_optimal

        if way == "planned":
            motion = plan_next(found, self._recipe, _QUIET, seconds, name, load)
            if not isinstance(motion, NextMotion):
                return WayMotion("", 0.0, mass=_text_of(motion.mass))
            beside = clearer_with_mass(found, self._recipe, motion, _QUIET) if mass else None
            return WayMotion(motion.text, motion.duration, motion.to_dict(name)["probability"], _text_of(beside))
        if way == "loop_again":
            cycle = self._plan.excitation.loop.trajectory.duration
            again = replace(self._plan.excitation, name=name, cycles=max(1, round(seconds / cycle)))
            return WayMotion(program_text(self._recipe, again), again.cycles * cycle)
        pick = (
            as_drawn
            if way.startswith("random")
            else d_optimal(found.dataset, Outlook(found.dataset, found.finding.evidence, ()).model_information)
        )
        kinds = LOOPS if way.endswith("loops") else KINDS
        other = run_otherwise(pick, kinds, self._recipe, seconds, name, seed % 1_000_000)
        return WayMotion("", 0.0) if other is None else WayMotion(*other)

    @cached_property
    def _recipe(self) -> Recipe:
        """Where further motions may lie."""
        return self._world.recipe(self._case, self._machine)

    @cached_property
    def _plan(self) -> Plan:
        """Of the first motion: the recipe's excitation loop, after a short search."""
        return make_plan(_short(self._recipe, self._case.motion, 0), _QUIET)

    @cached_property
    def _texts(self) -> dict[str, str]:
        """Programs of the first motions."""
        return _programs(self._recipe, self._plan)

    @cached_property
    def _model(self) -> Path:
        """Of the same machine without an effect, from other motions than those of its runs."""
        from agent.estimation import estimate
        from agent.recording import read_log

        path = self._machine.with_suffix(".json")
        if not path.exists():
            recipe = _short(self._world.recipe(self._case, self._machine), self._case.machine, 2)
            texts = _programs(recipe, make_plan(recipe, _QUIET))
            logs = self._record((), texts, list(texts), self._machine, recipe)
            estimate(recipe.robot, [read_log(log, recipe.robot) for log in logs]).save(path)
        return path

    def _record(
        self,
        effects: Sequence[Mapping[str, Any]],
        texts: Mapping[str, str],
        keep: Sequence[str],
        folder: Path,
        recipe: Recipe | None = None,
    ) -> list[Path]:
        """Run the programs one after the other on the case's machine; paths of the logs to keep."""
        folder.mkdir(parents=True, exist_ok=True)
        for log in (folder / f"{name}.mcap" for name in texts):
            log.unlink(missing_ok=True)  # of a check that was stopped in the middle of it
        self._world.run(Job(self._case, effects, recipe or self._recipe, texts, keep, folder))
        return [folder / f"{name}.mcap" for name in keep]

    def _diagnose(self, logs: Sequence[Path], brakes: bool = False) -> Diagnosis:
        """Remembered while this run is gone on with; `brakes`: beside a log on the brakes."""
        from agent.diagnosis import diagnose
        from agent.model import IdentifiedModel
        from agent.recording import read_log

        key = tuple(logs), brakes
        if key not in self._found:
            robot = self._recipe.robot
            # this controller's path is not quite what we planned, with an effect or without
            read = [replace(_as_recorded(read_log(log, robot)), planned_position=None) for log in logs]
            at_rest = on_brakes(read[0], self._case.effects) if brakes else None
            self._found[key] = diagnose(robot, read, IdentifiedModel.load(self._model), drives_off=at_rest)
        return self._found[key]


def _text_of(mass: WithMass | None) -> str | None:
    """What is to be mounted, as `agent.model.payload_of` reads it."""
    from agent.model import payload_text

    return None if mass is None else payload_text(mass.load)


def _may_be_of_channel(said: Mapping[str, Any]) -> bool:
    """Whether an answer has an offset of a torque channel in it."""
    from agent.model import CATALOGUE

    return any(CATALOGUE[place["effect"]].adds_to_report for cause in said["causes"] for place in class_of(cause))


def _as_recorded(log: Log) -> Log:
    """What `agent record` says in the log of a motion that was put together from pieces, and of a mass on it."""
    from agent.link import planned_load
    from agent.model import PAYLOAD
    from agent.recording import PARTS, PLANNED_PARTS

    if not log.path.stem.startswith("further") or log.path.parent.name.startswith("loop_again"):
        return log
    load = planned_load(log.path.with_name("program.pdl").read_text(encoding="utf-8"))
    mass = {} if load is None else {PAYLOAD: load}
    return replace(log, metadata={**log.metadata, PARTS: PLANNED_PARTS, **mass})


def _short(recipe: Recipe, seed: int, motions: int) -> Recipe:
    """A short search, and so many validation motions, of a seed."""
    seed %= 1_000_000
    search = recipe.search.model_copy(update={"population": 8, "generations": 3, "seed": seed})
    validate = recipe.validate.model_copy(update={"motions": motions, "speed": 0.4, "seed": seed})
    return replace(recipe, search=search, validate=validate)


def _programs(recipe: Recipe, plan: Plan) -> dict[str, str]:
    motions = (plan.excitation, *plan.validation)
    return {motion.name: program_text(recipe, motion) for motion in motions}


def _said(found: Diagnosis) -> dict[str, Any]:
    from agent.diagnosis import smallest_sizes

    keys = ("verdict", "causes", "closure")
    said = {key: found.result[key] for key in keys}
    if said["verdict"] == "no_gap":
        names = found.dataset.robot.joint_names
        sizes = smallest_sizes(found.dataset, found.finding.evidence).items()
        said["smallest"] = {" ".join((effect, *(names[j] for j in joints))): size for (effect, joints), size in sizes}
    return said


def run_otherwise(
    pick: Pick, kinds: Mapping[str, float], recipe: Recipe, seconds: float, name: str, seed: int
) -> tuple[str, float] | None:
    """Text and duration [s] of a motion chosen in another way than by what it separates; None where none can run.

    Pieces of the `kinds` (how often each is drawn) are picked one after the other, while all of them with the moves
    between them take no longer than `seconds`.

    Raises:
        InputError: the recipe's cell leaves no room.
    """
    runs = Runs(recipe, name, seconds)
    if not pieces_otherwise(pick, loop_problem(recipe, recipe.motion.speed), seconds, seed, runs, kinds):
        return None
    assert runs.motion is not None
    text, chains = runs.motion
    return text, motion_duration(text, chains, recipe.robot, recipe.dialect)
