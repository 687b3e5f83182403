"""The mapping file of `agent import`: which column is what, in which unit, on which side of the gears."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from agent.core import Dimension, InputError, Quantity, line_of, read_yaml, validate_document
from agent.recording.datasets import DATASET_PRESETS
from agent.recording.tables.text_tables import ColumnTable

Side = Literal["motor", "joint"]
_TURN = 6.283185307179586
_ANGLE = {**Dimension.ANGLE.value.factors, "rev": _TURN}
_ANGULAR_SPEED = {**Dimension.ANGULAR_SPEED.value.factors, "rev/s": _TURN}
_TORQUE = {"N·m": 1.0, "Nm": 1.0, "N*m": 1.0, "N.m": 1.0, "mN·m": 1e-3, "mNm": 1e-3, "kN·m": 1e3, "kNm": 1e3}
_FORCE = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
#: A current [A] becomes a torque by the torque constant.
CURRENT = {"A": 1.0, "mA": 1e-3}
#: A share of the nominal torque, as drives report it.
OF_NOMINAL = {"%": 1e-2, "percent": 1e-2, "‰": 1e-3, "per mille": 1e-3}

#: The map of each recorder.
PRESETS = {"ur-rtde": "ur_recording.yaml", "ur-record": "ur_recording.yaml"}
#: Quantities that a recording may lack.
_OPTIONAL = ("velocity", "effort", "reference_position")
#: The limits of a factor; a larger one is a typing mistake.
USABLE = "a finite number other than 0 is expected"
_LARGEST = 1e100


def _one_or_list(what: str, *types: type) -> BeforeValidator:
    """One value for all joints, or a list with one a joint; it becomes a list either way."""

    def check(value: Any) -> list[Any]:
        values = value if isinstance(value, list) else [value]
        if not values or not all(isinstance(item, types) and not isinstance(item, bool) for item in values):
            raise ValueError(f"{what} is expected, or a list with one for each joint")
        return values

    return BeforeValidator(check)


def _usable(values: list[Any]) -> list[Any]:
    for item in values:
        if isinstance(item, (int, float)) and not 0 < abs(item) < _LARGEST:
            raise ValueError(f"{USABLE}, not {item}")
    return values


def _column(value: Any) -> Any:
    if not isinstance(value, (str, int)) or isinstance(value, bool):
        raise ValueError("a column is expected, by name or by number from 1")
    return value


Time = Annotated[float, Quantity(Dimension.TIME)]
Frequency = Annotated[float, Quantity(Dimension.FREQUENCY)]
_Names = Annotated[Any, _one_or_list("a column, by name or by number from 1,", str, int)]
_Unit = Annotated[Any, _one_or_list('a unit such as "rad"', str)]
_Scale = Annotated[
    Any, _one_or_list("a number or the name of a constant of the file", int, float, str), AfterValidator(_usable)
]
_Offset = Annotated[Any, _one_or_list('an offset such as "90 deg"', int, float, str)]
_Number = Annotated[Any, _one_or_list("a number", int, float), AfterValidator(_usable)]


class _MappingPart(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, populate_by_name=True, strict=True)


class TimeColumn(_MappingPart):
    """`time:` the column with the time of each row, or columns whose sum it is, such as seconds and nanoseconds."""

    column: Annotated[Any, BeforeValidator(_column)] = None
    columns: _Names = None
    unit: _Unit = None
    file: str | None = None

    @model_validator(mode="after")
    def _column_or_columns(self) -> TimeColumn:
        if (self.column is None) == (self.columns is None):
            raise ValueError("give either column, or columns such as [sec, nanosec]")
        if len(self.units()) != len(self.names()):
            raise ValueError(f"unit: {len(self.names())} units are expected, such as [s, ns]")
        return self

    def names(self) -> list[str | int]:
        """The columns to add up."""
        return self.columns or [self.column]

    def units(self) -> list[str]:
        """One a column: seconds, and nanoseconds of a second column."""
        return self.unit or ["s", "ns"][: len(self.names())]


class RowSelection(_MappingPart):
    """`rows:` those in which a column has a value; of a list, rows with the k-th value are of the k-th joint."""

    column: Annotated[Any, BeforeValidator(_column)]
    equals: int | float | Annotated[list[int | float | str], Field(min_length=2)]
    file: str | None = None


class Columns(_MappingPart):
    """One quantity of all joints. SI = column · scale · unit."""

    columns: _Names
    unit: _Unit = (None,)
    file: str | list[str] | None = None
    scale: _Scale = (1.0,)
    side: Side | None = None


class PositionColumns(Columns):
    """Positions; `offset` is added on the joint side."""

    offset: _Offset = None


class EffortColumns(Columns):
    """Torques, forces or motor currents; `torque_constant` [N·m/A, motor side] instead of the robot description's."""

    torque_constant: _Number = None


class TimeWindow(_MappingPart):
    """`window:` rows whose time is in [from, to)."""

    start: Time = Field(alias="from")
    stop: Time = Field(alias="to")

    @model_validator(mode="after")
    def _in_order(self) -> TimeWindow:
        if self.start >= self.stop:
            raise ValueError(f"from {self.start:g} s to {self.stop:g} s is no stretch of time")
        return self


class ImportMap(_MappingPart):
    """A mapping file."""

    motion: str = "imported"
    serial: str | None = None
    tool: str | None = None
    controller: str | None = None
    side: Side = "joint"
    rate: Annotated[Frequency, Field(gt=0, le=1e6)] | None = None
    time: TimeColumn | None = None
    position: PositionColumns
    velocity: Columns | None = None
    effort: EffortColumns | None = None
    reference_position: PositionColumns | None = None
    planned_position: PositionColumns | None = None
    window: TimeWindow | None = None
    rows: RowSelection | None = None
    decimate: Annotated[int, Field(ge=2)] | None = None
    cycle_period: Annotated[Time, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _one_clock(self) -> ImportMap:
        if (self.rate is None) == (self.time is None):
            raise ValueError("give either rate (rows are evenly sampled) or time (a column), not both and not neither")
        return self


@dataclass(frozen=True)
class Mapping:
    """A mapping file and what it takes to point into it.

    `preset`: it is that of a recorder. Then rows that repeat a time are dropped, and currents need no torque constant.
    """

    path: Path
    document: Any
    entries: ImportMap
    preset: bool = False

    def fault(self, key: str, message: str) -> NoReturn:
        """Refuse the mapping at a key such as `position.columns`.

        Raises:
            InputError: always.
        """
        raise InputError(f"{self.path}:{line_of(self.document, tuple(key.split('.')))}: {key}: {message}")


def load_mapping(path: Path) -> Mapping:
    """Read a mapping file.

    Raises:
        InputError: with file, line and key of every fault.
    """
    document = read_yaml(path)
    return Mapping(path, document, validate_document(path, document, ImportMap))


def preset_map(name: str, tables: Sequence[ColumnTable]) -> tuple[Mapping, list[str]]:
    """The map of a recorder for these tables, and what there is to say: quantities and marks that they do not have.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"--preset {name!r} is not known; there are {', '.join((*PRESETS, *DATASET_PRESETS))}")
    mapping = load_mapping(Path(str(files("agent.recording") / PRESETS[name])))
    changes: dict[str, None] = {}
    notes = []
    for quantity in _OPTIONAL:
        columns = getattr(mapping.entries, quantity).columns
        if not any(all(table.column(column) is not None for column in columns) for table in tables):
            changes[quantity] = None
            notes.append(f"no {columns[0]} and its like: {quantity} is left out")
    rows = mapping.entries.rows
    if rows is not None:
        marks = [column for table in tables if (column := table.column(rows.column)) is not None]
        if not any(np.any(mark == rows.equals) for mark in marks):
            changes["rows"] = None
            notes.append(f"no row has {rows.column} {rows.equals:g} (a program runs), so all rows are taken")
    return replace(mapping, entries=mapping.entries.model_copy(update=changes), preset=True), notes


def units_of(quantity: str, linear: bool) -> dict[str, float]:
    """Units a column of `position`, `velocity` or `effort` may have, with their SI factors; the SI unit first."""
    if quantity == "velocity":
        return Dimension.SPEED.value.factors if linear else _ANGULAR_SPEED
    if quantity == "effort":
        return (_FORCE if linear else _TORQUE) | CURRENT | OF_NOMINAL
    return Dimension.LENGTH.value.factors if linear else _ANGLE
