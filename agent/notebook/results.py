"""Results as a notebook shows them: each holds what the rooms of the agent return, and says it in words and a plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, counted, error_text
from agent.diagnosis import Diagnosis
from agent.model import IdentifiedModel
from agent.notebook.card import Shown, bars, lines
from agent.pipeline import CalibrationOutcome, PlanFiles, diagnosis_text, validation_text
from agent.recording import Log
from agent.report import headline
from agent.robot import SHARE, torque_units
from agent.validation import Prediction, summary

if TYPE_CHECKING:
    from agent.robot import RobotDescription


class Logs(Shown, tuple[Log, ...]):
    """Logs of one robot, in the order of their names."""

    def headline(self) -> str:
        return f"{counted(len(self), 'log')}, {sum(log.t[-1] for log in self):.1f} s"

    def text(self) -> str:
        rows = [
            f"{log.name}: {len(log.t)} samples at {log.sample_rate:g} Hz, {counted(len(log.joint_names), 'joint')}"
            + ("" if log.effort is not None else ", no torque")
            + "".join(f"; {repair}" for repair in log.repairs)
            for log in self
        ]
        return "\n".join(rows)

    def svg(self) -> str:
        if not self:
            return ""
        first = self[0]
        return lines(first.t, dict(zip(first.joint_names, first.position.T, strict=True)), "s", f"q, {first.name}")


class Model(Shown, IdentifiedModel):
    """An identified model, to be used wherever one is."""

    @classmethod
    def of(cls, model: IdentifiedModel) -> Model:
        """The same model."""
        return cls(**{field.name: getattr(model, field.name) for field in fields(model)})

    def headline(self) -> str:
        shares, units = self.held_out_rmse / self.robot.nominal_torque, torque_units(self.robot)
        worst = int(np.argmax(np.where(np.isfinite(shares), shares, -1)))
        error = error_text(float(shares[worst]), float(self.held_out_rmse[worst]), units[worst])
        return (
            f"{self.robot.name}, {self.method}: {len(self.base_values)} base parameters, {len(self.terms)} friction "
            f"terms; largest held-out RMSE {error} on {self.robot.joint_names[worst]}"
        )

    def text(self) -> str:
        return IdentifiedModel.text(self)

    def svg(self) -> str:
        return _errors(self.robot, {"held out": self.held_out_rmse})


@dataclass(frozen=True, eq=False, repr=False)
class TorqueValidation(Shown):
    """Torque predicted on logs that took no part in the fit: the figures, and the signals behind them."""

    predictions: tuple[Prediction, ...]

    def to_dict(self) -> dict[str, Any]:
        """The document that `agent validate --json` prints."""
        return summary(self.predictions).to_dict()

    def headline(self) -> str:
        error = summary(self.predictions).overall.relative_error_all_joints
        figure = "no torque to compare with" if error is None else f"torque predicted to {100 * error:.2f} %"
        return f"{figure} over all joints, {counted(len(self.predictions), 'log')}"

    def text(self) -> str:
        return validation_text(summary(self.predictions))

    def svg(self) -> str:
        first = self.predictions[0]
        joint = int(np.argmax(np.sqrt(np.mean(first.measured**2, axis=0))))
        name = first.model.robot.joint_names[joint]
        curves = {"measured": first.measured[:, joint], "predicted": first.predicted[:, joint]}
        return lines(first.time, curves, "s", f"{name} [{torque_units(first.model.robot)[joint]}]")


@dataclass(frozen=True, eq=False, repr=False)
class GapDiagnosis(Shown):
    """Where model and robot disagree, which effect causes it, and how far the gap closes with it."""

    diagnosis: Diagnosis

    def to_dict(self) -> dict[str, Any]:
        """The document that `agent diagnose --json` prints, without the forward simulation."""
        return self.diagnosis.result

    def headline(self) -> str:
        return headline(self.to_dict())

    def text(self) -> str:
        return "\n".join([diagnosis_text(self.to_dict()), *(f"mind: {w}" for w in self.diagnosis.warnings)])

    def svg(self) -> str:
        gap, floor = self.diagnosis.gap, self.diagnosis.gap.floor
        series = {"gap": gap.before, "with the causes": gap.after, **({} if floor is None else {"floor": floor})}
        return _figures(self.to_dict()["gap"]["joints"], self.to_dict()["gap"]["units"], series)


@dataclass(frozen=True, eq=False, repr=False)
class PlannedLoop(Shown):
    """The loop of a recipe as `agent plan` writes it: program, plan and page lie in `files.folder`."""

    files: PlanFiles

    def headline(self) -> str:
        return self.files.text().splitlines()[0]

    def text(self) -> str:
        return "\n".join(self.files.text().splitlines()[1:])

    def svg(self) -> str:
        cycle = self.files.motion.loop.trajectory
        return lines(cycle.t, dict(zip("xyz", cycle.tcp[:, :3, 3].T, strict=True)), "s", "tool [m]")


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Shown):
    """A finished calibration: `outcome.run` is its folder, with model, logs and report."""

    outcome: CalibrationOutcome

    @property
    def model(self) -> Model:
        """The identified model of the run."""
        return Model.of(IdentifiedModel.load(self.outcome.run / "model.json"))

    def headline(self) -> str:
        word = {True: "Accepted", False: "Rejected", None: "Not judged"}[self.outcome.result.accepted]
        return f"{word}: {self.outcome.run}"

    def text(self) -> str:
        return self.outcome.summary().strip()

    def svg(self) -> str:
        validation = self.outcome.result.validation
        return bars(validation.joints, {"unseen motions": 100 * validation.normalised_rmse}, "%")


class Listing(Shown, dict[str, Any]):
    """Things by name, each with one line about it."""

    def __init__(self, what: str, entries: Mapping[str, Any], about: Mapping[str, str]):
        super().__init__(entries)
        self._what, self._about = what, dict(about)

    def headline(self) -> str:
        return f"{len(self)} {self._what}"

    def text(self) -> str:
        width = max(map(len, self), default=0)
        return "\n".join(f"{name:{width}}  {self._about[name]}" for name in self)

    def svg(self) -> str:
        return ""


def quiet() -> Console:
    """Warnings only: a notebook has the results."""
    return Console(-1)


def _errors(robot: RobotDescription, series: Mapping[str, np.ndarray]) -> str:
    """Bars of torque errors (n,) [N·m]: in percent of nominal torque where every joint has one."""
    nominal = robot.nominal_torque
    if np.all(np.isfinite(nominal)):
        return bars(robot.joint_names, {name: 100 * values / nominal for name, values in series.items()}, "%")
    return bars(robot.joint_names, series, "N·m")


def _figures(joints: Sequence[str], units: Sequence[str], series: Mapping[str, np.ndarray]) -> str:
    """Bars of figures in `error_units`: shares in percent."""
    scale = np.array([100.0 if unit == SHARE else 1.0 for unit in units])
    unit = "%" if np.all(scale == 100) else "N·m" if np.all(scale == 1) else ""
    return bars(joints, {name: scale * values for name, values in series.items()}, unit)
