"""Motion along one stretch of a path: up a ramp, along at constant speed, down a ramp.

A ramp from v0 to v1 has acceleration a and jerk j (Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines
and Robots, 2008, ch. 3): acceleration rises for t_j = a/j, stays, falls for t_j; t_j = sqrt(|v1 - v0|/j) where a is not
reached. Without a jerk limit (j infinite) it is the trapezoidal law. Its mean speed is (v0 + v1)/2 either way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_HALVINGS = 60


@dataclass(frozen=True)
class Ramp:
    """From speed `start` to `end` [m/s] at no more than `acceleration` and `jerk`."""

    start: float
    end: float
    acceleration: float
    jerk: float

    @property
    def rise(self) -> float:
        """Seconds in which the acceleration rises, and in which it falls."""
        return min(self.acceleration / self.jerk, float(np.sqrt(abs(self.end - self.start) / self.jerk)))

    @property
    def duration(self) -> float:
        """Seconds."""
        change, rise = abs(self.end - self.start), self.rise
        reached = rise < self.acceleration / self.jerk
        return 2.0 * rise if reached else change / self.acceleration + rise

    @property
    def length(self) -> float:
        """Metres."""
        return 0.5 * (self.start + self.end) * self.duration

    def at(self, t: np.ndarray) -> np.ndarray:
        """(3, T) way, speed and acceleration at t (T,) from its beginning to its end."""
        rise, duration = self.rise, self.duration
        sign = float(np.sign(self.end - self.start))
        peak = 0.0 if duration <= rise else abs(self.end - self.start) / (duration - rise)
        up, flat = np.clip(t, 0.0, rise), np.clip(t - rise, 0.0, duration - 2.0 * rise)
        down = np.clip(t - (duration - rise), 0.0, rise)
        jerk = peak / rise if rise > 0 else 0.0
        acceleration = np.where(t < rise, jerk * up, peak - jerk * down)
        gained = 0.5 * jerk * up**2 + peak * flat + peak * down - 0.5 * jerk * down**2
        after_rise = 0.5 * peak * rise
        distance = jerk * up**3 / 6 + after_rise * flat + 0.5 * peak * flat**2
        distance += (after_rise + peak * (duration - 2.0 * rise)) * down + 0.5 * peak * down**2 - jerk * down**3 / 6
        return np.stack((self.start * t + sign * distance, self.start + sign * gained, sign * acceleration))


@dataclass(frozen=True)
class RampedMove:
    """`length` [m] from speed `start` to `end` with no more than `speed`; up and down with a jerk limit in common."""

    length: float
    start: float
    end: float
    speed: float
    acceleration: float
    deceleration: float
    jerk: float

    def parts(self) -> tuple[Ramp, float, Ramp]:
        """The ramp up, the seconds at constant speed, the ramp down."""

        def ramps(peak: float) -> tuple[Ramp, Ramp]:
            up = Ramp(self.start, peak, self.acceleration, self.jerk)
            return up, Ramp(peak, self.end, self.deceleration, self.jerk)

        low, high = max(self.start, self.end), max(self.speed, self.start, self.end)
        if sum(ramp.length for ramp in ramps(high)) > self.length:
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                fits = sum(ramp.length for ramp in ramps(middle)) <= self.length
                low, high = (middle, high) if fits else (low, middle)
            high = low
        up, down = ramps(high)
        cruise = self.length - up.length - down.length
        return up, max(cruise, 0.0) / high, down

    @property
    def duration(self) -> float:
        """Seconds."""
        up, flat, down = self.parts()
        return up.duration + flat + down.duration

    def at(self, t: np.ndarray) -> np.ndarray:
        """(3, T) way, speed and acceleration at t (T,) from its beginning to its end."""
        up, flat, down = self.parts()
        out = np.empty((3, len(t)))
        first, last = t < up.duration, t >= up.duration + flat
        between = ~first & ~last
        out[:, first] = up.at(t[first])
        out[0, between] = up.length + up.end * (t[between] - up.duration)
        out[1, between], out[2, between] = up.end, 0.0
        out[:, last] = down.at(np.minimum(t[last] - up.duration - flat, down.duration))
        out[0, last] += up.length + up.end * flat
        return out


def reachable(start: float, length: float, acceleration: float, jerk: float, speed: float) -> float:
    """The highest end speed, up to `speed`, of a ramp from `start` no longer than `length` [m]."""
    if Ramp(start, speed, acceleration, jerk).length <= length or speed <= start:
        return speed
    low, high = start, speed
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if Ramp(start, middle, acceleration, jerk).length <= length else (low, middle)
    return low
