"""A blind check whose runs may ask further motions: the one planned for what is open, and other ways to use its time.

Every way starts from the same first recording, a quick look by a loop in a part of a recipe's sub-region, gets the same
robot time, and is diagnosed with all logs before it. A way's motions run after the first one on the same machine, so it
is as warm as it would be. Diagnosis and planning are given logs, model and recipe; the key is sealed before them.

Where the first answer may be an offset of a torque channel, the tool asks for seconds of the arm on its brakes. So
every way has a second answer there, after its first further motion, with them; the planned motion is planned anew for
what they leave open. Nothing stands on brakes here: the log is noise about the zero of every channel.

Every answer is kept in a file of its own, and a check that was stopped goes on with the next one. The first motions of
all runs come first: they take seconds, and say where the dear rest is worth it. Then the runs that are ambiguous get a
further motion of every way, the others that are not `explained` after them, and second ones last. Where nothing was
found the question is what would have been: one further motion of every way, and the smallest sizes before and after it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import AgentError, Console, InputError, finite, write_atomically
from agent.pipeline.active_worlds import ActiveWorld, ControllerMachines, Job, MujocoMachines, on_brakes
from agent.pipeline.next_experiment import LONGEST, NextMotion, plan_next, run_otherwise
from agent.pipeline.planning import Plan, make_plan, program_text
from agent.recipe import Recipe
from drivers.errors import DriverError

if TYPE_CHECKING:
    from agent.blind_check import Case
    from agent.diagnosis import Diagnosis
    from agent.recording import Log

_QUIET = Console(verbosity=-1)
#: Further motions of a run.
_ROUNDS = 2
#: Of the sub-region's sides, where the first loop lies.
_LOOK_PART = 0.25
WORLDS = ("emulator", "mujoco")


@dataclass(frozen=True)
class ActiveCheck:
    """What to do: runs, seed, folder (gone on with), the world, of WORLDS, and the emulator's robot."""

    count: int
    seed: int
    folder: Path
    world: str = "emulator"
    robot: str = "comau_ns16"

    @cached_property
    def _world(self) -> ActiveWorld:
        return MujocoMachines() if self.world == "mujoco" else ControllerMachines(self.robot)

    def run(self, console: Console) -> dict[str, Any]:
        """Do what is not done yet; returns the scores, which are also in `active_check.json`.

        Raises:
            InputError: no runs, no such world, or a folder with another check in it.
        """
        from agent.blind_check import active_scores, key_text, open_key, seal

        if self.count < 1:
            raise InputError(f"blind check: --cases {self.count}: at least one run is needed")
        if self.world not in WORLDS:
            raise InputError(f"blind check: --world {self.world}: there is no such world; one of {', '.join(WORLDS)}")
        cases = self._world.draw(self.count, self.seed)
        text = key_text(self.seed, f"{self._world.title}, further motions", cases)
        digest = seal(self.folder, text)
        console.step(f"{self.count} runs; SHA-256 of the key, which stays closed until the last diagnosis: {digest}")
        runs = [ActiveRun(self._world, case, self.folder) for case in cases]
        for number, run in enumerate(runs):
            run.go_on(0)
            console.progress(f"first motions: {number + 1} of {self.count} runs", (number + 1) / self.count)
        runs.sort(key=lambda run: not run.ambiguous)
        for rounds in range(1, _ROUNDS + 1):
            for number, run in enumerate(runs):
                run.go_on(rounds)
                done = ((rounds - 1) * len(runs) + number + 1) / (_ROUNDS * len(runs))
                console.progress(f"further motion {rounds} of {_ROUNDS}: {number + 1} of {self.count} runs", done)
        runs.sort(key=lambda run: run.number)
        open_key(self.folder, text)
        scores = {"schema": "active-check/1", "key_sha256": digest, "world": self._world.title}
        scores |= active_scores([run.entry() for run in runs])
        write_atomically(self.folder / "active_check.json", json.dumps(scores, indent=1) + "\n")
        return scores


class ActiveRun:
    """One run: what is said after its first motions, and after every further one of every way."""

    def __init__(self, world: ActiveWorld, case: Case, folder: Path):
        self._world, self._case = world, case
        self._folder = folder / "runs" / f"{case.number:04d}"
        #: Machines are numbered as they come: their seed would tell of the key.
        self._machine = folder / "machines" / f"{case.number // world.group:04d}"
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
        from agent.blind_check import WAYS

        first = self._kept("first", self._begin)
        for way in WAYS if first.get("verdict") not in (None, "explained") else ():
            if way != "planned" and "result" not in self._read("planned1"):
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
        from agent.blind_check import WAYS

        first = self._read("first")
        if "error" in first:
            return {**self._case.to_dict(), **first}
        ways: dict[str, list[dict[str, Any]]] = {}
        missing = []
        for way in WAYS:
            said = [self._read(f"{way}{number}") for number in range(1, _ROUNDS + 1)]
            ways[way] = [one for one in said if "result" in one]
            missing += [f"{way}: {one['error']}" for one in said if "error" in one]
        answers = {way: self._read(f"{way}_brakes") for way in WAYS}
        beside = {way: answer["result"] for way, answer in answers.items() if "result" in answer}
        return {**self._case.to_dict(), "first": first, "ways": ways, "brakes": beside, "missing": missing}

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
        planned = self._read(f"planned{number}")
        seconds = planned["seconds"] if way != "planned" and "result" in planned else LONGEST
        before = {f"further{k}": self._folder / f"{way}{k}" for k in range(1, number)}
        return self._moved(way, f"{way}{number}", before, seconds)

    def _moved(
        self, way: str, name: str, before: Mapping[str, Path], seconds: float, brakes: bool = False
    ) -> dict[str, Any]:
        """What is said after a way's next motion of at most so many `seconds`; empty where it has none.

        `name` is that of the answer, `before` are the folders of its further motions until then, by name.
        """
        logs = [self._folder / f"{program}.mcap" for program in self._texts]
        logs += [folder / f"{program}.mcap" for program, folder in before.items()]
        found, number = self._diagnose(logs, brakes), len(before) + 1
        started, program = time.process_time(), f"further{number}"
        motion = self._motion(way, found, seconds, program, self._case.motion + number)
        if motion is None:
            return {}
        text, seconds, expected = motion
        planning = time.process_time() - started
        texts = self._texts | {there: (folder / "program.pdl").read_text() for there, folder in before.items()}
        folder = self._folder / name
        logs += self._record(self._case.effects, {**texts, program: text}, [program], folder)
        write_atomically(folder / "program.pdl", text)
        result = _said(self._diagnose(logs, brakes))
        return {"seconds": seconds, "planning_s": planning, "expected": expected, "result": result}

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
        return self._moved(way, f"{way}_brakes", {}, seconds, True) or {"result": first}

    def _motion(
        self, way: str, found: Diagnosis, seconds: float, name: str, seed: int
    ) -> tuple[str, float, list[dict[str, Any]]] | None:
        """Text, duration [s] and what is expected of a way's next motion; None where it has none."""
        from agent.experiment import KINDS, LOOPS, as_drawn, d_optimal

        if way == "planned":
            motion = plan_next(found, self._recipe, _QUIET, seconds, name)
            if not isinstance(motion, NextMotion):
                return None
            return motion.text, motion.duration, motion.to_dict(name)["probability"]
        if way == "loop_again":
            cycle = self._plan.excitation.loop.trajectory.duration
            again = replace(self._plan.excitation, name=name, cycles=max(1, round(seconds / cycle)))
            return program_text(self._recipe, again), again.cycles * cycle, []
        pick = as_drawn if way.startswith("random") else d_optimal(found.dataset)
        kinds = LOOPS if way.endswith("loops") else KINDS
        other = run_otherwise(pick, kinds, self._recipe, seconds, name, seed % 1_000_000)
        return None if other is None else (*other, [])

    @cached_property
    def _recipe(self) -> Recipe:
        """Where further motions may lie."""
        return self._world.recipe(self._case, self._machine)

    @cached_property
    def _plan(self) -> Plan:
        """Of the first motion: a loop in a part of the sub-region."""
        short = _short(self._recipe, self._case.motion, 0)
        via = short.motion.via_points
        assert via.box is not None
        box = via.box.model_copy(update={"size": tuple(_LOOK_PART * side for side in via.box.size)})
        motion = replace(short.motion, via_points=via.model_copy(update={"box": box}))
        return make_plan(replace(short, motion=motion), _QUIET)

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


def _may_be_of_channel(said: Mapping[str, Any]) -> bool:
    """Whether an answer has an offset of a torque channel in it."""
    from agent.blind_check import class_of
    from agent.model import CATALOGUE

    return any(CATALOGUE[place["effect"]].adds_to_report for cause in said["causes"] for place in class_of(cause))


def _as_recorded(log: Log) -> Log:
    """What `agent record` says in the log of a motion that was put together from pieces."""
    from agent.recording import PARTS, PLANNED_PARTS

    of_pieces = log.path.stem.startswith("further") and not log.path.parent.name.startswith("loop_again")
    return replace(log, metadata={**log.metadata, PARTS: PLANNED_PARTS}) if of_pieces else log


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
        sizes = smallest_sizes(found.dataset).items()
        said["smallest"] = {" ".join((effect, *(names[j] for j in joints))): size for (effect, joints), size in sizes}
    return said
