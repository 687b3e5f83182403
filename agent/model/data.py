"""What an identified model consists of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agent.model.friction_terms import FrictionTerm
from agent.robot import RobotDescription


@dataclass(frozen=True)
class ModelEffect:
    """Something beyond rigid bodies and friction that adds torque: an effect's name, its joints and parameters."""

    effect: str
    joints: tuple[str, ...]
    parameters: dict[str, float]


@dataclass(frozen=True, eq=False)
class ModelData:
    """The data of a fitted model of one robot.

    Its p parameters are b base parameters (rotor inertias among them), then the friction terms: values (p,) and
    covariance (p, p). `independent`, `projection` and `combinations` are those of `agent.robot.base_reduction`;
    `residual_rmse` and `held_out_rmse` (n,) [N·m] are of the fit and of its cross-validation, standstill included;
    `weights` (2, n) are the fit's, in motion and at standstill; `group_rmse` (2, n) is the held-out RMSE of the same
    groups, and `standstill_speed` (n,) up to which a joint stands still (None in older files); `cutoff` [Hz] and
    `order` are the filter's; `standard` (10 n + n,) are physical inertial parameters behind the base parameters, where
    the method found them.
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
    notes: tuple[str, ...] = ()
    effects: tuple[ModelEffect, ...] = ()
    provenance: dict[str, Any] = field(default_factory=dict)
