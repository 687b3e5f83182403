"""Noise model: differences between model and machine without any fault.

"Nothing" is never literally true of an arm. A model errs a little everywhere, an arm changes from day to day, and
every arm has a little of some effects. Hypotheses are compared on top of these columns, so an effect counts only for
what they cannot take up (Kennedy and O'Hagan, J. R. Statist. Soc. B 63, 2001). How much of which effect an arm has
while it is healthy is learned from its own baseline (`healthy`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.diagnosis.rows.candidate import Candidate

#: Effects that the arm has already, and their torque over nominal.
Healthy = Sequence[tuple[Candidate, float]]
_DRIFT = 3.0  # s between the nodes of a drift in time
_TURNING = 0.03  # of the highest speed, over which friction turns around


def smooth_columns(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, time: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Return smooth functions of one joint's position, speed, acceleration, log and time.

    Parameters
    ----------
    q, qd, qdd : ndarray, shape (S,)
        Motion of the joint [rad, rad/s, rad/s²].
    time : ndarray, shape (S,)
        Seconds since the start of the row's log.
    log : ndarray of int, shape (S,)
        Number of the row's log.

    Returns
    -------
    ndarray, shape (S, m)
        Columns of order one.
    """
    top = max(float(np.abs(qd).max()), 1e-9)
    sign = np.tanh(qd / (_TURNING * top))[:, None]
    speed = np.abs(qd)
    logs = (log[:, None] == np.unique(log)).astype(float)
    parts = [_hats(q, 8), sign * _hats(speed, 5, 0.0, top), _hats(speed, 4, 0.0, top), sign * _hats(q, 5)]
    parts += [_hats(qdd / max(float(np.abs(qdd).max()), 1e-9), 5), logs, sign * logs]
    for here in logs.T.astype(bool):
        low, high = float(time[here].min()), float(time[here].max())
        parts.append(_hats(time, max(3, int((high - low) / _DRIFT) + 1), low, high) * here[:, None])
    columns = np.hstack(parts)
    return np.asarray(columns[:, np.abs(columns).max(axis=0) > 1e-6])


def usual_effects(candidates: Sequence[Candidate], sigma: np.ndarray) -> dict[int, list[np.ndarray]]:
    """Return per joint the columns (S, m), over σ (S, n), of effects that every arm has a little of.

    Each is as large as the smallest σ of its joint.
    """
    first: dict[tuple[str, tuple[int, ...]], Candidate] = {}
    for candidate in candidates:
        if candidate.effect.usual:
            first.setdefault(candidate.place, candidate)
    found: dict[int, list[np.ndarray]] = {}
    for candidate in first.values():
        for joint, block in candidate.blocks.items():
            size = np.sqrt(np.mean((block * sigma[:, [joint]]) ** 2, axis=0))
            some = size > 1e-9 * sigma[:, joint].min()
            if some.any():
                found.setdefault(joint, []).append(block[:, some] * (sigma[:, joint].min() / size[some]))
    return found


def _hats(x: np.ndarray, count: int, low: float | None = None, high: float | None = None) -> np.ndarray:
    """(S, count) piecewise linear functions between equal nodes."""
    low = float(np.min(x)) if low is None else low
    high = float(np.max(x)) if high is None else high
    nodes = np.linspace(low, max(high, low + 1e-9), count)
    return np.asarray(np.maximum(0, 1 - np.abs(x[:, None] - nodes) / (nodes[1] - nodes[0])))
