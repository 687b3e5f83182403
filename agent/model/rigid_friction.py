"""What an identified model is made of, and its rigid bodies with their friction, which effects are computed from."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from agent.model.friction_terms import AxleMotion, FrictionTerm, axle_columns
from agent.robot import RigidBodies, RobotDescription

#: `method` of a model that was read from a simulator's file.
SIMULATOR = "simulator"


@dataclass(frozen=True)
class ModelEffect:
    """Something beyond rigid bodies and friction that adds torque: an effect's name, its joints and parameters.

    `intervals`: 95 % of those parameters whose uncertainty is known.
    """

    effect: str
    joints: tuple[str, ...]
    parameters: dict[str, float]
    intervals: dict[str, tuple[float, float]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as model files have it."""
        data = {"effect": self.effect, "joints": list(self.joints), "parameters": self.parameters}
        return {**data, "intervals": {k: list(v) for k, v in self.intervals.items()}} if self.intervals else data


@dataclass(frozen=True)
class HealthyEffect:
    """What the arm has of an effect of the catalogue while it is healthy: name, joints and nonlinear parameters.

    `amount`: standard deviation of each linear parameter, on motions that the model was not fitted to. `value`: mean
    over the logs, and the standard deviation of a further log from it; empty where the logs do not show it.
    """

    effect: str
    joints: tuple[str, ...]
    settings: dict[str, float]
    amount: dict[str, float]
    value: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ParameterPrior:
    """What was held of the parameters before any data: `mean` and `standard_deviation` (p,); and `data_share` (p,), the
    part of that variance which the data took away: near 1 the data say what a parameter is, near 0 the prior does."""

    mean: np.ndarray
    standard_deviation: np.ndarray
    data_share: np.ndarray

    def part(self, kept: np.ndarray) -> ParameterPrior:
        """That of the parameters `kept` (indices)."""
        return ParameterPrior(self.mean[kept], self.standard_deviation[kept], self.data_share[kept])


@dataclass(frozen=True, eq=False)
class RigidFrictionModel:
    """A fitted model of one robot: rigid bodies and friction, which is all of it but for its `effects`.

    Its p parameters are b base parameters (rotor inertias among them), then the friction terms: values (p,) and
    covariance (p, p). `independent`, `projection` and `combinations` are those of `agent.robot.base_reduction`;
    `residual_rmse` and `held_out_rmse` (n,) [N·m] are of the fit and of its cross-validation, standstill included;
    `weights` (2, n) are the fit's, in motion and at standstill; `group_rmse` (2, n) is the held-out RMSE of the same
    groups, and `standstill_speed` (n,) up to which a joint stands still (None in older files); `sliding_rmse` (n,) is
    that of logs left out, without what is near a standstill, and `noise_share` (n,) the part of its square that no
    smooth function explains (both None where nobody looked); `cutoff` [Hz] and `order` are the filter's; `standard`
    (10 n + n,) are physical inertial parameters behind the base parameters, where the method found them; `prior` is
    None where the method has none, and in older files; `healthy` is what held-out motions show of the catalogue's
    effects without any fault.
    """

    robot: RobotDescription
    independent: np.ndarray
    projection: np.ndarray
    standard_names: tuple[str, ...]
    combinations: tuple[str, ...]
    terms: tuple[FrictionTerm, ...]
    values: np.ndarray
    covariance: np.ndarray
    cutoff: float
    order: int
    method: str
    weights: np.ndarray
    residual_rmse: np.ndarray
    held_out_rmse: np.ndarray
    condition_number: float
    standard: np.ndarray | None = None
    group_rmse: np.ndarray | None = None
    standstill_speed: np.ndarray | None = None
    sliding_rmse: np.ndarray | None = None
    noise_share: np.ndarray | None = None
    prior: ParameterPrior | None = None
    notes: tuple[str, ...] = ()
    effects: tuple[ModelEffect, ...] = ()
    healthy: tuple[HealthyEffect, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)

    @property
    def of_file(self) -> bool:
        """Whether a simulator's file states it: without data, so without an error or an uncertainty of its own."""
        return self.method == SIMULATOR

    @property
    def base_values(self) -> np.ndarray:
        """(b,) base parameters."""
        return self.values[: len(self.independent)]

    @property
    def friction_values(self) -> np.ndarray:
        """(p - b,) parameters of the friction terms."""
        return self.values[len(self.independent) :]

    @cached_property
    def rigid(self) -> RigidBodies:
        """The regressor of the base parameters."""
        from agent.robot import Dynamics

        basis = self.independent, self.projection, self.standard_names, self.combinations
        return RigidBodies(Dynamics(self.robot), *basis)

    @property
    def friction_share(self) -> np.ndarray:
        """(T, n): what each term's axle torque is on each joint."""
        return self.robot.coupling[[term.axle for term in self.terms]]

    def columns(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, p) regressor of all parameters for joint motion (S, n)."""
        rigid = self.rigid.columns(q, qd, qdd)
        axles = axle_columns(self.terms, AxleMotion.of(self.robot, q, qd, rigid @ self.base_values))
        return np.concatenate([rigid, self.friction_share.T[None] * axles[:, None, :]], axis=2)

    def rigid_and_friction(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Torque of the bodies and of the friction terms on the joints (S, n) [N·m] for joint motion (S, n)."""
        rigid = self.rigid.torque(q, qd, qdd, self.base_values)
        columns = axle_columns(self.terms, AxleMotion.of(self.robot, q, qd, rigid))
        return rigid, columns * self.friction_values @ self.friction_share
