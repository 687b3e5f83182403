"""Torque and position channels that are not simultaneous."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.model.effects.effect import Columns, Effect, FitContext
from agent.model.effects.experiments import SHARP_REVERSALS
from agent.model.signals import MotionSignals

_TRIED = (-0.02, -0.012, -0.007, -0.004, -0.002, -0.001, 0.001, 0.002, 0.004, 0.007, 0.012, 0.02)


class TimeDelay(Effect):
    """τ = a (τ_model(t − d) − τ_model(t)), a near 1: the whole predicted torque is shifted."""

    name = "time_delay"
    family = "measurement"
    scope = "arm"
    formula = "τ(t − d) − τ(t)"
    source = "by definition: the torque channel shifted against the position channel"
    signature = "residual on all joints wherever torque changes fast"
    confused_with = ("joint_elasticity",)
    phrase = "torque and position are not recorded at the same time"
    look_at = "time stamps and filters of the torque and position channels"
    experiment = SHARP_REVERSALS
    residual_driven = True
    fast_torque = True
    moves_arm = False

    def settings(self, survey: FitContext, joints: tuple[int, ...]) -> list[dict[str, float]]:
        tried = [{"delay": delay} for delay in _TRIED]
        best = min(tried, key=lambda s: abs(float(survey.fit(self, joints, s)[0]) - 1))
        delay = best["delay"]
        for _ in range(2):
            delay = float(np.clip(delay * survey.fit(self, joints, {"delay": delay})[0], -0.05, 0.05))
            delay = float(np.copysign(max(abs(delay), 1e-4), delay))
        return [{"delay": delay}]

    def names(self, settings: Mapping[str, float]) -> tuple[str, ...]:
        return ("share",)

    def columns(self, signals: MotionSignals, joints: tuple[int, ...], settings: Mapping[str, float]) -> Columns:
        from scipy.interpolate import CubicSpline

        late = np.clip(signals.time - settings["delay"], signals.time[0], signals.time[-1])
        change = CubicSpline(signals.time, signals.predicted)(late) - signals.predicted
        return {joint: change[:, joint, None] for joint in range(signals.q.shape[1])}

    def plausible(self, settings: Mapping[str, float], values: Mapping[str, float]) -> bool:
        return 0.5 < values["share"] < 1.5

    def n_parameters(self, settings: Mapping[str, float]) -> int:
        return 1
