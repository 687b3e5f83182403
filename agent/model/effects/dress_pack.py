"""Hose or cable that bends with the joint."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.core import cubic_spline
from agent.model.effects.effect import Columns, Effect, FitContext
from agent.model.effects.experiments import WHOLE_RANGE
from agent.model.friction_terms import dahl
from agent.model.signals import MotionSignals, NominalModel

N_NODES = 6
_STIFFEST = 5.0  # nominal torque a radian
_TRAVEL = 0.03  # of the range, until the hose slides in itself


class DressPack(Effect):
    """τ = a + b q, or a smooth curve through torques at N_NODES positions; with hysteresis d z(q), z Dahl's state.

    The curve is the natural cubic spline over the travelled range `low` to `high`, straight beyond it: a hose may be
    slack up to some angle, harden, or give way, and its curve has no formula of its own.
    """

    name = "dress_pack"
    family = "load"
    formula = "a + b · q + d · z(q), or curve(q) + d · z(q)"
    source = "hose as a spring with inner friction (Dahl, AIAA J. 14, 1976); natural splines (de Boor, 1978)"
    signature = "residual that depends on the joint's own position, without the shape of gravity"
    confused_with = ("gravity_spring", "torque_offset", "friction_change")
    structurally_equivalent = ("gravity_spring",)
    phrase = "a hose or cable pulls at the joint"
    look_at = "hoses and cables at this joint: stiff, caught or too short"
    needs_travel = 0.2
    shapes = ("position",)
    experiment = WHOLE_RANGE
    complexity_penalty = 1
    special_cases = ("torque_offset",)

    def settings(self, context: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        low = float(min(s.q[:, joints[0]].min() for s in context.signals))
        high = max(float(max(s.q[:, joints[0]].max() for s in context.signals)), low + 1e-9)
        curve, rubbing = {"low": low, "high": high}, {"travel": _TRAVEL * (high - low)}
        return [{}, rubbing, curve, {**curve, **rubbing}]

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        nodes = tuple(f"torque_{k}" for k in range(N_NODES)) if "low" in settings else ("constant", "stiffness")
        return (*nodes, "hysteresis") if "travel" in settings else nodes

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        q = signals.q[:, joints[0]]
        parts = _curve(q, settings["low"], settings["high"]) if "low" in settings else [np.ones(len(q)), q]
        if "travel" in settings:
            parts = [*parts, dahl(q, np.array([settings["travel"]]))[:, 0]]
        return {joints[0]: np.column_stack(parts)}

    def possible(
        self,
        reference: NominalModel,
        joints: tuple[int, ...],
        settings: Mapping[str, float],
        values: Mapping[str, float],
    ) -> bool:
        return abs(values.get("stiffness", 0.0)) < _STIFFEST * float(reference.scale[joints[0]])

    def n_parameters(self, settings: Mapping[str, float]) -> int:
        return len(self.names(settings))


def _curve(q: np.ndarray, low: float, high: float) -> list[np.ndarray]:
    """(S,) of each node: the natural spline that is one there and nought at the others."""
    return list(cubic_spline(np.linspace(low, high, N_NODES), np.eye(N_NODES), q, natural=True).T)
