"""Torque that is periodic in the motor's or the gear's angle."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import (
    Columns,
    Effect,
    FitContext,
    Joints,
    Numbers,
    harmonic_names,
    harmonics,
    on_axle,
    travelled,
)
from agent.model.passive_forces import PassiveForces, periodic

_HIGHEST = 13.0  # periods a motor turn
_LOWEST = 8.0  # periods a joint turn: below, springs and hoses are meant; a joint without a gear may have them too
_PEAKS = 3  # numerical: lines that are tried
_FEWEST = 20  # numerical: samples that a line's mean power is of at least
_FINE = 4  # numerical: bins a period, and points of the spectrum a bin


class TorqueRipple(Effect):
    """τ = a cos(ν x) + b sin(ν x), with or without the second harmonic, x the axle's angle, ν periods a turn of it."""

    name = "torque_ripple"
    family = "transmission"
    stepped = "joint_torque_ripple"
    formula = "Σ a_h · cos(h ν x) + b_h · sin(h ν x), h = 1 or 1, 2"
    source = "Hung, Ding, IEE Proc. B 140 (1993)"
    signature = "a line in the residual over the angle of motor or gear, whatever the speed"
    confused_with = ()
    phrase = "the torque ripples with the angle of motor or gear"
    look_at = "motor orders: cogging, current sensor offsets; gear orders: damaged teeth, wave generator"
    units = MappingProxyType({"order": "1/rad", "cosine": "N·m", "sine": "N·m"})
    leading = ("cosine_1",)
    components = ("amplitude", ("cosine_1", "sine_1"))
    why_absent = "the joint turns too little to see a period"
    refined = ("order",)
    residual_driven = True
    fast_torque = True
    nonlinear = ("order",)

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        """Highest peaks of the residual's spectrum over the angle, by sums in narrow bins and one transform."""
        (axle,) = joints
        low, high = travelled(context, axle)
        gear = abs(float(context.reference.robot.gear_ratios[axle]))
        highest = _HIGHEST * max(gear, _LOWEST)
        bins = int((high - low) * highest / 2 / np.pi * _FINE) + 2
        lowest = max(_LOWEST, _two_periods(low, high))
        if bins > 2_000_000 or lowest > highest:
            return []
        sums = np.zeros(bins)
        speeds = []
        for signals, residual, sigma in zip(context.signals, context.residuals, context.sigmas, strict=True):
            position = signals.axles.position[signals.kept, axle]
            bin_of_sample = np.clip(((position - low) / (high - low) * bins).astype(int), 0, bins - 1)
            np.add.at(sums, bin_of_sample, residual[:, axle] / sigma[:, axle] ** 2)
            speeds.append(np.abs(signals.axles.speed[signals.kept, axle]))
        size = _FINE * bins
        power = np.abs(np.fft.rfft(sums, size)) ** 2
        order = 2 * np.pi * np.arange(len(power)) / size * bins / (high - low)
        speed = np.sort(np.concatenate(speeds))
        cutoff = context.reference.model.cutoff
        passing = np.searchsorted(speed, 2 * np.pi * cutoff / np.maximum(order, 1e-9))
        gain = np.where((order > lowest) & (order < highest), power, 0)
        gain = gain / np.maximum(passing, _FEWEST)
        peaks = []
        for _ in range(_PEAKS):
            best = int(np.argmax(gain))
            if gain[best] <= 0:
                break
            peaks += [{"order": float(order[best]), "harmonics": count} for count in (1.0, 2.0)]
            gain[max(0, best - 8) : best + 9] = 0
        return peaks

    def shown(self, context: FitContext, joints: Joints, settings: Numbers) -> bool:
        """Not less than two periods in all: over one, a ripple is any torque that follows the angle."""
        return settings["order"] > max(_LOWEST, _two_periods(*travelled(context, joints[0])))

    def names(self, settings: Numbers) -> tuple[str, ...]:
        return harmonic_names(settings)

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        phase = settings["order"] * signals.axles.position[:, joints[0]]
        return on_axle(signals.reference, joints[0], *harmonics(phase, settings))

    def passive_forces(self, values: Numbers, fastest: float) -> PassiveForces:
        return PassiveForces(periodic=periodic(values, values["order"]))


def _two_periods(low: float, high: float) -> float:
    """Order [1/rad] of two periods between two angles [rad]."""
    return 2 * (2 * np.pi) / (high - low)
