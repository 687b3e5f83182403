"""Quantities as people write them in a recipe: a number and a unit. SI comes out; a bare number is SI already."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any

from annotated_types import GroupedMetadata

from agent.core.errors import InputError

_NUMBER = r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_QUANTITY = re.compile(rf"\s*({_NUMBER})\s*(.*?)\s*", re.DOTALL)


@dataclass(frozen=True)
class _Units:
    name: str
    example: str
    factors: dict[str, float]


class Dimension(Enum):
    """Dimension of a quantity, with its accepted units."""

    LENGTH = _Units("a length", "20 mm", {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6})
    ANGLE = _Units("an angle", "30 deg", {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "°": math.pi / 180})
    MASS = _Units("a mass", "2.1 kg", {"kg": 1.0, "g": 1e-3})
    TIME = _Units(
        "a time", "7 d", {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "min": 60.0, "h": 3600.0, "d": 86400.0}
    )
    FREQUENCY = _Units("a frequency", "500 Hz", {"Hz": 1.0, "kHz": 1e3})
    SPEED = _Units(
        "a speed", "0.1 m/s", {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "m/min": 1 / 60.0, "mm/min": 1e-3 / 60.0}
    )
    ANGULAR_SPEED = _Units(
        "an angular speed",
        "60 deg/s",
        {"rad/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180, "rpm": math.pi / 30},
    )
    RATIO = _Units("a ratio", "3 %", {"%": 1e-2})

    @property
    def description(self) -> str:
        """For example: a length ("20 mm"; units m, cm, mm, um, µm; a bare number is in m)."""
        units = list(self.value.factors)
        bare = "a bare number is a fraction of one" if self is Dimension.RATIO else f"a bare number is in {units[0]}"
        word = "unit" if len(units) == 1 else "units"
        return f'{self.value.name} ("{self.value.example}"; {word} {", ".join(units)}; {bare})'


@dataclass(frozen=True)
class Bare:
    """Plausible range [SI] of a number without a unit, and the unit that was probably meant beyond it.

    A whole number of that unit is what people forget to write a unit behind: `30` for 30 deg, `7` for 7 d.
    """

    meant: str
    most: float = math.inf
    least: float = 0.0

    def __contains__(self, number: float) -> bool:
        return number == 0 or self.least <= abs(number) <= self.most


@dataclass(frozen=True)
class Quantity(GroupedMetadata):
    """Marks a field of a pydantic model that people write as a quantity: ``Annotated[float, Quantity(LENGTH)]``.

    Bounds of a `Field` next to it are checked on the SI value.
    """

    dimension: Dimension
    bare: Bare | None = None

    def __iter__(self) -> Iterator[object]:
        from pydantic import BeforeValidator, WithJsonSchema

        yield BeforeValidator(self._parse)
        written = [{"type": "number"}, {"type": "string"}]
        yield WithJsonSchema({"anyOf": written, "description": self.dimension.description})

    def _parse(self, value: Any) -> float:
        try:
            return parse_quantity(value, self.dimension, self.bare)
        except InputError as error:
            raise ValueError(str(error)) from None


def parse_quantity(value: Any, dimension: Dimension, bare: Bare | None = None) -> float:
    """The SI value of a number, or of a text such as ``"20 mm"``; `bare` says which numbers need no unit, None: all.

    Args:
        value: number, or text with a unit.
        dimension: what it measures.
        bare: which numbers need no unit; None: all.

    Raises:
        InputError: not a number, not finite, a unit of another dimension, or a number that needs a unit; says what is
            allowed.
    """
    number = _parse(value, dimension)
    if bare is not None and number not in bare and _has_no_unit(value):
        raise InputError(_needs_unit(number, dimension, bare))
    return number


def _has_no_unit(value: Any) -> bool:
    return not isinstance(value, str) or re.fullmatch(rf"\s*{_NUMBER}\s*", value) is not None


def _needs_unit(number: float, dimension: Dimension, bare: Bare) -> str:
    si = f"{100 * number:g} %" if dimension is Dimension.RATIO else f"{number:g} {next(iter(dimension.value.factors))}"
    text = f"a number without a unit is SI, and {si} is hardly meant here"
    guess = f"{number:g} {bare.meant}"
    return f"{text}; did you mean {guess}?" if parse_quantity(guess, dimension) in bare else f"{text}; write the unit"


def _parse(value: Any, dimension: Dimension) -> float:
    expected = f"{dimension.description} is expected"
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise InputError(f"{expected}, not {kind_of(value)}")
    try:
        number = _parse_text(value, dimension, expected) if isinstance(value, str) else float(value)
    except OverflowError:
        raise InputError(f"{expected}, and this number is too large") from None
    if not math.isfinite(number):
        raise InputError(f"{expected}, and it must be finite")
    return number


def _parse_text(text: str, dimension: Dimension, expected: str) -> float:
    match = _QUANTITY.fullmatch(text)
    if match is None:
        raise InputError(f"{expected}, not {_shortened(text)}")
    number, unit = float(match[1]), match[2]
    if not unit:
        return number
    factor = dimension.value.factors.get(unit)
    if factor is not None:
        return number * factor
    other = next((d for d in Dimension if unit in d.value.factors), None)
    what = f"{unit!r} is a unit of {other.value.name}" if other else f"{_shortened(unit)} is not a unit known here"
    raise InputError(f"{expected}; {what}")


def kind_of(value: Any) -> str:
    """Name the type of a document's value for messages."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, dict):
        return "a mapping"
    return "a list" if isinstance(value, list) else type(value).__name__


def _shortened(text: str) -> str:
    return repr(text if len(text) <= 40 else text[:37] + "...")
