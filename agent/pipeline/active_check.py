"""A blind check whose runs may ask further motions: the one planned for what is open, and other ways to use its time.

Every way starts from the same first recording, of a recipe's excitation loop and validation motions, gets the same
robot time, and is diagnosed with all logs before it. A way's motions run after the first ones on the same machine, so
it is as warm as it would be. Diagnosis and planning are given logs, model and recipe; the key is sealed before them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import AgentError, Console, InputError, finite, write_atomically
from agent.pipeline.next_experiment import LONGEST, NextMotion, plan_next, run_otherwise
from agent.pipeline.planning import Plan, checked_chains, make_plan, program_text
from agent.recipe import Recipe, load_recipe
from drivers.errors import DriverError

if TYPE_CHECKING:
    from agent.blind_check import Case
    from agent.diagnosis import Diagnosis

_QUIET = Console(verbosity=-1)
_NOWHERE = "127.0.0.1:9"
#: Further motions of a run.
_ROUNDS = 2
_SETTLED = ("explained", "no_gap")
#: A short job in the sub-region that `agent init` proposes: what is compared is what comes after it.
_RECIPE = """\
robot: {robot}
controller: {{driver: tcp, address: "{address}"}}
motion:
  speed: 1 m/s
  fly: {{type: FLY_CART, trajectory: FLY_TOL, distance: 20 mm}}
  via_points:
    count: 6
    box:
      centre: [1 m, 0 m, 0.8 m]
      size: [500 mm, 600 mm, 400 mm]
      orientation: [0 deg, 180 deg, 0 deg]
      cone: 30 deg
search: {{population: 8, generations: 3, seed: {seed}}}
record: {{cycles: 2}}
validate: {{motions: 2, speed: 0.4 m/s, seed: {seed}}}
"""


@dataclass(frozen=True)
class ActiveCheck:
    """What to do: runs, seed, folder (gone on with), and the emulator's robot."""

    count: int
    seed: int
    folder: Path
    robot: str = "comau_ns16"

    def run(self, console: Console) -> dict[str, Any]:
        """Do what is not done yet; returns the scores, which are also in `active_check.json`.

        Raises:
            InputError: no runs, or a folder with another check in it.
        """
        from agent.blind_check import active_scores, draw_cases, key_text, open_key, seal
        from agent.robot import load_robot

        if self.count < 1:
            raise InputError(f"blind check: --cases {self.count}: at least one run is needed")
        cases = draw_cases(self.count, self.seed, load_robot(self.robot))
        text = key_text(self.seed, f"{self.robot}, further motions", cases)
        digest = seal(self.folder, text)
        console.step(f"{self.count} runs; SHA-256 of the key, which stays closed until the last diagnosis: {digest}")
        for number, case in enumerate(cases):
            kept = self._kept(case)
            if not kept.exists():
                try:
                    found = self._one(case)
                except (AgentError, DriverError) as error:
                    found = {"error": str(error)}
                kept.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(kept, json.dumps(finite(found)) + "\n")
            console.progress(f"{number + 1} of {self.count} runs diagnosed", (number + 1) / self.count)
        open_key(self.folder, text)
        entries = [{**case.to_dict(), **json.loads(self._kept(case).read_text(encoding="utf-8"))} for case in cases]
        scores = {"schema": "active-check/1", "key_sha256": digest, "robot": self.robot, **active_scores(entries)}
        write_atomically(self.folder / "active_check.json", json.dumps(scores, indent=1) + "\n")
        return scores

    def _kept(self, case: Case) -> Path:
        return self.folder / "runs" / f"{case.number:04d}.json"

    def _one(self, case: Case) -> dict[str, Any]:
        """What is said of a run after its first motions, and after those of every way."""
        from agent.blind_check import WAYS

        folder = self.folder / "runs" / f"{case.number:04d}"
        model = self._model(case)
        recipe = self._recipe(case.motion)
        plan = make_plan(recipe, _QUIET)
        first = _first(recipe, plan)
        logs = self._record(case, case.effects, recipe, first, list(first), folder)
        begun = self._diagnose(recipe, logs, model)
        ways: dict[str, list[dict[str, Any]]] = {}
        if begun.result["verdict"] not in _SETTLED:
            spent: list[float] = []
            for way in WAYS:
                ways[way] = self._way(way, case, recipe, plan, first, logs, begun, model, spent, folder / way)
                spent = spent or [one["seconds"] for one in ways[way]]
        return {"first": _said(begun), "ways": ways}

    def _way(
        self,
        way: str,
        case: Case,
        recipe: Recipe,
        plan: Plan,
        first: Mapping[str, str],
        logs: Sequence[Path],
        begun: Diagnosis,
        model: Path,
        spent: Sequence[float],
        folder: Path,
    ) -> list[dict[str, Any]]:
        """Rounds of one way: seconds, what was expected, what all logs then say."""
        found, texts, recorded, rounds = begun, dict(first), list(logs), []
        for number in range(_ROUNDS):
            seconds = spent[number] if number < len(spent) else LONGEST
            name = f"further{number + 1}"
            started = time.process_time()
            motion = _motion(way, found, recipe, plan, seconds, name, case.motion + number)
            if motion is None:
                break
            text, seconds, expected = motion
            planning = time.process_time() - started
            texts[name] = text
            recorded += self._record(case, case.effects, recipe, texts, [name], folder)
            found = self._diagnose(recipe, recorded, model)
            said = {"seconds": seconds, "planning_s": planning, "expected": expected, "result": _said(found)}
            rounds.append(said)
            if found.result["verdict"] in _SETTLED:
                break
        return rounds

    def _recipe(self, seed: int) -> Recipe:
        """Motions of a seed; the controller is said when there is one."""
        path = self.folder / "recipe.yaml"
        text = _RECIPE.format(robot=self.robot, address=_NOWHERE, seed=seed % 1_000_000)
        return load_recipe(write_atomically(path, text))

    def _model(self, case: Case) -> Path:
        """Of the same machine without an effect, from other motions than those of its runs."""
        from agent.estimation import estimate
        from agent.recording import read_log

        path = self.folder / "machines" / f"{case.machine}.json"
        if not path.exists():
            recipe = self._recipe(case.machine)
            texts = _first(recipe, make_plan(recipe, _QUIET))
            logs = self._record(case, (), recipe, texts, list(texts), path.with_suffix(""))
            estimate(recipe.robot, [read_log(log, recipe.robot) for log in logs]).save(path)
        return path

    def _record(
        self,
        case: Case,
        effects: Sequence[Mapping[str, Any]],
        recipe: Recipe,
        texts: Mapping[str, str],
        keep: Sequence[str],
        folder: Path,
    ) -> list[Path]:
        """Run the programs one after the other on the case's machine; paths of the logs to keep."""
        from agent.blind_check import fake_controller
        from agent.link import open_link

        folder.mkdir(parents=True, exist_ok=True)
        with fake_controller(self.robot, case.machine, effects, ("--interpolator", "ours")) as address:
            there = replace(recipe, controller=recipe.controller.model_copy(update={"address": address}))
            with open_link(there, _QUIET, True, folder) as link:
                for name, text in texts.items():
                    log = folder / f"{name}.mcap"
                    log.unlink(missing_ok=True)  # of a check that was stopped in the middle of it
                    program, chains = checked_chains(there, text, f"{name}.pdl", link.position())
                    link.run(program, text, log, name, chains, sum(chain.duration for chain in chains))
        for name in set(texts) - set(keep):
            (folder / f"{name}.mcap").unlink()
        return [folder / f"{name}.mcap" for name in keep]

    def _diagnose(self, recipe: Recipe, logs: Sequence[Path], model: Path) -> Diagnosis:
        from agent.diagnosis import diagnose
        from agent.model import IdentifiedModel
        from agent.recording import read_log

        return diagnose(recipe.robot, [read_log(log, recipe.robot) for log in logs], IdentifiedModel.load(model))


def _first(recipe: Recipe, plan: Plan) -> dict[str, str]:
    motions = (plan.excitation, *plan.validation)
    return {motion.name: program_text(recipe, motion) for motion in motions}


def _motion(
    way: str, found: Diagnosis, recipe: Recipe, plan: Plan, seconds: float, name: str, seed: int
) -> tuple[str, float, list[dict[str, Any]]] | None:
    """Text, duration [s] and what is expected of a way's next motion; None where it has none."""
    from agent.experiment import d_optimal_pieces, random_pieces

    if way == "planned":
        motion = plan_next(found, recipe, _QUIET, seconds, name)
        if not isinstance(motion, NextMotion):
            return None
        return motion.text, motion.duration, motion.to_dict(name)["probability"]
    if way == "loop_again":
        cycle = plan.excitation.loop.trajectory.duration
        again = replace(plan.excitation, name=name, cycles=max(1, round(seconds / cycle)))
        return program_text(recipe, again), again.cycles * cycle, []
    choose = random_pieces if way == "random" else d_optimal_pieces
    other = run_otherwise(choose, found, recipe, seconds, name, seed % 1_000_000)
    return None if other is None else (*other, [])


def _said(found: Diagnosis) -> dict[str, Any]:
    keys = ("verdict", "causes", "closure")
    return {key: found.result[key] for key in keys}
