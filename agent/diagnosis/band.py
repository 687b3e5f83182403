"""Whether an effect gains where the torque is predicted, or only takes noise out of the prediction.

Positions are rounded, and their second derivative makes torque of it that nobody measured. A form that passes low
frequencies alone, as a gear that gives way does, takes that out again: it gains, and follows nothing. What a true
effect gains is torque that was measured, so where it gains, measured torque goes with the prediction that has it:
their coherence γ² = |S_mp|² / (S_mm S_pp) is high (Bendat, Piersol, Random Data, 2010, ch. 6).
"""

from __future__ import annotations

import numpy as np

from agent.diagnosis.candidate import HeldOutScore
from agent.diagnosis.fit import Fit

_WINDOW = 1.0  # s
_COHERENT = 0.5  # γ² from which on measured and predicted torque go together
_SMOOTHED = 3  # lines of the spectrum


def gain_in_band(fit: Fit, score: HeldOutScore) -> float:
    """Share of an effect's gain, on the joint where it gains most, at frequencies where torque is then predicted."""
    joints = list(score.candidate.blocks)
    before = np.concatenate(fit.residuals)
    after = np.concatenate(fit.with_chosen((*fit.chosen, score.candidate)).residuals)
    taken = np.sum((before**2 - after**2)[:, joints] / fit.sigma[:, joints] ** 2, axis=0)
    joint = joints[int(np.argmax(taken))]
    left = fit.rows[joint][:, -1] * fit.sigma[:, joint]
    torque = np.concatenate([s.low_pass(s.predicted)[:, joint] for s in fit.signals]) + left
    sigma = fit.sigma[:, joint]  # a gain counts as in the fit: torque at standstill is open, and hides what moves
    parts = [torque, torque - after[:, joint], before[:, joint] / sigma, after[:, joint] / sigma]
    signals = fit.signals[0]
    count = int(_WINDOW / float(np.median(np.diff(signals.time))))
    lines = [_lines(np.split(part, fit.cuts), count) for part in parts]
    if not len(lines[0]):
        return 1.0
    measured, predicted, worse, better = lines
    cross = _smooth(np.sum(measured * predicted.conj(), axis=0))
    power = (_smooth(np.sum(np.abs(side) ** 2, axis=0)) for side in (measured, predicted))
    coherence = np.abs(cross) ** 2 / np.maximum(np.prod(np.array(list(power)), axis=0), 1e-300)
    gain = np.sum(np.abs(worse) ** 2 - np.abs(better) ** 2, axis=0)
    whole = float(np.sum(gain))
    return float(np.sum(gain[coherence > _COHERENT])) / whole if whole > 0 else 0.0


def _lines(motions: list[np.ndarray], count: int) -> np.ndarray:
    """(windows, lines) spectra of windows of `count` samples, half over each other, without their means."""
    window = np.hanning(count)
    starts = [(part, at) for part in motions for at in range(0, len(part) - count + 1, count // 2)]
    cut = [part[at : at + count] for part, at in starts]
    return np.array([np.fft.rfft((piece - piece.mean()) * window) for piece in cut])


def _smooth(spectrum: np.ndarray) -> np.ndarray:
    return np.convolve(spectrum, np.ones(_SMOOTHED) / _SMOOTHED, "same")
