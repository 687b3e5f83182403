"""Two simple tools for the runs of a blind check: `python benchmarks/blind_baselines.py METHOD RUNS -o ANSWERS.jsonl`.

RUNS is the folder of `agent blind-check --export`. Both fit base parameters, Coulomb and viscous friction and an
offset to the baseline logs by weighted least squares, and compare the torque error of the judged logs with what the
same fit leaves on baseline logs held out.

- `ranking` orders joints by how far their error exceeds that, as SAGE ranks actuators by their sim-to-real gap
  (Isaac Lab, Sim2Real Actuator Gap Estimator). It locates and never names.
- `refit` fits the same parameters to the judged logs. Where that closes three quarters of the gap, held out, it names
  the change that closes most of it alone: the friction or the offset of a joint, a payload, or a link's inertia.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from agent.core.errors import AgentError
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.recording import Log, read_log
from agent.robot import RobotDescription, load_robot
from agent.validation import predict_log

#: A joint errs by more than the model does anyway from this ratio on.
NOTICED = 1.5
#: Share of the gap from which a refit explains it, by the definition of `explained`.
EXPLAINED = 0.75


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("runs", type=Path, help="folder of the export")
    parser.add_argument("-o", "--out", type=Path, required=True, help="answers to write")
    asked = parser.parse_args()
    lines = [answer_of(folder, [asked.method]) for folder in sorted((asked.runs / "runs").iterdir())]
    asked.out.write_text("".join(line for (line,) in lines), encoding="utf-8")


def answer_of(folder: Path, methods: Sequence[str]) -> list[str]:
    """Lines of answers to a run, by method; empty ones if its logs cannot be fitted."""
    try:
        gap = Gap.of(folder)
        return [json.dumps({"run": folder.name, **METHODS[method](gap)}) + "\n" for method in methods]
    except AgentError as error:
        print(f"run {folder.name}: {error}", file=sys.stderr)
        return [""] * len(methods)


@dataclass(frozen=True)
class Gap:
    """Torque errors of a run, each (n,) root mean square over nominal torque.

    `before` is that of the judged logs under the baseline's model, `floor` that of held-out baseline logs.
    """

    robot: RobotDescription
    logs: Sequence[Log]
    model: IdentifiedModel
    before: np.ndarray
    floor: np.ndarray

    @classmethod
    def of(cls, folder: Path) -> Gap:
        """Read a run."""
        robot = load_robot(folder / "robot.yaml")
        baseline, logs = (
            [read_log(path, robot) for path in sorted((folder / session).glob("*.mcap"))]
            for session in ("baseline", "logs")
        )
        return cls.between(robot, baseline, logs)

    @classmethod
    def between(cls, robot: RobotDescription, baseline: Sequence[Log], logs: Sequence[Log]) -> Gap:
        """Of logs against a model of the baseline."""
        model = fitted(robot, baseline)
        return cls(robot, logs, model, errors([(model, log) for log in logs]), errors(held_out(robot, baseline)))

    @property
    def noticed(self) -> bool:
        """Whether any joint errs by more than usual."""
        return bool(np.any(self.before > NOTICED * self.floor))

    @property
    def where(self) -> list[dict[str, Any]]:
        """Joints by their share of the squared error above that of held-out baseline logs."""
        excess = np.maximum(self.before**2 - self.floor**2, 0.0) + 1e-12
        share = excess / excess.sum()
        return [{"joint": self.robot.joint_names[k], "share": float(share[k])} for k in np.argsort(-share)]

    def closure(self, after: np.ndarray) -> float:
        """Share of the squared error above that of held-out baseline logs that a change removes."""
        before, left, floor = (float(np.sum(value**2)) for value in (self.before, after, self.floor))
        return (before - left) / max(before - floor, 1e-12)


def fitted(robot: RobotDescription, logs: Sequence[Log]) -> IdentifiedModel:
    """Base parameters, Coulomb and viscous friction and an offset, without a prior."""
    return estimate(robot, logs, EstimationSettings.create(method="plain"))


def held_out(robot: RobotDescription, logs: Sequence[Log]) -> list[tuple[IdentifiedModel, Log]]:
    """Every log with a model of the others."""
    return [(fitted(robot, [other for other in logs if other is not log]), log) for log in logs]


def errors(pairs: Sequence[tuple[IdentifiedModel, Log]]) -> np.ndarray:
    """(n,) of models on logs, over nominal torque where the robot has one."""
    found = np.concatenate([predict_log(model, log).error for model, log in pairs])
    return np.sqrt(np.mean(found**2, axis=0)) / np.nan_to_num(pairs[0][0].robot.nominal_torque, nan=1.0)


def ranking(gap: Gap) -> dict[str, Any]:
    """Locate, never name."""
    return {"verdict": "unknown" if gap.noticed else "no_gap", "causes": [], "where": gap.where}


def refit(gap: Gap) -> dict[str, Any]:
    """Name the group of parameters whose change closes most, where all of them together close the gap."""
    if not gap.noticed:
        return ranking(gap)
    if gap.closure(errors(held_out(gap.robot, gap.logs))) < EXPLAINED:
        return ranking(gap)
    other = fitted(gap.robot, gap.logs)
    if other.names != gap.model.names:
        return ranking(gap)
    closes = {
        place: gap.closure(errors([(changed(gap.model, other, names), log) for log in gap.logs]))
        for place, names in groups(gap.model).items()
    }
    (effect, joints), best = max(closes.items(), key=lambda entry: entry[1])
    cause = {
        "effect": effect.split(" ")[0],
        "joints": list(joints),
        "probability": float(np.clip(best, 0, 1)),
        "equivalent_to": [],
    }
    return {"verdict": "explained", "causes": [cause], "where": gap.where}


def groups(model: IdentifiedModel) -> Mapping[tuple[str, tuple[str, ...]], list[str]]:
    """Names of parameters by the effect and joints that a change of them stands for; inertia with the link's number."""
    names = model.robot.joint_names
    found: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for name in model.names:
        kind, _, axle = name.rpartition("_")
        if kind:
            effect = "torque_offset" if kind == "offset" else "friction_change"
            place = (effect, (names[int(axle) - 1],))
        else:
            link = int("".join(letter for letter in name if letter.isdigit()))
            place = ("payload" if link == len(names) else f"inertial_mismatch {link}", ())
        found.setdefault(place, []).append(name)
    return found


def changed(model: IdentifiedModel, other: IdentifiedModel, names: Sequence[str]) -> IdentifiedModel:
    """The model with some parameters as in another one."""
    return replace(model, values=np.where(np.isin(model.names, names), other.values, model.values))


METHODS = {"ranking": ranking, "refit": refit}

if __name__ == "__main__":
    main()
