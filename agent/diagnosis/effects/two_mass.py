"""Rotor and link with a gear that gives way between them, driven by the rigid load."""

from __future__ import annotations

import numpy as np

from agent.diagnosis.signals import Signals

_SUBSTEPS = 3


def twist_acceleration(
    signals: Signals, joints: np.ndarray, stiffness: np.ndarray, gap: np.ndarray, damping_ratio: float
) -> np.ndarray:
    """(S, K) second derivative of the motor's lead d over the link [rad/s²], for K joints, stiffnesses and plays (K,).

    The motor moves as measured, so the link obeys m d̈ + c ḋ + k z(d) = L, with L the torque the rigid link would take,
    m its inertia about the joint and z(d) the twist beyond half the play (without play z(d) = d). Semi-implicit steps,
    all K at once.
    """
    k, half = np.asarray(stiffness, dtype=float), 0.5 * np.asarray(gap, dtype=float)
    load = np.ascontiguousarray(signals.link_load[:, joints])
    inertia = np.maximum(signals.mass[:, joints, joints], 1e-9)
    step = float(np.median(np.diff(signals.time))) / _SUBSTEPS
    damping = 2 * damping_ratio * np.sqrt(k * inertia.mean(axis=0))
    implicit = inertia + step * damping + step * step * k
    twist = load[0] / k + np.sign(load[0]) * half
    rate = np.zeros_like(k)
    rates = np.empty((len(load) + 1, len(k)))
    rates[0] = 0
    has_gap = bool(np.any(half > 0))
    impulse = step * load
    for sample in range(len(load)):
        m, h, pushed = inertia[sample], implicit[sample], impulse[sample]
        for _ in range(_SUBSTEPS):
            if has_gap:
                beyond = twist - np.clip(twist, -half, half)
                touching = beyond != 0
                rate = (m * rate + pushed - step * k * beyond) / np.where(touching, h, m)
            else:
                rate = (m * rate + pushed - step * k * twist) / h
            twist = twist + step * rate
        rates[sample + 1] = rate
    return np.diff(rates, axis=0) / (step * _SUBSTEPS)
