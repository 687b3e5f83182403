"""Friction that drifts while the drive warms up."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.model.effects.effect import Columns, Effect, FitContext, on_axle, rubs
from agent.model.effects.experiments import FROM_COLD
from agent.model.signals import MotionSignals, NominalModel

_LONGEST_SESSION = 12 * 3600.0  # s
_SHORTEST = 5.0  # s: no gear warms up faster


class ThermalFriction(Effect):
    """τ = (a + b exp(−t / T)) s + (c + d exp(−t / T)) w, t from the start of each log, or of the first of a session."""

    name = "thermal_friction"
    family = "friction"
    formula = "(a + b · exp(−t / T)) · s + (c + d · exp(−t / T)) · w"
    source = "Bittencourt, Wernholt, Sander-Tavallaey, Brogårdh, IROS (2010)"
    signature = "residual with the sign of the speed that changes from cycle to cycle"
    confused_with = ("friction_change", "torque_constant")
    phrase = "friction drifts as the drive warms up"
    look_at = "temperature of gear and motor: let the arm warm up, or compare a cold and a warm run"
    needs_speed = 0.02
    needs_reversals = 1
    shapes = ("speed",)
    experiment = FROM_COLD
    complexity_penalty = 1
    refined = ("time_constant",)
    special_cases = ("friction_change",)

    def settings(self, context: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        longest = max(float(s.time[-1]) for s in context.signals)
        session = max(s.started + float(s.time[-1]) for s in context.signals)
        each = [{"time_constant": fraction * longest} for fraction in (0.08, 0.2, 0.5, 1.5, 5.0)]
        if not longest < session < _LONGEST_SESSION:
            return each
        return each + [{"time_constant": fraction * session, "session": 1.0} for fraction in (0.1, 0.3, 0.8, 2.0)]

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return ("coulomb_change", "coulomb_drift", "viscous_change", "viscous_drift")

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        (axle,) = joints
        since = signals.time + (signals.started if "session" in settings else 0.0)
        fading = np.exp(-since / settings["time_constant"])
        slide, speed = signals.direction(axle), signals.axles.speed[:, axle]
        return on_axle(signals.reference, axle, slide, slide * fading, speed, speed * fading)

    def plausible(self, settings: Mapping[str, float], values: Mapping[str, float]) -> bool:
        return settings["time_constant"] > _SHORTEST

    def possible(
        self,
        reference: NominalModel,
        joints: tuple[int, ...],
        settings: Mapping[str, float],
        values: Mapping[str, float],
    ) -> bool:
        cold = {kind: values[f"{kind}_change"] + values[f"{kind}_drift"] for kind in ("coulomb", "viscous")}
        return rubs(reference, joints[0], **cold)

    def n_parameters(self, settings: Mapping[str, float]) -> int:
        return 5
