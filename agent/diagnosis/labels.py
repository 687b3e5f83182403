"""Whether what a result says is about torque, or about the path alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.model import CATALOGUE


def in_torque(cause: Mapping[str, Any]) -> bool:
    """Whether a cause of a result shows in torque, and not in the path alone; so does one that is not known here."""
    effect = CATALOGUE.get(cause["effect"])
    return effect is None or effect.shows_in == "torque"


def torque_gap(result: Mapping[str, Any]) -> bool:
    """Whether a result has a gap in torque, so that it makes sense to say where it is and what of it is closed."""
    causes = result["causes"]
    return result["verdict"] != "no_gap" and (not causes or any(in_torque(cause) for cause in causes))
