"""A mass that a person has mounted at the flange and knows. The model carries it, so none of it is left to explain.

Its part of the standard parameters π of the last link is known, and base parameters are linear in them: β' = β + P Δπ.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TypeVar

import numpy as np

from agent.core import Bare, Dimension, InputError, parse_quantity
from agent.model.rigid_friction import RigidFrictionModel
from agent.robot import ParameterLayout, Tool

#: What a log's metadata calls it.
PAYLOAD = "payload"
_FORM = "mass and centre of mass in the flange's frame, as '5 kg, 0 mm, 0 mm, 60 mm'"
_HEAVIEST, _FARTHEST = 10_000.0, 10.0  # kg, m

Model = TypeVar("Model", bound=RigidFrictionModel)


def payload_of(text: str) -> Tool:
    """The mass that a text says, a point at its centre.

    Raises:
        InputError: not a mass and three lengths, or an impossible mass.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 4:
        raise InputError(f"payload {text!r}: {_FORM} is expected")
    try:
        mass = parse_quantity(parts[0], Dimension.MASS, Bare("kg"))
        centre = np.array([parse_quantity(part, Dimension.LENGTH, Bare("mm", _FARTHEST)) for part in parts[1:]])
    except InputError as error:
        raise InputError(f"payload {text!r}: {error}; {_FORM} is expected") from None
    if not 0 < mass <= _HEAVIEST or not np.all(np.abs(centre) <= _FARTHEST):
        raise InputError(
            f"payload {text!r}: a mass above zero and up to {_HEAVIEST:g} kg, and a centre of mass within "
            f"{_FARTHEST:g} m"
        )
    return Tool(np.eye(4), mass, centre)


def payload_text(payload: Tool) -> str:
    """The same as a text that `payload_of` reads."""
    centre = np.zeros(3) if payload.centre_of_mass is None else payload.centre_of_mass
    return ", ".join([f"{payload.mass:g} kg", *(f"{1000 * value:g} mm" for value in centre)])


def known_payload(metadata: Mapping[str, str]) -> Tool | None:
    """What was mounted while a log was recorded; None where nobody said so.

    Raises:
        InputError: it says something else.
    """
    return payload_of(metadata[PAYLOAD]) if metadata.get(PAYLOAD) else None


def carrying(model: Model, payload: Tool) -> Model:
    """The model of the same arm with the mass on it."""
    from agent.robot import Dynamics

    bare, loaded = (Dynamics(model.robot, tool).standard_parameters() for tool in (None, payload))
    change = np.zeros(model.projection.shape[1])
    change[ParameterLayout.of(model.robot).links] = loaded - bare
    values = model.values.copy()
    values[: len(model.independent)] += model.projection @ change
    return replace(model, values=values)
