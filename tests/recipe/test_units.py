import contextlib
import math

import pytest
from hypothesis import given, strategies as st

from agent.core import Dimension, InputError, parse_quantity

EVERY_UNIT = [(dimension, unit) for dimension in Dimension for unit in dimension.value.factors]


@pytest.mark.parametrize(
    ("text", "dimension", "si"),
    [
        ("20 mm", Dimension.LENGTH, 0.02),
        ("20mm", Dimension.LENGTH, 0.02),
        ("  -1.5e2 cm ", Dimension.LENGTH, -1.5),
        ("180 deg", Dimension.ANGLE, math.pi),
        ("7 d", Dimension.TIME, 604_800.0),
        ("90 min", Dimension.TIME, 5400.0),
        ("2100 g", Dimension.MASS, 2.1),
        ("0.5 kHz", Dimension.FREQUENCY, 500.0),
        ("250 mm/s", Dimension.SPEED, 0.25),
        ("60 rpm", Dimension.ANGULAR_SPEED, 2 * math.pi),
        ("3 %", Dimension.RATIO, 0.03),
        ("1e-3", Dimension.LENGTH, 1e-3),
        (0.25, Dimension.RATIO, 0.25),
        (3, Dimension.LENGTH, 3.0),
    ],
)
def test_a_quantity_is_converted_to_si(text: object, dimension: Dimension, si: float) -> None:
    assert parse_quantity(text, dimension) == pytest.approx(si, rel=1e-15)


@given(st.sampled_from(EVERY_UNIT), st.floats(-1e6, 1e6))
def test_every_unit_has_its_conversion_factor(unit: tuple[Dimension, str], number: float) -> None:
    dimension, name = unit
    assert parse_quantity(f"{number!r} {name}", dimension) == number * dimension.value.factors[name]


@given(st.sampled_from(EVERY_UNIT), st.sampled_from(list(Dimension)))
def test_a_unit_of_another_dimension_names_what_is_allowed(unit: tuple[Dimension, str], dimension: Dimension) -> None:
    if unit[1] in dimension.value.factors:
        return
    with pytest.raises(InputError) as error:
        parse_quantity(f"1 {unit[1]}", dimension)
    assert all(allowed in str(error.value) for allowed in dimension.value.factors)
    assert unit[0].value.name in str(error.value)


@pytest.mark.parametrize(
    "value",
    [
        True,
        None,
        [],
        {},
        "",
        "mm",
        "1 2 mm",
        "1 Mm",
        "nan",
        "inf m",
        "1e999 m",
        1e999,
        math.nan,
        10**400,
        "0x10 m",
        "٣ m",
    ],
)
def test_refuses_a_non_finite_length(value: object) -> None:
    with pytest.raises(InputError, match="a length"):
        parse_quantity(value, Dimension.LENGTH)


@given(st.one_of(st.text(), st.integers(), st.floats(), st.none(), st.booleans(), st.binary(), st.lists(st.text())))
def test_any_value_gives_a_finite_number_or_an_input_error(value: object) -> None:
    with contextlib.suppress(InputError):
        assert math.isfinite(parse_quantity(value, Dimension.TIME))
