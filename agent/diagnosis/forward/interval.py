"""How large an error forward may be on another motion: its interval, from how motions differ.

Windows of one motion are alike, so motions count (or the parts of one that are held out from each other), not windows:
the logarithm of a motion's mean square error has a variance v over motions, and that of another motion lies about the
mean of G of them with the variance v (1 + 1 / G). Motions are few; joints and horizons are many, so v is the mean over
these, or the joint's own, whichever is larger.
"""

from __future__ import annotations

import numpy as np

from agent.diagnosis.hypotheses.law import LAW


def expected_range(squares: np.ndarray, group: np.ndarray, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Ends (…) of the 90 % interval of the root mean square error on another motion like these.

    Args:
        squares: (W, …) squared errors, NaN where a window is too short.
        group: (W,) the motion, or held-out part of one, that a window is of.
        most: what no error counts beyond; the upper end where one motion is all there is.
    """
    there = np.isfinite(squares)
    middle = np.sqrt(np.nanmean(squares, axis=0))
    parts = [group == number for number in np.unique(group)]
    count = np.array([there[part].sum(axis=0) for part in parts])
    total = np.array([np.nansum(squares[part], axis=0) for part in parts])
    has_windows = count > 0
    motions = has_windows.sum(axis=0)
    logs = np.where(has_windows, np.log(np.maximum(total, 1e-300) / np.maximum(count, 1)), 0.0)
    centre = logs.sum(axis=0) / motions
    spread = np.sum(np.where(has_windows, (logs - centre) ** 2, 0.0), axis=0)
    several = motions > 1
    if not several.any():
        return np.zeros_like(middle), np.full_like(middle, most)
    variance = spread / np.maximum(motions - 1, 1)
    usual = spread[several].sum() / (motions[several] - 1).sum()
    factor = np.exp(0.5 * LAW.within * np.sqrt(np.maximum(variance, usual) * (1 + 1 / motions)))
    return middle / factor, np.clip(middle * factor, middle, np.maximum(most, middle))
