"""What the page and the terminal say of a result, in plain words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.diagnosis.limits import LIMITS
from agent.model import CATALOGUE

REGIMES = {
    "standstill": "standing still",
    "reversal": "around reversals",
    "low_speed": "at low speed",
    "high_speed": "at high speed",
    "high_load": "under high load",
    "acceleration": "while accelerating",
    "position_low": "in the lower third of its range",
    "position_middle": "in the middle of its range",
    "position_high": "in the upper third of its range",
    "motor_phase": "with the motor's angle",
}


def in_torque(cause: Mapping[str, Any]) -> bool:
    """Whether a cause of a result shows in torque, and not in the path alone; so does one that is not known here."""
    effect = CATALOGUE.get(cause["effect"])
    return effect is None or effect.shows_in == "torque"


def torque_gap(result: Mapping[str, Any]) -> bool:
    """Whether a result has a gap in torque, so that it makes sense to say where it is and what of it is closed."""
    causes = result["causes"]
    return result["verdict"] != "no_gap" and (not causes or any(in_torque(cause) for cause in causes))


def place(entry: Mapping[str, Any]) -> str:
    """Where a cause of a result, or one of its equivalents, sits."""
    return " and ".join(entry["joints"]) or "the whole arm"


def name(effect: str) -> str:
    """An effect's name without underscores."""
    return effect.replace("_", " ")


def phrase(effect: str, result: Mapping[str, Any]) -> str:
    """What an effect is, for somebody who has never read the vocabulary."""
    known = CATALOGUE[effect]
    return known.of_servos[0] if known.of_servos and result.get("torque_of") == "servos" else known.phrase


def look_at(effect: str, result: Mapping[str, Any]) -> str:
    """What to check on the arm."""
    known = CATALOGUE[effect]
    return known.of_servos[1] if known.of_servos and result.get("torque_of") == "servos" else known.look_at


def confidence_phrase(probability: float) -> str:
    """What to put before the first cause."""
    return "most likely" if probability >= 0.7 else "perhaps"


def closes(cause: Mapping[str, Any], whole: float | None = None) -> str:
    """What a cause closes of which gap, no more than all causes close (`whole`); empty where that cannot be said."""
    if cause["closure"] is None:
        return ""
    closure = cause["closure"] if whole is None else min(cause["closure"], whole)
    part = "all" if closure > 0.995 else f"{100 * closure:.0f} %"
    if 0 <= closure < 0.005:  # on a joint that turns with little torque, beside others
        part = "less than 1 %"
    if in_torque(cause):
        own = cause.get("closure_of_joints")
        beside = ""
        if own is not None and closure < LIMITS.least_share:  # named for what it closes of its own joints
            beside = f" and {100 * own:.0f} % of what all else leaves on {place(cause)}"
        return f"closes {part} of the gap{beside}"
    return f"closes {part} of the gap between planned and executed path"
