"""Where in its motion a joint is: one meaning of standstill for all that is judged, and one map for all pages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: Regimes of speed, load and position; a sample is in several.
REGIMES = (
    "standstill", "reversal", "low_speed", "high_speed", "high_load", "acceleration",
    "position_low", "position_middle", "position_high",
)  # fmt: skip
_STANDSTILL = 0.004  # of the highest speed seen on the joint
#: Of the arm's speed, over what the joints are able to: a joint that is never faster is judged by this one.
_OF_ARM = 0.2
#: Seconds in which a joint at its highest speed moves as far as one that rests may.
RESTS = 1e-4
_RESTING = 1e-6  # of its highest speed at all: round-off in a channel that is constant
_NEAR_REVERSAL = 0.15  # s
_LOW, _HIGH = 0.1, 0.6  # of the highest speed seen
_HIGH_QUANTILE = 0.75  # quantile of load and acceleration, from which on they are high


def standstill_speed(speeds: Sequence[np.ndarray], max_velocity: np.ndarray, share: float = _STANDSTILL) -> np.ndarray:
    """Speed (n,) [rad/s] up to which a joint counts as stationary, so that its friction is anything within stiction.

    Args:
        speeds: (S, n) of each motion.
        max_velocity: (n,) of the joints.
        share: of the highest speed.
    """
    fastest = np.max([np.abs(speed).max(axis=0) for speed in speeds], axis=0)
    usual = np.maximum(fastest, _OF_ARM * np.max(fastest / max_velocity) * max_velocity)
    return np.maximum(share * usual, _RESTING * max_velocity)


def regime_masks(
    q: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, load: np.ndarray, slowest: float, rate: float
) -> dict[str, np.ndarray]:
    """(S,) bool of each of `REGIMES`, from (S,) signals of one joint; up to `slowest` it stands; `rate` in Hz.

    Args:
        q, speed, acceleration, load: (S,) signals of one joint [rad, rad/s, rad/s², N·m].
        slowest: speed up to which the joint counts as stationary [rad/s].
        rate: of the samples [Hz].
    """
    magnitude, load, acceleration = np.abs(speed), np.abs(load), np.abs(acceleration)
    fastest = max(float(magnitude.max()), 1e-9)
    standing = magnitude <= slowest
    around_reversal = np.zeros(len(speed), dtype=bool)
    reach = int(_NEAR_REVERSAL * rate)
    for reversal in np.flatnonzero(np.diff(np.sign(speed)) != 0):
        around_reversal[max(0, reversal - reach) : reversal + reach + 1] = True
    low, high = float(q.min()), float(q.max())
    third = (high - low) / 3
    regions = (
        standing,
        around_reversal & ~standing,
        (magnitude < _LOW * fastest) & ~standing,
        magnitude > _HIGH * fastest,
        load > np.quantile(load, _HIGH_QUANTILE),
        acceleration > np.quantile(acceleration, _HIGH_QUANTILE),
        q < low + third,
        (q >= low + third) & (q <= high - third),
        q > high - third,
    )
    return dict(zip(REGIMES, regions, strict=True))
