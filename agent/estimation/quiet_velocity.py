"""Velocity as quiet as the positions allow: a wide band where the joint turns fast, a narrow one where it creeps.

Friction depends on the sign of a velocity that may be far below the noise of a differentiated position: positions
rounded to 1e-4 rad make a resting joint reverse hundreds of times a second. Here the velocity is taken from a family of
bands, each half as wide as the one before, and at every sample from the narrowest one that no wider one contradicts by
more than their noise (Lepski, Theory Probab. Appl. 35, 1991; intersection of confidence intervals: Goldenshluger and
Nemirovski, Math. Methods Statist. 6, 1997). Without noise that is the widest, so exact positions lose nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_NARROWEST = 1.5  # Hz
_CONFIDENCE = 3.0  # standard deviations by which two bands may differ
_AUDIBLE = 6e-4  # of the highest speed, in a band of 100 Hz: less noise is left alone
_PIECE = 1024  # samples, of the spectrum
_TOP = 0.4  # of the sampling rate: no motion is beyond


def quiet_velocity(
    position: np.ndarray,
    rate: float,
    velocity: np.ndarray,
    stop_edge: float,
    narrower: Callable[[float, np.ndarray], np.ndarray],
) -> np.ndarray:
    """(S, n) velocity; `velocity` is that of the widest band, which ends at `stop_edge` [Hz].

    `position` (P, n) at `rate` [Hz] tells the noise; narrower(factor, joints) gives the velocity (S, k) of some joints
    in a band `factor` times as wide.
    """
    if len(position) < 2 * _PIECE:
        return velocity
    # noise of density 2 σ² / f_s, differentiated, in a band of 100 Hz
    noise = np.sqrt(8 * np.pi**2 / 3 * white_noise(position) * 100.0**3 / rate)
    deviation = noise * (stop_edge * 5 / 6 / 100.0) ** 1.5  # up to the middle of the band's edge
    fastest = np.abs(velocity).max(axis=0)
    noisy = np.flatnonzero((noise > _AUDIBLE * fastest) & (fastest > 0))
    if len(noisy) == 0:
        return velocity
    chosen = velocity.copy()
    bands = [(velocity[:, noisy], deviation[noisy])]
    agrees = np.ones((len(velocity), len(noisy)), dtype=bool)
    factor = 0.5
    while factor * stop_edge >= _NARROWEST:
        band, own = narrower(factor, noisy), deviation[noisy] * factor**1.5
        for wider, theirs in bands:
            agrees &= np.abs(band - wider) <= _CONFIDENCE * (own + theirs)
        if not agrees.any():
            break
        chosen[:, noisy] = np.where(agrees, band, chosen[:, noisy])
        bands.append((band, own))
        factor /= 2
    return chosen


def white_noise(position: np.ndarray) -> np.ndarray:
    """(n,) variance of what is white in positions (S, n), by their spectrum where no motion is."""
    step = np.diff(position, axis=0)  # so that what a motion leaves of its ends in the spectrum is little
    window = np.hanning(_PIECE)[:, None]
    pieces = [step[first : first + _PIECE] for first in range(0, len(step) - _PIECE + 1, _PIECE // 2)]
    power = np.mean([np.abs(np.fft.rfft(piece * window, axis=0)) ** 2 for piece in pieces], axis=0)
    frequency = np.fft.rfftfreq(_PIECE)
    top = frequency > _TOP
    response = 4 * np.sin(np.pi * frequency[top]) ** 2 * np.sum(window**2)
    return np.median(power[top] / response[:, None], axis=0)
