"""The model file: the type of each value, and whether the parts fit each other."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from agent.core import InputError
from agent.model.friction_terms import FORMS, FrictionTerm
from agent.model.rigid_friction import RigidFrictionModel
from agent.robot import ParameterLayout, RobotDescription, check_urdf

#: Squares of larger numbers, summed up, are no numbers any more; an arm's parameters are far below.
_LARGEST = 1e30
_Number = Annotated[float, Field(ge=-_LARGEST, le=_LARGEST)]
_Size = Annotated[float, Field(ge=0, le=_LARGEST)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)  # other keys, as of a later version, are left alone


class _Robot(_Part):
    name: str
    urdf: str
    tip_frame: str
    joints: list[dict[str, Any]]
    gravity: list[_Number]
    motor_coupling: list[list[_Number]]
    bodies: dict[str, list[dict[str, Any]]]
    cartesian_limits: dict[str, Any] | None


class _Filter(_Part):
    cutoff_hz: Annotated[float, Field(gt=0)]
    order: Annotated[int, Field(ge=1, le=20)]


class _BaseParameter(_Part):
    combination: str
    value: _Number | None


class _Reversal(_Part):
    kind: str
    scale: _Number


class _Friction(_Part):
    joint: str
    form: str
    reversal: _Reversal | None
    fading: _Number | None
    value: _Number | None


class _Effect(_Part):
    effect: str
    joints: list[str]
    parameters: dict[str, Any]
    intervals: dict[str, list[_Number]] = {}


class _HealthyEffect(_Part):
    effect: str
    joints: list[str]
    settings: dict[str, _Number]
    amount: dict[str, _Size] = {}
    value: dict[str, list[_Number]] = {}


class _Prior(_Part):
    mean: list[_Number]
    standard_deviation: list[_Size]
    data_share: list[_Number]


class ModelDocument(_Part):
    """A model file."""

    robot: _Robot
    method: str
    filter: _Filter
    base_parameters: list[_BaseParameter]
    friction: list[_Friction]
    effects: list[_Effect]
    healthy: list[_HealthyEffect] = []
    covariance: list[list[_Number]]
    standard_names: list[str]
    independent: list[int]
    projection: list[list[_Number]]
    standard_parameters: list[_Number] | None = None
    weights: list[list[_Size]]
    residual_rmse: list[_Size]
    held_out_rmse: list[_Size]
    group_rmse: list[list[_Size]] | None = None
    standstill_speed: list[_Size] | None = None
    sliding_rmse: list[_Size] | None = None
    noise_share: list[_Size] | None = None
    condition_number: float | None
    prior: _Prior | None = None
    notes: list[str]
    provenance: dict[str, Any]


_REVERSING = ("coulomb", "stribeck", "load")


def check_model(model: RigidFrictionModel) -> None:
    """Raise ValueError where a model read from a file cannot be used."""
    robot = model.robot
    check_robot(robot)
    n, size, b, p = robot.dof, ParameterLayout.of(robot).size, len(model.independent), len(model.values)
    if p != b + len(model.terms) or model.covariance.shape != (p, p) or len(model.combinations) != b:
        raise ValueError("the numbers of parameters and the size of their covariance differ")
    if model.projection.shape != (b, size) or len(model.standard_names) != size:
        raise ValueError("the projection does not fit the numbers of base and standard parameters")
    if np.any(model.independent < 0) or np.any(model.independent >= size):
        raise ValueError(f"independent counts standard parameters, 0 to {size - 1}")
    if len(np.unique(model.independent)) < b:
        raise ValueError("independent names a standard parameter twice")
    arrays = {
        "residual_rmse": (model.residual_rmse, (n,)),
        "held_out_rmse": (model.held_out_rmse, (n,)),
        "weights": (model.weights, (2, n)),
        "standard_parameters": (model.standard, (size,)),
        "group_rmse": (model.group_rmse, (2, n)),
        "standstill_speed": (model.standstill_speed, (n,)),
        "sliding_rmse": (model.sliding_rmse, (n,)),
        "noise_share": (model.noise_share, (n,)),
        **({} if model.prior is None else {f"prior.{key}": (array, (p,)) for key, array in vars(model.prior).items()}),
    }
    if (model.group_rmse is None) != (model.standstill_speed is None):
        raise ValueError("group_rmse and standstill_speed belong together")
    for key, (array, shape) in arrays.items():
        if array is None:
            continue
        if array.shape != shape:
            raise ValueError(f"{key} is an array of {shape} here, not of {array.shape}")
    if np.any(np.diag(model.covariance) < 0):
        raise ValueError("the covariance has a negative variance")
    for term in model.terms:
        _check_term(term)
    _check_provenance(model.provenance, n)


def _check_provenance(provenance: dict[str, Any], n: int) -> None:
    """What later commands read of where a model came from; the rest is for people."""
    logs = provenance.get("logs", [])
    if not isinstance(logs, list) or not all(isinstance(entry, dict) for entry in logs):
        raise ValueError("provenance.logs is a list of tables")
    for key in ("serial", "tool"):
        if not isinstance(provenance.get(key, []), list):
            raise ValueError(f"provenance.{key} is a list")
    if not isinstance(provenance.get("open_directions", 0), int):
        raise ValueError("provenance.open_directions is a whole number")
    if not isinstance(provenance.get("short", False), bool):
        raise ValueError("provenance.short is true or false")
    if "range" not in provenance:
        return
    for key in ("lowest", "highest", "fastest"):
        array = np.array(provenance["range"][key], dtype=float)
        if array.shape != (n,) or not np.isfinite(array).all():
            raise ValueError(f"provenance.range.{key} is {n} finite numbers, one a joint")


def check_robot(robot: RobotDescription) -> None:
    """Raise ValueError unless a description read from a model has a whole number of everything."""
    n = robot.dof
    if not 1 <= n <= 7:
        raise ValueError(f"a robot has 1 to 7 joints, not {n}")
    if np.shape(robot.gravity) != (3,) or not np.isfinite(robot.gravity).all():
        raise ValueError("gravity is three numbers")
    if np.shape(robot.motor_coupling) != (n, n) or not np.isfinite(robot.coupling).all():
        raise ValueError(f"motor_coupling is {n} rows of {n} numbers")
    if not np.isfinite(robot.gear_ratios).all() or np.any(robot.gear_ratios == 0):
        raise ValueError("gear ratios are finite and not 0")
    try:
        check_urdf("robot.urdf", ElementTree.fromstring(robot.urdf), robot.joint_names)
    except ElementTree.ParseError as error:
        raise ValueError(f"robot.urdf: {error}") from None
    except InputError as error:
        raise ValueError(str(error)) from None


def _check_term(term: FrictionTerm) -> None:
    if term.form not in FORMS:
        raise ValueError(f"unknown friction form {term.form!r}")
    if term.form in _REVERSING:
        reversal = term.reversal
        if reversal is None or reversal.kind not in ("speed", "travel") or not 0 <= reversal.scale < np.inf:
            raise ValueError(f"{term.name} needs a reversal of kind speed or travel, with a scale")
        if reversal.kind == "travel" and reversal.scale == 0:
            raise ValueError(f"{term.name}: a travel is above 0")
    if term.form == "stribeck" and (term.fading is None or not 0 < term.fading < np.inf):
        raise ValueError(f"{term.name} needs a fading speed")
