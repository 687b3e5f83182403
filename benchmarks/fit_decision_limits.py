"""Fits the tuned limits of the diagnosis on one set of draws and judges them on another.

`python benchmarks/fit_decision_limits.py --keep FOLDER [--robot R] [--cases N] [--seed S] [--seconds T]
[--only LIMIT…] [--every]`

Runs are drawn as the blind check draws them (`fake_controller.withheld.cases`), followed by the fake controller's
plant, and diagnosed with the limits as they are, and with each tuned limit a step down and up. A limit moves where the
cost of
what comes out falls; those moved are then tried together on draws of the next seed, beside the limits as they are. How
often an outcome changes is the limit's sensitivity; with --every that is all that is done, for every limit that these
runs meet. Every diagnosis is kept in FOLDER, so a rerun goes on where the last one stopped; with --seconds it stops by
itself, after the run it is at.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from agent.blind_check import outcome
from agent.diagnosis.dataset import Dataset, assemble
from agent.diagnosis.limits import LIMITS, TUNED, DecisionLimits, described
from agent.diagnosis.motion_gap import motion_gap
from agent.diagnosis.procedure import Search
from agent.diagnosis.result import build
from agent.diagnosis.verdict import judge
from agent.estimation import estimate
from agent.robot import RobotDescription, load_robot
from benchmarks.diagnosis_matrix import MOTIONS, cached, record
from fake_controller.withheld.cases import Case, draw_cases
from tests.small_arms import make_arm

STEP = 1.25
#: Of an outcome: a false alarm sends somebody to a healthy arm, a wrong name to the wrong part of it.
COST = {"named": 0.0, "in class": 0.25, "unknown": 1.0, "no gap": 1.0, "wrong class": 1.0, "wrong name": 2.0}
#: The right answer where no name is.
RIGHT = {"none": "no gap", "outside": "unknown"}
FALSE_ALARM = 4.0
AS_IS, FITTED = "as they are", "fitted"
#: Limits by which the data are put together, so that a run with another one starts from its logs.
IN_DATA = ("stiction", "least_background", "least_travel", "block", "parity", "near_rest")
#: Limits that no run drawn here meets: no model given, a simulator's file, one log, a warning only.
NOT_MET = ("unknown_error", "least_error", "guard", "shortest", "clipped_share")


def moved(limits: DecisionLimits, name: str, factor: float) -> DecisionLimits:
    """The limits with one of them `factor` times as large; of a share close to all, what is left of it."""

    def scaled(value: float) -> float:
        if isinstance(value, int):
            return round(value * factor)
        return 1 - (1 - value) * factor if 0.85 < value < 1 else value * factor

    value = getattr(limits, name)
    return replace(limits, **{name: tuple(map(scaled, value)) if isinstance(value, tuple) else scaled(value)})


def variations(only: Sequence[str] | None = None, every: bool = False) -> dict[str, DecisionLimits]:
    """The limits as they are, and each tuned one, all or some of them, a step down and up."""
    steps = {"/": 1 / STEP, "×": STEP}
    found = {AS_IS: LIMITS}
    for limit in described():
        wanted = limit.name not in NOT_MET if every else limit.source == TUNED
        if wanted and (only is None or limit.name in only):
            found |= {f"{limit.name} {sign}": moved(LIMITS, limit.name, factor) for sign, factor in steps.items()}
    return found


def diagnosed(dataset: Dataset, limits: DecisionLimits) -> dict[str, Any]:
    """Of data that were put together once, unless a limit that has a part in that is another one."""
    if any(getattr(limits, name) != getattr(dataset.limits, name) for name in IN_DATA):
        dataset = assemble(dataset.robot, dataset.model, dataset.logs, None, limits)
    dataset = replace(dataset, limits=limits)
    search = Search(dataset.fit, (), dataset.given, limits=limits)
    finding, gap = judge(dataset, search.run(), dataset.fit)
    return build(dataset, finding, gap, search, motion_gap(dataset.logs, limits), ()).result


class Draws:
    """Runs of one seed, with what is known of them in a file of lines (run, variation, outcome, first cause)."""

    def __init__(self, robot: RobotDescription, count: int, seed: int, keep: Path):
        self._robot, self._keep = robot, keep
        self.cases = draw_cases(count, seed, robot)
        self._file = keep / f"{robot.name}_{seed}.jsonl"
        self.known: dict[tuple[int, str], dict[str, Any]] = {}
        if self._file.exists():
            for line in self._file.read_text(encoding="utf-8").splitlines():
                entry = json.loads(line)
                self.known[entry["run"], entry["limits"]] = entry

    def work(self, wanted: Mapping[str, DecisionLimits]) -> Iterator[None]:
        """Diagnose what is not known yet; one step a run."""
        for case in self.cases:
            missing = {name: limits for name, limits in wanted.items() if (case.number, name) not in self.known}
            if not missing:
                continue
            dataset = self._dataset(case)
            for name, limits in missing.items():
                self._note(case, name, diagnosed(dataset, limits))
            yield

    def _dataset(self, case: Case) -> Dataset:
        robot, machine = self._robot, case.machine
        model = cached(
            self._keep, f"model_{robot.name}_{machine}",
            lambda: estimate(robot, [record(robot, machine, [], kind, machine) for kind in MOTIONS[:2]]),
        )  # fmt: skip
        logs = [record(robot, machine, list(case.effects), kind, case.motion) for kind in MOTIONS]
        return assemble(robot, model, logs, None)

    def _note(self, case: Case, name: str, result: dict[str, Any]) -> None:
        came = outcome(case.effects, result)
        first = [f"{cause['effect']} {' '.join(cause['joints'])}" for cause in result["causes"][:1]]
        entry = {"run": case.number, "limits": name, "kind": case.kind, "outcome": came, "first": first}
        self.known[case.number, name] = entry
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def cost(self, name: str) -> float:
        """Mean over the runs."""
        return sum(_cost(self.known[case.number, name]) for case in self.cases) / len(self.cases)

    def changed(self, name: str) -> int:
        """Runs with another outcome or first cause than with the limits as they are."""
        pairs = [(self.known[case.number, AS_IS], self.known[case.number, name]) for case in self.cases]
        return sum((a["outcome"], a["first"]) != (b["outcome"], b["first"]) for a, b in pairs)


def _cost(entry: Mapping[str, Any]) -> float:
    """Of one answer."""
    if entry["outcome"] == RIGHT.get(entry["kind"]):
        return 0.0
    return FALSE_ALARM if entry["kind"] == "none" else COST[entry["outcome"]]


def fitted(draws: Draws, wanted: Mapping[str, DecisionLimits]) -> DecisionLimits:
    """Each limit where its own cost is lowest, as it is unless another is better."""
    limits = LIMITS
    for limit in described():
        steps = [name for name in wanted if name.split(" ")[0] == limit.name]
        best = min([AS_IS, *steps], key=draws.cost)
        if best != AS_IS:
            limits = replace(limits, **{limit.name: getattr(wanted[best], limit.name)})
    return limits


def the_robot(name: str) -> RobotDescription:
    """A robot by name or path, or a small arm by its joints, R and P."""
    if set(name) <= {"R", "P"}:
        arm = make_arm(name)
        return replace(arm, joints=tuple(replace(joint, nominal_motor_torque=1.0) for joint in arm.joints))
    return load_robot(name)


def table(draws: Draws, wanted: Mapping[str, DecisionLimits]) -> None:
    """Of every limit, how many outcomes and first causes a step changes, and what that costs."""
    print(f"{len(draws.cases)} runs, cost {draws.cost(AS_IS):.3f} with the limits as they are")
    for limit in described():
        steps = [name for name in wanted if name.split(" ")[0] == limit.name]
        told = ", ".join(
            f"{name[-1]} {STEP:g}: {draws.changed(name)} other, cost {draws.cost(name):.3f}" for name in steps
        )
        if steps:
            print(f"{limit.name:22} {limit.value!s:>22}  {told}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", default="comau_ns16", help="as for agent diagnose; RRR: the small arm of the tests")
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1, help="of the draws fitted on; the next one is judged on")
    parser.add_argument("--only", nargs="*", help="these limits")
    parser.add_argument("--every", action="store_true", help="how far verdicts move with every limit; fits none")
    parser.add_argument("--keep", type=Path, required=True, help="folder for models and diagnoses")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after the run that passes it")
    arguments = parser.parse_args()
    arguments.keep.mkdir(parents=True, exist_ok=True)
    robot, wanted, begin = the_robot(arguments.robot), variations(arguments.only, arguments.every), time.monotonic()
    draws, others = (Draws(robot, arguments.cases, arguments.seed + k, arguments.keep) for k in (0, 1))

    def out_of_time(steps: Iterator[None]) -> bool:
        for _ in steps:
            print(f"{time.monotonic() - begin:.0f} s: one more run is done", flush=True)
            if time.monotonic() - begin > arguments.seconds:
                return True
        return False

    if out_of_time(draws.work(wanted)):
        sys.exit("not finished: start again with the same --keep")
    if arguments.every:
        table(draws, wanted)
        return
    new = fitted(draws, wanted)
    moves = {limit.name: limit.value for limit in described(new) if limit.value != getattr(LIMITS, limit.name)}
    if out_of_time(others.work({AS_IS: LIMITS, f"{FITTED} {json.dumps(moves)}": new})):
        sys.exit("not finished: start again with the same --keep")
    table(draws, wanted)
    print(f"moved: {moves or 'none'}")
    after = others.cost(f"{FITTED} {json.dumps(moves)}")
    print(f"{len(others.cases)} other runs: cost {others.cost(AS_IS):.3f} as they are, {after:.3f} fitted")


if __name__ == "__main__":
    main()
