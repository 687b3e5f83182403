"""Torque and position channels that are not simultaneous."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import Columns, Effect, FitContext, Joints, Numbers, geometric, near_one
from agent.model.effects.experiments import SHARP_REVERSALS
from agent.model.effects.simulator_numbers import FileNumbers

_LONGEST = 0.05  # s
_BRIEF = 1e-3  # numerical: s, from where on delays are tried
_SHORTEST = 1e-4  # numerical: s, so that a delay keeps its sign
_TRIED = tuple(sign * delay for delay in geometric(_BRIEF, _LONGEST) for sign in (-1, 1))


class TimeDelay(Effect):
    """τ = a (τ_model(t − d) − τ_model(t)), a near 1: the whole predicted torque is shifted.

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
    fast_torque = True
    moves_arm = False
    numbers = FileNumbers.DELAY
    nonlinear = ()
    of_servos = ("set-points act later than they were recorded", "bus, rate and stamps of the set-points")

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        """The delay at which the share is one, by steps of Gauss and Newton from the tried one that is nearest."""

        def share(delay: float) -> float:
            return float(context.fit(self, joints, {"delay": delay})[0])

        delay = min(_TRIED, key=lambda tried: abs(share(tried) - 1))
        for _ in range(2):
            delay = float(np.clip(delay * share(delay), -_LONGEST, _LONGEST))
            delay = float(np.copysign(max(abs(delay), _SHORTEST), delay))
        return [{"delay": delay}]

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        delayed = np.clip(signals.time - settings["delay"], signals.time[0], signals.time[-1])
        shifted = _over_time(signals)(delayed)
        change = shifted - signals.predicted
        return {joint: change[:, joint, None] for joint in range(signals.q.shape[1])}

    def stepped_parameters(self, values: Numbers, inertia: Sequence[float]) -> dict[str, Any] | None:
        """No form is ahead of time."""
        return super().stepped_parameters(values, inertia) if values["delay"] > 0 else None

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return near_one(values["share"])


def _over_time(signals: MotionSignals) -> Callable[[np.ndarray], np.ndarray]:
    """The model's torque over time; remembered, as many delays are tried."""

    def made() -> Callable[[np.ndarray], np.ndarray]:
        from scipy.interpolate import CubicSpline  # slow to load

        return CubicSpline(signals.time, signals.predicted)

    return signals.remembered(("over time",), made)
