"""Torque and position channels that are not simultaneous."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import Columns, Effect, FitContext, Joints, Numbers, geometric, near_one
from agent.model.effects.experiments import SHARP_REVERSALS
from agent.model.friction_terms import axle_columns

_ABSORBED = 1e-3  # s, from where on a fitted reversal of friction may have taken part of the delay
_SHARPER = (0.7, 0.35)  # parts, middles of two octaves, of the way over which the model's friction turns
_LONGEST = 0.05  # s
_SHORTEST = 1e-4  # numerical: s, so that a delay keeps its sign
_TRIED = tuple(sign * delay for delay in geometric(_ABSORBED, _LONGEST) for sign in (-1, 1))


class TimeDelay(Effect):
    """τ = a (τ_model(t − d) − τ_model(t)), a near 1: the whole predicted torque is shifted.

    A model that was fitted to late torque lets friction turn over too long a way, as that looks late too. So what is
    shifted may turn over a part `reversal` of the model's way. Friction of a simulator turns sharply and has none.

    Where the torque is that of position servos at recorded set-points r, these act late: τ = a k (r(t) − r(t − d)).
    """

    name = "time_delay"
    family = "measurement"
    stepped = "reading_late"
    usual = True
    scope = "arm"
    formula = "τ(t − d) − τ(t)"
    linear = ("share",)
    source = "by definition: the torque channel shifted against the position channel"
    signature = "residual on all joints wherever torque changes fast"
    confused_with = ("joint_elasticity",)
    phrase = "torque and position are not recorded at the same time"
    look_at = "time stamps and filters of the torque and position channels"
    units = MappingProxyType({"delay": "s"})
    leading = ("delay",)
    experiment = SHARP_REVERSALS
    residual_driven = True
    refined = ("reversal",)
    fast_torque = True
    moves_arm = False
    numbers = "delay of the command"
    of_servos = ("set-points act later than they were recorded", "bus, rate and stamps of the set-points")
    nonlinear = ("reversal",)

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        plain = self._solved(context, joints, {})
        if abs(plain["delay"]) < _ABSORBED or not _turns_slowly(context.reference):
            return [plain]
        return [plain, *(self._solved(context, joints, {"reversal": part}) for part in _SHARPER)]

    def _solved(self, context: FitContext, joints: Joints, settings: dict[str, float]) -> dict[str, float]:
        """The delay at which the share is one, by two steps of Gauss and Newton from the one that is nearest to it."""

        def share(delay: float) -> float:
            return float(context.fit(self, joints, {**settings, "delay": delay})[0])

        delay = min(_TRIED, key=lambda tried: abs(share(tried) - 1))
        for _ in range(2):
            delay = float(np.clip(delay * share(delay), -_LONGEST, _LONGEST))
            delay = float(np.copysign(max(abs(delay), _SHORTEST), delay))
        return {**settings, "delay": delay}

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        late = np.clip(signals.time - settings["delay"], signals.time[0], signals.time[-1])
        shifted = _over_time(signals, settings.get("reversal"))(late)
        change = shifted - signals.predicted
        return {joint: change[:, joint, None] for joint in range(signals.q.shape[1])}

    def stepped_parameters(self, values: Numbers, inertia: Sequence[float]) -> dict[str, Any] | None:
        """No form is ahead of time."""
        return super().stepped_parameters(values, inertia) if values["delay"] > 0 else None

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return near_one(values["share"])


def _over_time(signals: MotionSignals, part: float | None) -> Callable[[np.ndarray], np.ndarray]:
    """Of the torque that is shifted over time: that of set-points, or the model's, its friction turning over a `part`
    of the way; remembered, as many delays are tried."""

    def made() -> Callable[[np.ndarray], np.ndarray]:
        from scipy.interpolate import CubicSpline  # slow to load

        torque = signals.predicted if part is None else _turning_faster(signals, part)
        return CubicSpline(signals.time, torque)

    return signals.remembered(("over time", part), made)


def _turns_slowly(reference: NominalModel) -> bool:
    """Whether friction turns over a way, or a speed, that may have taken up a delay."""
    turns = [(term.axle, term.reversal) for term in reference.model.terms if term.reversal is not None]
    return any(r.kind == "travel" or r.scale > (1 + 1e-6) * reference.sharp_reversal(axle).scale for axle, r in turns)


def _turning_faster(signals: MotionSignals, part: float) -> np.ndarray:
    """(S, n) torque of the model, its friction turning over a part of the way or speed."""
    model, coupling = signals.reference.model, signals.reference.coupling
    faster = (t.reversal and replace(t.reversal, scale=part * t.reversal.scale) for t in model.terms)
    terms = tuple(replace(term, reversal=reversal) for term, reversal in zip(model.terms, faster, strict=True))
    columns = axle_columns(terms, signals.axles) * model.friction_values
    axles = [[k for k, term in enumerate(terms) if term.axle == axle] for axle in range(len(coupling))]
    friction = np.stack([columns[:, own].sum(axis=1) for own in axles], axis=1)
    return signals.rigid + friction @ coupling
