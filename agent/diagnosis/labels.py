"""What a result says: about torque or the path alone, and whether its logs could have shown a change."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.diagnosis.limits import LIMITS
from agent.model import CATALOGUE


def shows_in_torque(cause: Mapping[str, Any]) -> bool:
    """Whether a cause of a result shows in torque, and not in the path alone; so does one that is not known here."""
    effect = CATALOGUE.get(cause["effect"])
    return effect is None or effect.shows_in == "torque"


def has_torque_gap(result: Mapping[str, Any]) -> bool:
    """Whether a result has a gap in torque, so that it makes sense to say where it is and what of it is closed."""
    causes = result["causes"]
    return result["verdict"] != "no_gap" and (not causes or any(shows_in_torque(cause) for cause in causes))


def testable_counts(result: Mapping[str, Any]) -> tuple[int, int]:
    """How many effects, joint by joint, these logs would have shown at their practical size, and of how many."""
    showing = [e["smallest"] is not None and e["smallest"] <= e["practical"] for e in result.get("power", ())]
    return sum(showing), len(showing)


def could_show(result: Mapping[str, Any]) -> bool:
    """Whether the model is good enough, and the motion rich enough, that finding nothing means something."""
    showing, count = testable_counts(result)
    return showing >= LIMITS.majority * count and (result.get("model_error") or 0.0) <= LIMITS.weak_model
