"""The kinds of values in a model file; whether they fit each other is said by `checks`."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

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
    value: _Number


class _Reversal(_Part):
    kind: str
    scale: _Number


class _Friction(_Part):
    joint: str
    form: str
    reversal: _Reversal | None
    fading: _Number | None
    value: _Number


class _Effect(_Part):
    effect: str
    joints: list[str]
    parameters: dict[str, Any]
    intervals: dict[str, list[_Number]] = {}


class _HealthyEffect(_Part):
    effect: str
    joints: list[str]
    settings: dict[str, _Number]
    size: _Size


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
    condition_number: float | None
    prior: _Prior | None = None
    notes: list[str]
    provenance: dict[str, Any]
