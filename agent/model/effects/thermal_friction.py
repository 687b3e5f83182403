"""Friction that drifts while the drive warms up."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import FitContext, Joints, Numbers, rubs
from agent.model.effects.experiments import FROM_COLD
from agent.model.effects.friction_level import FrictionLevel

_LONGEST_SESSION = 12 * 3600.0  # s
_SHORTEST = 5.0  # s: no gear warms up faster
_LEAST_WAY = 1.0  # rad: nor within a sixth of a turn
_STARTS = "within_first_log"
_PARTS = (0.1, 0.3, 1.0, 3.0)  # of the time or way that is looked at


class ThermalFriction(FrictionLevel):
    """τ = (a + b c(t)) s + (d + e c(t)) w, where c(t) says how cold the drive still is.

    c = exp(−t / T), with t from the start of each log, or of the first log of a session. Heat comes from the work of
    friction, so where the arm pauses or its speed varies, c = exp(−x / W) with x the distance travelled, likewise.
    """

    name = "thermal_friction"
    family = "friction"
    stepped = "joint_thermal_friction"
    usual = True
    formula = "(a + b · c) · s + (d + e · c) · w, c = exp(−t / T) or exp(−∫|w| dt / W)"
    linear = ("coulomb_change", "coulomb_drift", "viscous_change", "viscous_drift")
    source = "Bittencourt, Wernholt, Sander-Tavallaey, Brogårdh, IROS (2010)"
    signature = "residual with the sign of the speed that changes from cycle to cycle"
    confused_with = ("friction_change", "torque_constant")
    phrase = "friction drifts as the drive warms up"
    look_at = "the temperature of gear and motor: let the arm warm up, or compare a cold and a warm run"
    units = MappingProxyType({"coulomb": "N·m", "viscous": "N·m·s/rad", "time_constant": "s", "way": "rad"})
    leading = ("coulomb_drift", "viscous_drift")
    needs_reversals = 1  # derived: friction shows where its sign changes
    shapes = ("speed",)
    experiment = FROM_COLD
    refined = ("time_constant", "way", "reversal_travel")
    not_reported = ("session", _STARTS)
    nonlinear = ("time_constant", "way", "reversal_travel")

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        (axle,) = joints
        motions = context.signals
        longest = max(float(s.time[-1]) for s in motions)
        session = max(s.started + float(s.time[-1]) for s in motions)
        each = {s.log_index: 0.0 for s in motions}
        for s in motions:
            each[s.log_index] += float(_travelled(s, axle)[-1])
        furthest, whole = max(each.values()), sum(each.values())
        first = min(motions, key=lambda s: (s.started, float(s.time[0]))).log_index
        start = max(float(s.time[-1]) for s in motions if s.log_index == first)
        within_log = [
            *({"time_constant": fraction * longest} for fraction in _PARTS),
            *({"way": fraction * furthest} for fraction in _PARTS),
        ]
        if not longest < session < _LONGEST_SESSION:
            return within_log
        return [
            *within_log,
            *({"time_constant": fraction * session, "session": 1.0} for fraction in _PARTS),
            *({"way": fraction * whole, "session": 1.0} for fraction in _PARTS),
            *(
                {name: fraction * whole_log, "session": 1.0, _STARTS: 1.0}
                for name, whole_log, least in (("time_constant", start, _SHORTEST), ("way", each[first], _LEAST_WAY))
                for fraction in _PARTS[:2]  # warm before the first log ends
                if fraction * whole_log > least
            ),
        ]

    def is_transient(self, settings: Numbers) -> bool:
        """If the drive is warm before the first log of a session ends, no other log shows that it was cold."""
        return _STARTS in settings

    def prepare(self, motions: Sequence[MotionSignals], wanted: Sequence[tuple[Joints, Numbers]]) -> None:
        """Store in every motion the distance travelled before it, in its log and in the session."""
        gone: dict[int, np.ndarray] = {}
        whole = np.zeros(motions[0].q.shape[1])
        for motion in sorted(motions, key=lambda s: (s.started, s.log_index, float(s.time[0]))):
            before = gone.setdefault(motion.log_index, np.zeros(len(whole)))
            motion.memory["gone"] = before, whole
            distance = np.array([float(_travelled(motion, axle)[-1]) for axle in range(len(whole))])
            gone[motion.log_index], whole = before + distance, whole + distance

    def level_columns(self, signals: MotionSignals, axle: int, settings: Numbers) -> tuple[np.ndarray, ...]:
        if "way" in settings:
            before = signals.memory.get("gone", (np.zeros(signals.q.shape[1]),) * 2)["session" in settings][axle]
            fading = np.exp(-(before + _travelled(signals, axle)) / settings["way"])
        else:
            since = signals.time + (signals.started if "session" in settings else 0.0)
            fading = np.exp(-since / settings["time_constant"])
        slide, speed = signals.direction(axle), signals.axles.speed[:, axle]
        return slide, slide * fading, speed, speed * fading

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return settings.get("time_constant", np.inf) > _SHORTEST and settings.get("way", np.inf) > _LEAST_WAY

    def level_possible(self, reference: NominalModel, axle: int, settings: Numbers, values: Numbers) -> bool:
        cold = {kind: values[f"{kind}_change"] + values[f"{kind}_drift"] for kind in ("coulomb", "viscous")}
        return rubs(reference, axle, **cold)


def _travelled(signals: MotionSignals, axle: int) -> np.ndarray:
    """(S,) distance that an axle has travelled since the first sample [rad]."""
    q = signals.axles.position[:, axle]
    return signals.remembered(("travelled", axle), lambda: np.cumsum(np.abs(np.diff(q, prepend=q[0]))))
