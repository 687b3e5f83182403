"""What the page and the terminal call an effect: words for somebody who has never read the vocabulary."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

IN_WORDS = {
    "stribeck": "friction rises as the joint slows down",
    "asymmetric_friction": "friction differs between the two directions",
    "load_dependent_friction": "friction grows with the load on the gear",
    "viscous_nonlinearity": "the speed-dependent part of friction bends",
    "thermal_friction": "friction drifts as the drive warms up",
    "presliding": "friction builds up over a travel after each reversal",
    "friction_change": "the friction level is not the model's any more",
    "joint_elasticity": "the gear gives way like a spring",
    "backlash": "the gear has play",
    "torque_ripple": "the torque ripples with the angle of motor or gear",
    "wrist_coupling": "one motor turns along with another axis",
    "payload": "there is a mass at the flange that the model does not have",
    "gravity_spring": "a balancer or spring pulls differently",
    "dress_pack": "a hose or cable pulls at the joint",
    "base_tilt": "the base does not stand as the model has it",
    "inertial_mismatch": "a link weighs otherwise than in the model",
    "contact": "something pushed the arm for a while",
    "torque_constant": "the measured torque is scaled wrongly",
    "torque_offset": "the measured torque is shifted by a constant",
    "time_delay": "torque and position are not recorded at the same time",
    "encoder_offset": "the zero position of the joint is off",
    "interpolator_mismatch": "the controller runs another path than was planned",
}

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

#: The effect that shows in the path and not in torque.
PATH = "interpolator_mismatch"


def torque_gap(result: Mapping[str, Any]) -> bool:
    """Whether a result has a gap in torque, so that it makes sense to say where it is and what of it is closed."""
    return result["verdict"] != "no_gap" and [cause["effect"] for cause in result["causes"]] != [PATH]


def place(entry: Mapping[str, Any]) -> str:
    """Where a cause of a result, or one of its equivalents, sits."""
    return " and ".join(entry["joints"]) or "the whole arm"


def name(effect: str) -> str:
    """An effect's name without underscores."""
    return effect.replace("_", " ")


def how_sure(verdict: str, probability: float) -> str:
    """What to put before the first cause."""
    if verdict == "ambiguous":
        return "one of several, first"
    return "most likely" if probability >= 0.7 else "perhaps"


def closes(cause: Mapping[str, Any]) -> str:
    """What a cause closes of which gap; empty where that cannot be said."""
    closure = cause["closure"]
    if closure is None:
        return ""
    if cause["effect"] != PATH:
        return f"closes {100 * closure:.0f} % of the gap"
    return f"closes {100 * closure:.0f} % of the gap between planned and executed path"
