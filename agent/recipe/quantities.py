"""Values of a recipe with their units, as pydantic types that convert to SI."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field, WithJsonSchema

from agent.core import Bare, Dimension, InputError, Quantity, parse_quantity

FULL_TURN = 6.283185307179586

#: Largest plausible numbers without a unit: an arm reaches a few metres, and an angle is at most one turn.
BARE_PLACE = Bare("mm", 10.0)
BARE_REACH = Bare("mm", 2.0)
BARE_ANGLE = Bare("deg", FULL_TURN)
BARE_LEAN = Bare("deg", FULL_TURN / 4)

Place = Annotated[float, Quantity(Dimension.LENGTH, BARE_PLACE)]
Reach = Annotated[float, Quantity(Dimension.LENGTH, BARE_REACH)]
Angle = Annotated[float, Quantity(Dimension.ANGLE, BARE_ANGLE)]
Lean = Annotated[float, Quantity(Dimension.ANGLE, BARE_LEAN)]
Mass = Annotated[float, Quantity(Dimension.MASS, Bare("g", 500.0))]
Time = Annotated[float, Quantity(Dimension.TIME)]
Interval = Annotated[float, Quantity(Dimension.TIME, Bare("d", least=3600.0))]
Frequency = Annotated[float, Quantity(Dimension.FREQUENCY, Bare("kHz", least=1.0))]
Speed = Annotated[float, Quantity(Dimension.SPEED, Bare("mm/s", 10.0))]
Ratio = Annotated[float, Quantity(Dimension.RATIO, Bare("%", 1.0))]
GateRatio = Annotated[float, Quantity(Dimension.RATIO, Bare("%", 0.1))]


def _joint_position(value: Any) -> Any:
    # The joint decides whether it is an angle or a length, so the text is kept until the robot is known.
    try:
        parse_quantity(value, Dimension.ANGLE)
    except InputError as error:
        try:
            parse_quantity(value, Dimension.LENGTH)
        except InputError:
            raise ValueError(str(error)) from None
    return value


_POSITION = {"anyOf": [{"type": "number"}, {"type": "string"}], "description": "rad or m, by the kind of the joint"}
JointPosition = Annotated[float | str, BeforeValidator(_joint_position), WithJsonSchema(_POSITION)]


def _list_of(names: str, count: int) -> BeforeValidator:
    def check(value: Any) -> Any:
        if not isinstance(value, (list, tuple)) or len(value) != count:
            got = f"{len(value)} values" if isinstance(value, (list, tuple)) else type(value).__name__
            raise ValueError(f"a list of {count} values [{names}] is expected, not {got}")
        return value

    return BeforeValidator(check)


_FARTHEST = 100.0  # m: farther than any arm on any track
_Place = Annotated[Place, Field(ge=-_FARTHEST, le=_FARTHEST)]
_Heading = Annotated[Angle, Field(ge=-2 * FULL_TURN, le=2 * FULL_TURN)]
Position = Annotated[tuple[_Place, _Place, _Place], _list_of("x, y, z", 3)]
Orientation = Annotated[tuple[_Heading, _Heading, _Heading], _list_of("a, e, r", 3)]
Pose = Annotated[tuple[_Place, _Place, _Place, _Heading, _Heading, _Heading], _list_of("x, y, z, a, e, r", 6)]

_ToolPlace = Annotated[Reach, Field(ge=-_FARTHEST, le=_FARTHEST)]
ToolPosition = Annotated[tuple[_ToolPlace, _ToolPlace, _ToolPlace], _list_of("x, y, z", 3)]
ToolPose = Annotated[
    tuple[_ToolPlace, _ToolPlace, _ToolPlace, _Heading, _Heading, _Heading], _list_of("x, y, z, a, e, r", 6)
]

_Extent = Annotated[Reach, Field(ge=0, le=_FARTHEST)]
Radius = Annotated[Reach, Field(ge=1e-4, le=_FARTHEST)]
_Turn = Annotated[Lean, Field(ge=0, le=FULL_TURN)]
JointRange = Annotated[tuple[JointPosition, JointPosition], _list_of("lower, upper", 2)]
Extent = Annotated[tuple[_Extent, _Extent, _Extent], _list_of("dx, dy, dz", 3)]
Range = Annotated[tuple[_Extent, _Extent, _Extent, _Turn, _Turn, _Turn], _list_of("dx, dy, dz, da, de, dr", 6)]
Name = Annotated[str, Field(min_length=1, max_length=200, strict=True)]
Count = Annotated[int, Field(strict=True)]
Seed = Annotated[Count, Field(ge=0, lt=2**32)]
