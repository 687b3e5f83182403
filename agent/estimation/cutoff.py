"""The cut-off that the positions of a log allow.

Every sample of a position has noise of its own, of variance σ² (the steps of an encoder, most of the time): white up to
half of the sampling rate f_s. Differentiated twice and filtered at f_c it is an acceleration of variance
σ_a² = 2 (2π)⁴ σ² f_c⁵ / (5 f_s), and with the inertia of the arm a torque that nobody applied. The cut-off is lowered
until that is a small part of the measured torque.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.estimation.clock import Clock
from agent.recording.log import Log

if TYPE_CHECKING:
    from agent.robot.dynamics import Dynamics

_SHARE = 0.05  # of a joint's torque that noise of the positions may have
_LOWEST = 10.0  # Hz; friction at reversals needs as much
_SAMPLES = 30_000  # looked at
_PIECE = 1024  # samples, of the spectrum
_TOP = 0.4  # of the sampling rate: no motion is beyond


def quiet_cutoff(dynamics: Dynamics, log: Log, cutoff: float) -> tuple[float, int | None]:
    """A cut-off [Hz] up to `cutoff` at which noise of the positions hardly matters, and the joint that asks for it."""
    start, stop = max(log.bridged(1 / cutoff), key=lambda segment: segment[1] - segment[0])
    clock = Clock.of(log, start, stop)
    position, torque, _ = clock.signals(slice(0, min(clock.size, _SAMPLES)))
    if torque is None or len(position) <= _PIECE:
        return cutoff, None
    variance = 2 * (2 * np.pi) ** 4 * _white_noise(position) * cutoff**5 / (5 * clock.rate)
    noise = np.sqrt(np.mean([_inertia(dynamics, q) ** 2 for q in position[:: len(position) // 20]], axis=0) @ variance)
    allowed = _SHARE * np.sqrt(np.mean(torque**2, axis=0))
    with np.errstate(divide="ignore"):
        factor = np.where(allowed > 0, allowed / noise, np.inf) ** 0.4
    worst = int(np.argmin(factor))
    if factor[worst] >= 1 or cutoff <= _LOWEST:
        return cutoff, None
    return max(float(f"{cutoff * factor[worst]:.2g}"), _LOWEST), worst


def _white_noise(position: np.ndarray) -> np.ndarray:
    """(n,) variance of what is white in positions (S, n), by their spectrum where no motion is."""
    step = np.diff(position, axis=0)  # so that what a motion leaves of its ends in the spectrum is little
    window = np.hanning(_PIECE)[:, None]
    pieces = [step[first : first + _PIECE] for first in range(0, len(step) - _PIECE + 1, _PIECE // 2)]
    power = np.mean([np.abs(np.fft.rfft(piece * window, axis=0)) ** 2 for piece in pieces], axis=0)
    frequency = np.fft.rfftfreq(_PIECE)
    top = frequency > _TOP
    response = 4 * np.sin(np.pi * frequency[top]) ** 2 * np.sum(window**2)
    return np.median(power[top] / response[:, None], axis=0)


def _inertia(dynamics: Dynamics, q: np.ndarray) -> np.ndarray:
    """(n, n) at the joints, rotors among it as far as they are known."""
    robot = dynamics.robot
    rotors = np.array([joint.rotor_inertia or 0.0 for joint in robot.joints]) * robot.gear_ratios**2
    return dynamics.mass_matrix(q) + robot.coupling.T @ (rotors[:, None] * robot.coupling)
