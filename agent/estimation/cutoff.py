"""The band in which a model predicts torque: the cut-off chosen from spectra after a first fit.

Positions differentiated twice carry noise that grows with frequency, and from some frequency on a prediction made of
them is further from the measured torque than no prediction at all. With R(f) the spectrum of the residual of a first
fit and P(f) that of the measured torque, a prediction cut off at f_c leaves

    J(f_c) = ∫ R df up to f_c + ∫ P df beyond,

whose minimum is the best cut-off for a joint (the ideal low-pass filter of Wiener's problem). The highest cut-off is
taken that is not clearly worse than the best one on the mean of the joints: a higher one loses nothing there, and
friction at reversals needs it. No inertia of the description enters. The first fit is made at the lowest cut-off: at a
higher one the noise would pull its inertias towards zero and so hide itself (errors in variables).
"""

from __future__ import annotations

import numpy as np

from agent.estimation.problem import Problem

_NOT_WORSE = 1.25  # J over its least value, mean of the joints
LOWEST = 10.0  #: Hz; friction at reversals needs as much
_PIECE = 2.0  # s, of a spectrum


def predictive_cutoff(problem: Problem, parameters: np.ndarray) -> tuple[float, int] | None:
    """A lower cut-off [Hz] that predicts better, and the joint that asks most for it; None where this one will do.

    `parameters` (p,) are those of a first fit with the same terms.
    """
    motion = problem.observation.segments[0].motion
    residuals = problem.residuals(parameters)
    torques = [segment.torque for segment in problem.observation.segments]
    length = min(max(len(torque) for torque in torques), int(_PIECE * motion.rate / motion.step))
    frequency = np.fft.rfftfreq(length, motion.step / motion.rate)
    band = frequency <= motion.cutoff
    mean = np.concatenate(torques).mean(axis=0)
    left = _power(residuals, length)[band]
    measured = _power([torque - mean for torque in torques], length)[band]
    beyond = np.cumsum(measured[::-1], axis=0)[::-1] - measured
    cost = np.cumsum(left, axis=0) + beyond
    worse = cost / np.maximum(cost.min(axis=0), 1e-300)
    allowed = np.flatnonzero((worse.mean(axis=1) <= _NOT_WORSE * worse.mean(axis=1).min()) | (frequency[band] < LOWEST))
    cutoff = max(float(f"{frequency[allowed[-1]]:.2g}"), LOWEST)
    if cutoff > 0.95 * motion.cutoff:
        return None
    return cutoff, int(np.argmax(worse[-1]))


def _power(signals: list[np.ndarray], length: int) -> np.ndarray:
    """(F, n) power over frequency of signals (S', n), Welch's mean over pieces; shorter segments are padded."""
    total: np.ndarray | float = 0.0
    for signal in signals:
        size = min(len(signal), length)
        window = np.hanning(size)[:, None]
        for first in range(0, len(signal) - size + 1, max(size // 2, 1)):
            total = total + np.abs(np.fft.rfft(signal[first : first + size] * window, length, axis=0)) ** 2
    return np.asarray(total)
