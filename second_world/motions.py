"""Motions as set-points over time: a multisine, stop-and-go, and slow sweeps with standstills and reversals."""

from __future__ import annotations

import numpy as np

RATE = 1000.0  # Hz, of the servo and of the simulation

#: name -> set-points (S, n), and the starts of its cycles [s]
Motions = dict[str, tuple[np.ndarray, tuple[float, ...]]]


def draw_motions(seed: int, reach: np.ndarray, speed: np.ndarray, cycle: float) -> Motions:
    """All three for joints that go `reach` (n,) [rad] to both sides of zero at most, `cycle` [s] each way round."""
    rng = np.random.default_rng([seed, 9])
    return {
        "multisine": _multisine(rng, reach, speed, cycle),
        "stops": _stops(rng, reach, speed, cycle),
        "sweeps": _sweeps(rng, reach, speed, cycle),
    }


def _ease(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def _multisine(
    rng: np.random.Generator, reach: np.ndarray, speed: np.ndarray, cycle: float
) -> tuple[np.ndarray, tuple[float, ...]]:
    lead = 0.15 * cycle
    t = np.arange(round((2 * cycle + 2 * lead) * RATE)) / RATE
    harmonics = np.arange(1, 8)
    phase = rng.uniform(0, 2 * np.pi, (7, len(reach)))
    weight = rng.uniform(0.3, 1.0, (7, len(reach))) / harmonics[:, None]
    angle = 2 * np.pi / cycle * harmonics[:, None] * (t - lead)
    q = np.einsum("hj,hsj->sj", weight, np.sin(angle[:, :, None] + phase[:, None, :]))
    fastest = np.abs(np.gradient(q, 1 / RATE, axis=0)).max(axis=0)
    q *= np.minimum(0.8 * reach / np.abs(q).max(axis=0), 0.7 * speed / fastest)
    inside = _ease(t / lead) * _ease((t[-1] - t) / lead)
    return q * inside[:, None], (lead, lead + cycle)


def _stops(
    rng: np.random.Generator, reach: np.ndarray, speed: np.ndarray, cycle: float
) -> tuple[np.ndarray, tuple[float, ...]]:
    points = [rng.uniform(-0.7, 0.7, len(reach)) * reach]
    parts, left = [], cycle
    while left > 0:
        goal = rng.uniform(-0.7, 0.7, len(reach)) * reach if left > 2.5 else points[0]
        parts.append(_trapezoid(points[-1], goal, 0.5 * speed, rng.uniform(0.15, 0.35)))
        parts.append(np.repeat(goal[None], round(rng.uniform(0.3, 0.8) * RATE), axis=0))
        left -= (len(parts[-2]) + len(parts[-1])) / RATE
        points.append(goal)
        if goal is points[0]:
            break
    else:
        parts.append(_trapezoid(points[-1], points[0], 0.5 * speed, 0.25))
    once = np.concatenate(parts)
    return np.concatenate([once, once]), (0.0, len(once) / RATE)


def _trapezoid(start: np.ndarray, goal: np.ndarray, speed: np.ndarray, ramp: float) -> np.ndarray:
    """Trapezoidal speed, all joints at once, corners rounded over 40 ms; `ramp` is the share of the way up."""
    duration = max(0.4, float(np.max(np.abs(goal - start) / speed)) / (1 - ramp))
    x = np.arange(round(duration * RATE)) / RATE / duration
    rate = np.clip(np.minimum(x, 1 - x) / ramp, 0, 1)
    rate = np.convolve(rate, np.ones(40) / 40, mode="same")
    way = np.cumsum(rate)
    return start + (way / way[-1])[:, None] * (goal - start)


def _sweeps(
    rng: np.random.Generator, reach: np.ndarray, speed: np.ndarray, cycle: float
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Every joint by itself: creeps, stands, turns back; the second half goes back over the first."""
    samples = round(cycle * RATE)
    rate = np.zeros((samples, len(reach)))
    for joint in range(len(reach)):
        at, sign = 0, rng.choice([-1.0, 1.0])
        while at < samples:
            length = round(rng.uniform(0.1, 0.3) * samples)
            creep = 0.0 if rng.random() < 0.2 else speed[joint] * np.exp(rng.uniform(np.log(0.01), np.log(0.08)))
            rate[at : at + length, joint] = sign * creep
            sign, at = -sign if rng.random() < 0.7 else sign, at + length
    width = 120  # samples: accelerations stay those of a slow motion
    rate[:width] = rate[-width:] = 0.0
    kernel = np.hanning(width)
    rate = np.stack([np.convolve(column, kernel / kernel.sum(), mode="same") for column in rate.T], axis=1)
    way = np.cumsum(rate, axis=0) / RATE
    once = np.concatenate([way, way[::-1]]) + rng.uniform(-0.5, 0.5, len(reach)) * reach
    return np.clip(once, -reach, reach), ()
