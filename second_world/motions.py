"""Motions as set-points over time, in three roles; a world draws which kind plays each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

RATE = 1000.0  # Hz, of the set-points

#: role -> kinds
KINDS = {"moves": ("trapezoids", "quintics", "s_curves"), "slow": ("creeps", "ramps"), "wide": ("fourier", "chirps")}

#: A further motion of a baseline, which a model is fitted to: more of the workspace.
BASELINE = {"wide_2": "fourier"}

#: name -> set-points (S, n), and the starts of its cycles [s]
Motions = dict[str, tuple[np.ndarray, tuple[float, ...]]]


def draw_motions(kinds: Mapping[str, str], seed: int, reach: np.ndarray, speed: np.ndarray, cycle: float) -> Motions:
    """One of each role of `kinds`, `cycle` [s] each way round, for joints that go `reach` (n,) [rad] to both sides."""
    rng = np.random.default_rng([seed, 9])
    make = {"moves": _stops, "slow": _slow, "wide": _wide}
    return {role: make[role.split("_")[0]](kind, rng, reach, speed, cycle) for role, kind in kinds.items()}


def _ease(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def _wide(
    kind: str, rng: np.random.Generator, reach: np.ndarray, speed: np.ndarray, cycle: float
) -> tuple[np.ndarray, tuple[float, ...]]:
    """A Fourier series, or a sum of two swings whose frequency rises and falls; begins and ends at zero."""
    lead, n = 0.15 * cycle, len(reach)
    t = np.arange(round((2 * cycle + 2 * lead) * RATE)) / RATE
    phase_angle = 2 * np.pi * (t - lead) / cycle
    if kind == "fourier":
        harmonics = np.arange(1, 8)
        phase = rng.uniform(0, 2 * np.pi, (7, n))
        weight = rng.uniform(0.3, 1.0, (7, n)) / harmonics[:, None]
        q = np.einsum("hj,hsj->sj", weight, np.sin(harmonics[:, None, None] * phase_angle[:, None] + phase[:, None, :]))
    else:
        base, swing = rng.integers(1, 3, n), rng.uniform(1.0, 2.5, n)
        phase = base * phase_angle[:, None] + swing * np.sin(phase_angle[:, None] + rng.uniform(0, 6, n))
        q = np.sin(phase) + rng.uniform(0.2, 0.4, n) * np.sin(2 * phase + rng.uniform(0, 6, n))
    fastest = np.abs(np.gradient(q, 1 / RATE, axis=0)).max(axis=0)
    q *= np.minimum(0.8 * reach / np.abs(q).max(axis=0), 0.7 * speed / fastest)
    inside = _ease(t / lead) * _ease((t[-1] - t) / lead)
    return q * inside[:, None], (lead, lead + cycle)


def _stops(
    kind: str, rng: np.random.Generator, reach: np.ndarray, speed: np.ndarray, cycle: float
) -> tuple[np.ndarray, tuple[float, ...]]:
    """From point to point with rests, twice."""
    first = rng.uniform(-0.7, 0.7, len(reach)) * reach
    parts: list[np.ndarray] = []
    at = first
    while not parts or sum(map(len, parts)) < (cycle - 2.5) * RATE:
        goal = rng.uniform(-0.7, 0.7, len(reach)) * reach
        parts += [_between(kind, at, goal, 0.6 * speed, rng), np.tile(goal, (round(rng.uniform(0.2, 0.8) * RATE), 1))]
        at = goal
    parts += [_between(kind, at, first, 0.6 * speed, rng), np.tile(first, (round(0.3 * RATE), 1))]
    once = np.concatenate(parts)
    return np.concatenate([once, once]), (0.0, len(once) / RATE)


def _between(kind: str, start: np.ndarray, goal: np.ndarray, speed: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """All joints at once: trapezoids of speed with corners of 40 ms, quintics, or trapezoids eased at either end."""
    ramp = rng.uniform(0.15, 0.35)
    duration = max(0.4, float(np.max(np.abs(goal - start) / speed)) / (1 - ramp))
    x = np.arange(round(duration * RATE)) / RATE / duration
    if kind == "quintics":
        travelled = _ease(x)
    else:
        rate = np.clip(np.minimum(x, 1 - x) / ramp, 0, 1)
        rate = _ease(rate) if kind == "s_curves" else np.convolve(rate, np.ones(40) / 40, mode="same")
        travelled = np.cumsum(rate)
    return start + (travelled / travelled[-1])[:, None] * (goal - start)


def _slow(
    kind: str, rng: np.random.Generator, reach: np.ndarray, speed: np.ndarray, cycle: float
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Every joint by itself creeps, stands and turns back, or runs up and down at speeds that rise; then backwards."""
    samples, n = round(cycle * RATE), len(reach)
    rate = np.zeros((samples, n))
    for joint in range(n):
        at, sign, step = 0, rng.choice([-1.0, 1.0]), 0
        while at < samples:
            length = round(rng.uniform(0.08, 0.25) * samples)
            creep = 0.0 if rng.random() < 0.2 else speed[joint] * np.exp(rng.uniform(np.log(0.01), np.log(0.08)))
            if kind == "ramps":
                length, creep = round(samples / 6), speed[joint] * 0.012 * 1.5**step
            rate[at : at + length, joint] = sign * creep
            turns = kind == "ramps" or rng.random() < 0.7
            sign, at, step = -sign if turns else sign, at + length, step + 1
    width = 120  # samples: accelerations stay those of a slow motion
    rate[:width] = rate[-width:] = 0.0
    kernel = np.hanning(width)
    rate = np.stack([np.convolve(column, kernel / kernel.sum(), mode="same") for column in rate.T], axis=1)
    travelled = np.cumsum(rate, axis=0) / RATE
    travelled *= np.minimum(1.0, 0.5 * reach / np.abs(travelled).max(axis=0))
    return np.concatenate([travelled, travelled[::-1]]) + rng.uniform(-0.5, 0.5, n) * reach, ()
