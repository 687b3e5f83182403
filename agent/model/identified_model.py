"""The identified model: what is needed to predict torque, to judge the prediction, and to fit again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import NORMAL_95, InputError, first_fault, read_json, write_atomically
from agent.model.friction_terms import FrictionTerm, Reversal
from agent.model.model_file import ModelDocument, check_model
from agent.model.regimes import RESTS
from agent.model.rigid_friction import HealthyEffect, ModelEffect, ParameterPrior, RigidFrictionModel
from agent.robot import RobotDescription, torque_units

SCHEMA = "model/1"


_MANY_OPEN = 0.1  # of all combinations of parameters; four arms predict 1.5 to 9 times worse beyond it
#: Rule of thumb for exciting trajectories (Gautier and Khalil 1992).
USUAL_CONDITION = 100
#: Beyond it motions hardly separate some parameters.
BAD_CONDITION = 1000.0


@dataclass(frozen=True, eq=False)
class IdentifiedModel(RigidFrictionModel):
    """A fitted model of one robot, self-contained: its data, and what can be asked of them."""

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) short names of all parameters."""
        return (*(self.standard_names[k] for k in self.independent), *(term.name for term in self.terms))

    @property
    def standard_deviations(self) -> np.ndarray:
        """(p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def unmoved(self) -> np.ndarray:
        """(p,) bool: friction and rotors, each alone in its parameter, of axles that stood still in the fit's logs.

        They are what was held before the data.
        """
        unmoved = np.zeros(len(self.values), dtype=bool)
        still = (self.robot.coupling != 0) @ ~self._resting == 0
        first, b = len(self.standard_names) - self.robot.dof, len(self.independent)  # rotors come last
        for row, (combined, parameter) in enumerate(zip(self.projection, self.independent, strict=True)):
            unmoved[row] = parameter >= first and np.count_nonzero(combined) == 1 and still[parameter - first]
        unmoved[b:] = [bool(still[term.axle]) and term.form != "offset" for term in self.terms]
        return unmoved

    @property
    def _resting(self) -> np.ndarray:
        """(n,) bool: joints that stood still in the fit's logs; none where the file does not say."""
        if "range" not in self.provenance:
            return np.zeros(self.robot.dof, dtype=bool)
        travelled = np.subtract(*(np.array(self.provenance["range"][key]) for key in ("highest", "lowest")))
        return np.asarray(travelled <= RESTS * self.robot.max_velocity)

    @property
    def fastest(self) -> np.ndarray:
        """(n,) highest speed [rad/s or m/s] of each joint in the fit's logs; its limit if it stood still, or if the
        file does not say."""
        limit = self.robot.max_velocity
        measured = self.provenance["range"]["fastest"] if "range" in self.provenance else limit
        return np.where(self._resting, limit, np.minimum(measured, limit))

    def predict(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, time: np.ndarray | None = None) -> np.ndarray:
        """(S, n) joint torque [N·m] of consecutive samples (S, n) at `time` (S,) [s], which only effects may need.

        Raises:
            InputError: the model has an effect that is not known here.
        """
        return self.predict_parts(q, qd, qdd, time)[0]

    def predict_parts(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, time: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What `predict` returns, and what the friction terms have in it; both (S, n) [N·m].

        Raises:
            InputError: the model has an effect that is not known here.
        """
        rigid, friction = self.rigid_and_friction(q, qd, qdd)
        torque = rigid + friction
        for entry in self.effects:
            from agent.model.effect_prediction import effect_torque  # with all that a catalogue of effects imports

            torque = torque + effect_torque(self, entry, {"time": time, "q": q, "qd": qd, "qdd": qdd})
        return torque, friction

    def prediction_interval(self, columns: np.ndarray, speed: np.ndarray | None = None) -> np.ndarray:
        """(S, n) half the 95 % interval [N·m] of a prediction, from its regressor columns (S, n, p), filtered alike.

        The variance is that of the parameters, xᵀ Σ x, plus that of held-out rows: in motion, or at standstill where
        the joints' `speed` (S, n) says so, because stiction leaves friction open there.
        """
        variance = np.einsum("snp,pq,snq->sn", columns, self.covariance, columns, optimize=True)
        held_out = self.residual_rmse
        if speed is not None and self.group_rmse is not None:
            held_out = np.where(np.abs(speed) > self.standstill_speed, *self.group_rmse)
        return NORMAL_95 * np.sqrt(variance + held_out**2)

    def _term_unit(self, term: FrictionTerm) -> str:
        return term.unit(self.robot.joints[term.axle].prismatic)

    def _term_meaning(self, term: FrictionTerm) -> str:
        joint = self.robot.joints[term.axle]
        return term.meaning(joint.name, joint.prismatic)

    def rows(self) -> list[tuple[str, ...]]:
        """Table of parameters like the paper's Table I, and what was held of them before the data; header first."""
        deviations, unmoved = self.standard_deviations, self.unmoved
        before = ("prior mean", "prior std. dev.", "from the data [%]")
        rows: list[tuple[str, ...]] = [("parameter", "value", "std. dev.", "rel. [%]", "unit", "stands for", *before)]
        for k, name in enumerate(self.names):
            b = len(self.independent)
            unit = _standard_unit(name) if k < b else self._term_unit(self.terms[k - b])
            meaning = self.combinations[k] if k < b else self._term_meaning(self.terms[k - b])
            value, deviation = self.values[k], deviations[k]
            if unmoved[k]:
                rows.append((name, "-", "-", "-", unit, meaning, *self._prior_cells(k)))
                continue
            relative = f"{100 * deviation / abs(value):.1f}" if deviation < 10 * abs(value) else ">1000"
            rows.append((name, f"{value:.5g}", f"{deviation:.2g}", relative, unit, meaning, *self._prior_cells(k)))
        return rows

    def _prior_cells(self, k: int) -> tuple[str, str, str]:
        if self.prior is None:
            return "-", "-", "-"
        share = 100 * self.prior.data_share[k]
        return f"{self.prior.mean[k]:.5g}", f"{self.prior.standard_deviation[k]:.2g}", f"{share:.0f}"

    def text(self) -> str:
        """What is missing, the table, what there is to say about it, and the held-out error, for people."""
        rows = [row[:5] for row in self.rows()]
        widths = [max(len(row[k]) for row in rows) for k in range(5)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows]
        lines.append(f"condition number of the scaled observation matrix: {judged_condition(self.condition_number)}")
        errors = "  ".join(
            f"{joint.name} {error:.3g} {'N' if joint.prismatic else 'N·m'}"
            for joint, error in zip(self.robot.joints, self.held_out_rmse, strict=True)
        )
        lines.append(f"held-out RMSE: {errors}")
        return "\n".join([*self.too_little_motion, *lines, *self.notes])

    def summary(self, next_step: str) -> str:
        """What to do (`next_step` unless motion is missing), friction and held-out error of every joint, and doubts."""
        units = torque_units(self.robot)
        rows: list[tuple[str, ...]] = [("joint", "Coulomb", "viscous", "held-out RMSE", "")]
        for k, (joint, unit) in enumerate(zip(self.robot.joints, units, strict=True)):
            friction = [self._friction_cell(k, form) for form in ("coulomb", "viscous")]
            rows.append((joint.name, *friction, f"{self.held_out_rmse[k]:.3g}", f"{unit} and {self._viscous_unit(k)}"))
        widths = [max(len(row[k]) for row in rows) for k in range(5)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        doubts = [note for note in self.notes if note in self.provenance.get("doubts", ())]
        return "\n".join([*(self.too_little_motion or [next_step]), *lines, *doubts])

    def _friction_cell(self, axle: int, form: str) -> str:
        for k, term in enumerate(self.terms, len(self.independent)):
            if term.axle == axle and term.form == form:
                value, deviation = self.values[k], self.standard_deviations[k]
                return "stood still" if self.unmoved[k] else f"{value:.4g} ± {NORMAL_95 * deviation:.2g}"
        return "-"

    def _viscous_unit(self, axle: int) -> str:
        return "N·s/m" if self.robot.joints[axle].prismatic else "N·m·s/rad"

    @property
    def too_little_motion(self) -> tuple[str, ...]:
        """Warning that the fit's logs leave many parameters open, or some and are short or hardly separate others."""
        count, missing = len(self.values), self.provenance.get("open_directions", 0)
        resting = [name for name, rests in zip(self.robot.joint_names, self._resting, strict=True) if rests]
        still = f" ({', '.join(resting)} stood still)" if resting else ""
        poor = self.provenance.get("short", False) or self.condition_number > BAD_CONDITION
        if missing <= _MANY_OPEN * count and not (missing and poor):
            return ()
        return (
            f"Too little motion: these logs leave {missing} of {count} combinations of parameters open{still}. "
            "Record more motion, every joint both ways and in other postures, then estimate again.",
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON content of the model file."""
        deviations, b = self.standard_deviations, len(self.independent)
        values = [None if still else float(value) for value, still in zip(self.values, self.unmoved, strict=True)]
        return {
            "schema": SCHEMA,
            "robot": self.robot.to_dict(),
            "method": self.method,
            "filter": {"cutoff_hz": self.cutoff, "order": self.order},
            "base_parameters": [
                {
                    "name": self.names[k],
                    "combination": self.combinations[k],
                    "unit": _standard_unit(self.names[k]),
                    "value": values[k],
                    "standard_deviation": None if values[k] is None else float(deviations[k]),
                }
                for k in range(b)
            ],
            "friction": [
                {
                    "name": term.name,
                    "joint": self.robot.joint_names[term.axle],
                    "form": term.form,
                    "reversal": None if term.reversal is None else asdict(term.reversal),
                    "fading": term.fading,
                    "unit": self._term_unit(term),
                    "value": values[b + k],
                    "standard_deviation": None if values[b + k] is None else float(deviations[b + k]),
                }
                for k, term in enumerate(self.terms)
            ],
            "effects": [entry.to_dict() for entry in self.effects],
            "healthy": [asdict(entry) for entry in self.healthy],
            "covariance": self.covariance.tolist(),
            "standard_names": list(self.standard_names),
            "independent": self.independent.tolist(),
            "projection": self.projection.tolist(),
            "standard_parameters": None if self.standard is None else self.standard.tolist(),
            "weights": self.weights.tolist(),
            "residual_rmse": self.residual_rmse.tolist(),
            "held_out_rmse": self.held_out_rmse.tolist(),
            "group_rmse": None if self.group_rmse is None else self.group_rmse.tolist(),
            "standstill_speed": None if self.standstill_speed is None else self.standstill_speed.tolist(),
            "sliding_rmse": None if self.sliding_rmse is None else self.sliding_rmse.tolist(),
            "noise_share": None if self.noise_share is None else self.noise_share.tolist(),
            "condition_number": self.condition_number if np.isfinite(self.condition_number) else None,
            "prior": None if self.prior is None else {key: array.tolist() for key, array in vars(self.prior).items()},
            "notes": list(self.notes),
            "provenance": self.provenance,
        }

    def save(self, path: str | Path) -> None:
        """Write the model file under another name, then rename it, so that no reader sees half a file.

        Raises:
            AgentError: the disk is full or not writable; what was there stays.
        """
        write_atomically(Path(path), json.dumps(self.to_dict(), allow_nan=False))

    @classmethod
    def load(cls, path: str | Path) -> IdentifiedModel:
        """Read a model file.

        Raises:
            InputError: missing, not JSON, of another schema, or incomplete; names the key.
        """
        path = Path(path)
        try:
            data = read_json(path)
        except InputError as error:
            advice = "name a model.json that `agent estimate` or `agent calibrate` has written"
            raise InputError(f"{error}; {advice}") from None
        schema = data.get("schema") if isinstance(data, dict) else None
        if schema != SCHEMA:
            raise InputError(f"{path}: not a model file of schema {SCHEMA!r} (it says {str(schema)[:40]!r})")
        if fault := first_fault(data, ModelDocument):
            raise InputError(f"{path}: this model file is incomplete or damaged: {fault}")
        try:
            model = cls.from_dict(data)
            _ = model.rigid  # its URDF can be used
            return model
        except InputError as error:
            raise InputError(f"{path}: this model file is damaged: {error}") from None
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            problem = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise InputError(f"{path}: this model file is incomplete or damaged: {problem}") from None

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> IdentifiedModel:
        """The inverse of `to_dict`."""
        robot = _robot(data["robot"])
        base, friction = data["base_parameters"], data["friction"]
        values = np.array([entry["value"] for entry in [*base, *friction]], dtype=float)  # null: not in the data
        prior_mean = 0.0 if data.get("prior") is None else np.array(data["prior"]["mean"], dtype=float)
        values = np.where(np.isnan(values), prior_mean, values)
        condition = data["condition_number"]
        model = cls(
            robot=robot,
            independent=np.array(data["independent"], dtype=int),
            projection=np.array(data["projection"], dtype=float),
            standard_names=tuple(data["standard_names"]),
            combinations=tuple(entry["combination"] for entry in base),
            terms=tuple(
                FrictionTerm(
                    _axle(robot, e["joint"]),
                    e["form"],
                    None if e["reversal"] is None else Reversal(**e["reversal"]),
                    e["fading"],
                )
                for e in friction
            ),
            values=values,
            covariance=np.array(data["covariance"], dtype=float),
            cutoff=float(data["filter"]["cutoff_hz"]),
            order=data["filter"]["order"],
            method=data["method"],
            weights=np.array(data["weights"], dtype=float),
            residual_rmse=np.array(data["residual_rmse"], dtype=float),
            held_out_rmse=np.array(data["held_out_rmse"], dtype=float),
            condition_number=np.inf if condition is None else float(condition),
            standard=_optional(data, "standard_parameters"),
            group_rmse=_optional(data, "group_rmse"),
            standstill_speed=_optional(data, "standstill_speed"),
            sliding_rmse=_optional(data, "sliding_rmse"),
            noise_share=_optional(data, "noise_share"),
            prior=_prior(data.get("prior")),
            notes=tuple(data["notes"]),
            effects=tuple(
                ModelEffect(
                    e["effect"],
                    tuple(e["joints"]),
                    dict(e["parameters"]),
                    {name: (low, high) for name, (low, high) in e.get("intervals", {}).items()},
                )
                for e in data["effects"]
            ),
            healthy=tuple(
                HealthyEffect(
                    e["effect"],
                    tuple(e["joints"]),
                    dict(e["settings"]),
                    dict(e["amount"]),
                    {name: (mean, deviation) for name, (mean, deviation) in e.get("value", {}).items()},
                )
                for e in data.get("healthy", ())
                if "amount" in e  # an older file has a torque, which says nothing of another motion
            ),
            provenance=data["provenance"],
        )
        check_model(model)
        return model


def _optional(data: dict[str, Any], key: str) -> np.ndarray | None:
    return None if data.get(key) is None else np.array(data[key], dtype=float)


def _prior(data: dict[str, Any] | None) -> ParameterPrior | None:
    if data is None:
        return None
    keys = ("mean", "standard_deviation", "data_share")
    return ParameterPrior(*(np.array(data[key], dtype=float) for key in keys))


def _robot(data: dict[str, Any]) -> RobotDescription:
    try:
        return RobotDescription.from_dict(data)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        problem = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"robot: {problem}") from None


def _axle(robot: RobotDescription, joint: str) -> int:
    if joint not in robot.joint_names:
        raise ValueError(f"{joint!r} is no joint of the robot")
    return robot.joint_names.index(joint)


def condition_text(number: float) -> str:
    """A condition number as every page and summary shows it."""
    return f"{number:.0f}" if np.isfinite(number) else "beyond 1e7"


def judged_condition(number: float) -> str:
    """A condition number and whether it matters: it says how well single parameters are known, not predictions."""
    if number < USUAL_CONDITION:
        return f"{condition_text(number)} (below {USUAL_CONDITION}: single parameters are well known)"
    return (
        f"{condition_text(number)} (above {USUAL_CONDITION}: some parameters are known in combination only; "
        "predicted torque does not suffer)"
    )


def _standard_unit(name: str) -> str:
    if name.startswith("m") and name[1:].isdigit():
        return "kg"
    return "kg·m" if name.startswith("m") else "kg·m²"
