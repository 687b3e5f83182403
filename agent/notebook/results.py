"""Results as a notebook shows them: each holds what the packages of the agent return, in words and one picture."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, counted, csv_text, error_text, write_atomically
from agent.diagnosis import Diagnosis
from agent.model import IdentifiedModel
from agent.pages import SERIES, Bar, Bars, Panel, Plot, Table, headline, joint_series, still, table_html
from agent.pipeline import Outcome, PlanFiles, diagnosis_text, validation_text
from agent.recording import Log, read_log
from agent.robot import SHARE, torque_units
from agent.validation import Prediction, predict_log, summary


class Shown(ABC):
    """A result that prints itself: `text` on a terminal, headline and picture above it in a notebook."""

    @abstractmethod
    def headline(self) -> str:
        """The key figure in one sentence."""

    @abstractmethod
    def text(self) -> str:
        """Everything a terminal shows."""

    def picture(self) -> Plot | Table | None:
        """One plot or table of bars, if there is anything to draw."""
        return None

    def __repr__(self) -> str:
        return f"{self.headline()}\n{self.text()}".rstrip()

    def _repr_html_(self) -> str:
        picture, text = self.picture(), escape(self.text())
        drawn = "" if picture is None else still(picture) if isinstance(picture, Plot) else table_html(picture)
        more = f"<details><summary>more</summary><pre>{text}</pre></details>" if text else ""
        return f"<div><p><b>{escape(self.headline())}</b></p>{drawn}{more}</div>"


def _lines(x: np.ndarray, names: Sequence[str], values: np.ndarray, label: str, unit: str) -> Plot:
    """Curves (S, k) over time (S,) [s]."""
    return Plot("card", "", "time", (Panel(label, unit, joint_series(names, values)),), x, "s")


def _bars(joints: Sequence[str], units: Sequence[str], series: Mapping[str, Sequence[float] | np.ndarray]) -> Table:
    """Figures (n,) of every joint with bars; shares of nominal torque in percent."""
    rows: list[tuple[str | Bars, ...]] = []
    height = 0.9 / len(series)
    for joint, unit, *values in zip(joints, units, *series.values(), strict=True):
        figures = [100.0 * value if unit == SHARE else float(value) for value in values]
        drawn = [Bar(0.0, value, SERIES[k], 0.05 + k * height, height) for k, value in enumerate(figures)]
        texts = [f"{value:.3g}" if np.isfinite(value) else "-" for value in figures]
        rows.append((joint, *texts, "%" if unit == SHARE else unit, Bars(drawn, unit=unit)))
    return Table("card", ("joint", *series, "unit", ""), rows)


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

    def picture(self) -> Plot | None:
        log = next(iter(self), None)
        return None if log is None else _lines(log.t, log.joint_names, log.position, f"position, {log.name}", "")


class Model(Shown, IdentifiedModel):
    """An identified model, to be used wherever one is."""

    @classmethod
    def of(cls, model: IdentifiedModel) -> Model:
        """Wrap a model."""
        return cls(**{field.name: getattr(model, field.name) for field in fields(model)})

    def headline(self) -> str:
        shares, units = self.held_out_rmse / self.robot.nominal_torque, torque_units(self.robot)
        worst = int(np.argmax(np.where(np.isfinite(shares), shares, -1)))
        error = error_text(float(shares[worst]), float(self.held_out_rmse[worst]), units[worst])
        return (
            f"{self.robot.name}, {self.method}: {len(self.base_values)} base parameters, {len(self.terms)} friction "
            f"terms; largest held-out RMSE {error} on {self.robot.joint_names[worst]}"
        )

    def predict(self, q: Any, qd: Any = None, qdd: Any = None, time: Any = None) -> Any:
        """Torque of a motion.

        Parameters
        ----------
        q : (S, n) positions, with velocities `qd` and accelerations `qdd`; or a log or its path
        time : (S,) [s], where an effect depends on it

        Returns
        -------
        (S, n) torque [N·m or N]; of a log, a `Prediction` with `time`, `measured` and `predicted`, filtered alike
        """
        if isinstance(q, (str, Path)):
            q = read_log(q, self.robot)
        return predict_log(self, q) if isinstance(q, Log) else IdentifiedModel.predict(self, q, qd, qdd, time)

    def text(self) -> str:
        return IdentifiedModel.text(self)

    def picture(self) -> Table:
        errors, units = self.held_out_rmse / self.robot.nominal_torque, (SHARE,) * self.robot.dof
        if not np.all(np.isfinite(errors)):
            errors, units = self.held_out_rmse, torque_units(self.robot)
        return _bars(self.robot.joint_names, units, {"held out": errors})


@dataclass(frozen=True, eq=False, repr=False)
class TorqueValidation(Shown):
    """Torque predicted on logs that took no part in the fit: the figures, and the signals behind them."""

    predictions: tuple[Prediction, ...]

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the n joints."""
        return self.predictions[0].model.robot.joint_names

    @property
    def logs(self) -> tuple[str, ...]:
        """Names of the L logs."""
        return tuple(prediction.log for prediction in self.predictions)

    @property
    def rmse(self) -> np.ndarray:
        """(L, n) root mean square error [N·m, N of a slide] of each log and joint."""
        return self._figures("rmse")

    @property
    def normalised_rmse(self) -> np.ndarray:
        """(L, n) the same over nominal torque, NaN where the description has none."""
        return self._figures("normalised_rmse")

    @property
    def relative_error(self) -> np.ndarray:
        """(L, n) norm of the error over that of the torque, NaN where there is none."""
        return self._figures("relative_error")

    def _figures(self, key: str) -> np.ndarray:
        return np.array([getattr(log, key) for log in summary(self.predictions).logs], dtype=float)

    def to_csv(self, out: str | Path | None = None) -> str:
        """One row for each log and joint, as text; also written to the file `out`, if there is one."""
        rows: list[Sequence[object]] = [("log", "joint", "rmse", "normalised_rmse", "relative_error")]
        tables = self.rmse, self.normalised_rmse, self.relative_error
        for k, log in enumerate(self.logs):
            rows += [(log, joint, *(table[k, j] for table in tables)) for j, joint in enumerate(self.joints)]
        text = csv_text(rows)
        if out is not None:
            write_atomically(Path(out), text)
        return text

    def to_dict(self) -> dict[str, Any]:
        """The document that `agent validate --json` prints."""
        return summary(self.predictions).to_dict()

    def headline(self) -> str:
        error = summary(self.predictions).overall.relative_error_all_joints
        figure = "no torque to compare with" if error is None else f"torque predicted to {100 * error:.2f} %"
        return f"{figure} over all joints, {counted(len(self.predictions), 'log')}"

    def text(self) -> str:
        return validation_text(summary(self.predictions))

    def picture(self) -> Plot:
        first = self.predictions[0]
        joint = int(np.argmax(np.sqrt(np.mean(first.measured**2, axis=0))))
        curves = np.column_stack([first.measured[:, joint], first.predicted[:, joint]])
        robot = first.model.robot
        return _lines(
            first.time, ("measured", "predicted"), curves, robot.joint_names[joint], torque_units(robot)[joint]
        )


@dataclass(frozen=True, eq=False, repr=False)
class GapDiagnosis(Shown):
    """Where model and robot disagree, which effect causes it, and how far the gap closes with it."""

    diagnosis: Diagnosis

    @property
    def verdict(self) -> str:
        """`no_gap`, `explained`, `ambiguous` or `unknown`."""
        return self.diagnosis.verdict

    @property
    def causes(self) -> list[dict[str, Any]]:
        """Causes, the one that closes most first: `effect`, `joints`, `closure`, `probability`, `parameters`."""
        return list(self.to_dict()["causes"])

    @property
    def closure(self) -> float | None:
        """Part of the gap that the causes explain; None without a gap."""
        closure: float | None = self.to_dict()["closure"]
        return closure

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know of the result."""
        return self.diagnosis.warnings

    def to_dict(self) -> dict[str, Any]:
        """The document that `agent diagnose --json` prints, without the forward simulation."""
        return self.diagnosis.result

    def headline(self) -> str:
        return headline(self.to_dict())

    def text(self) -> str:
        return "\n".join([diagnosis_text(self.to_dict()), *(f"warning: {w}" for w in self.diagnosis.warnings)])

    def picture(self) -> Table:
        gap, floor = self.diagnosis.gap, self.diagnosis.gap.floor
        series = {"gap": gap.before, "with the causes": gap.after, **({} if floor is None else {"floor": floor})}
        return _bars(self.to_dict()["gap"]["joints"], self.to_dict()["gap"]["units"], series)


@dataclass(frozen=True, eq=False, repr=False)
class PlannedLoop(Shown):
    """The loop of a recipe as `agent plan` writes it: program, plan and page lie in `files.folder`."""

    files: PlanFiles

    def headline(self) -> str:
        return self.files.text().splitlines()[0]

    def text(self) -> str:
        return "\n".join(self.files.text().splitlines()[1:])

    def picture(self) -> Plot:
        cycle = self.files.loop.cycle
        return _lines(cycle.t, "xyz", cycle.tcp[:, :3, 3], "tool", "m")


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Shown):
    """A finished calibration: `run` is its folder, with model, logs and report."""

    outcome: Outcome

    @property
    def run(self) -> Path:
        """The run folder."""
        assert self.outcome.run is not None
        return self.outcome.run

    @property
    def accepted(self) -> bool | None:
        """Whether it passed its gate; None where nothing was validated."""
        accepted: bool | None = self.outcome.result["accepted"]
        return accepted

    @property
    def model(self) -> Model:
        """The identified model of the run."""
        return Model.of(IdentifiedModel.load(self.run / "model.json"))

    def headline(self) -> str:
        word = {True: "Accepted", False: "Rejected", None: "Not judged"}[self.outcome.result["accepted"]]
        return f"{word}: {self.run}"

    def text(self) -> str:
        return self.outcome.text.strip()

    def picture(self) -> Table:
        validation = self.outcome.result["validation"]
        units = [SHARE] * len(validation["joints"])
        return _bars(validation["joints"], units, {"unseen motions": validation["normalised_rmse"]})


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


def quiet() -> Console:
    """Warnings only: a notebook has the results."""
    return Console(-1)
