"""Where the arm has to be at a stamp of the controller's clock, how it is braked, and how samples are numbered."""

from __future__ import annotations

import numpy as np

from drivers.joint_trajectory import JointSpline
from drivers.wire.ros2 import JointSample

#: Shortest and longest time [s] in which a brake brings the arm to rest.
BRAKE, LONGEST_BRAKE = 0.3, 1.0
#: Time [s] after the end of a brake at which whatever runs is cancelled, whether the arm rests or not.
CANCEL_AFTER = 0.3
#: Share of a number's error by which the origin of numbers follows the stamps: two clocks drift, jitter does not.
_REFIT = 0.01
#: What a joint moves at most between two of its samples [rad/s, m/s], and what rounding and late stamps add [rad, m].
_FASTEST, _ROUNDING = 10.0, 0.03
_PAUSE = 1.0  # s, after which an arm may be anywhere
#: Samples between those of one source that show a second one; two of three of its own excuse one, as of a clock that is
#: a third too slow.
_CROWD = 20


class Course:
    """Points from rest at `start` (n,) on, as a controller joins them from the `stamp` [s] of its clock on."""

    def __init__(self, stamp: float, start: np.ndarray, points: JointSpline) -> None:
        self.stamp, self._spline = stamp, points.after_rest_at(start)
        self.end, self.last = stamp + points.duration, points.q[-1]

    def position(self, stamp: float) -> np.ndarray:
        """Position (n,) at a stamp [s]."""
        return self._spline.position(stamp - self.stamp)

    def at(self, stamp: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and velocity (n,) at a stamp [s]; stationary before and after."""
        return self._spline.at(stamp - self.stamp)[:2]


def brake_point(position: np.ndarray, velocity: np.ndarray, strength: np.ndarray) -> tuple[float, np.ndarray]:
    """Time [s] and position (n,) of the one point that brakes an arm from this state at a constant deceleration.

    Args:
        strength: (n,) deceleration that the joints are known to bear [rad/s²].
    """
    needed = float(np.max(np.abs(velocity) / np.maximum(strength, 1e-3), initial=0.0))
    seconds = min(max(BRAKE, needed), LONGEST_BRAKE)
    return seconds, position + velocity * seconds / 2


class Believed:
    """The newest sample that one arm can have made, and its velocity (n,).

    A brake that is computed from another arm's sample, or from no numbers, would throw the arm there.
    """

    def __init__(self) -> None:
        self.sample: JointSample | None = None
        self.velocity = np.zeros(0)
        self.at = -np.inf  # when it came [s, monotonic]
        self._speed = Speed()

    def take(self, sample: JointSample, now: float) -> float:
        """How far [rad, m] a joint jumped to this sample that came at `now` [s]; 0 where it is believed, as is whatever
        comes after a pause."""
        before = self.sample
        if before is not None and now - self.at <= _PAUSE:
            passed, jump = sample.stamp - before.stamp, np.abs(sample.position - before.position)
            if not np.all(jump <= _ROUNDING + _FASTEST * max(0.0, min(passed, now - self.at))):
                return float(np.max(jump))
        self.sample, self.velocity, self.at = sample, self._speed.of(sample), now
        return 0.0


class Speed:
    """Velocity (n,) from positions, by two samples at least `span` [s] apart. What a controller reports as velocity may
    be in degrees, and a brake would multiply that."""

    def __init__(self, span: float = 0.02) -> None:
        self._span = span
        self._was: tuple[float, np.ndarray] | None = None
        self.value = np.zeros(0)

    def of(self, sample: JointSample) -> np.ndarray:
        """At a sample; zero until it is known."""
        if self._was is None or not 0.0 <= sample.stamp - self._was[0] <= 1.0:
            self._was, self.value = (sample.stamp, sample.position), 0.0 * sample.position
        elif sample.stamp - self._was[0] >= self._span:
            self.value = (sample.position - self._was[1]) / (sample.stamp - self._was[0])
            self._was = sample.stamp, sample.position
        return self.value


class Counter:
    """Numbers of samples by their stamps, which jitter with the controller's loop.

    Args:
        period: of samples [s].
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self.first: float | None = None  # stamp [s] of number 0
        self._origin = 0.0
        self._last, self._stamp = -1, -np.inf
        self._between = 0.0
        self.jitter = 0.0  # s, the largest

    @property
    def crowded(self) -> bool:
        """Whether about twice as many samples come as one source makes; the same one twice does not count."""
        return self._between > _CROWD

    def number(self, stamp: float) -> int | None:
        """Of the sample with this stamp; None where it has come already, or is older than one that has."""
        again, self._stamp = stamp == self._stamp, stamp
        if self.first is None:
            self.first = self._origin = stamp
        exact = (stamp - self._origin) / self.period
        number = round(exact)
        if number == self._last and exact > self._last + 0.25:  # late, and the one before was later
            number += 1
        if number <= self._last:
            self._between += not again
            return None
        self._between = max(0.0, self._between - 0.5)
        off = stamp - (self._origin + number * self.period)
        self._origin += _REFIT * off
        self.jitter = max(self.jitter, abs(off))
        self._last = number
        return number

    def time(self, number: int) -> float:
        """[s] of a sample: steps are equal."""
        assert self.first is not None
        return self.first + number * self.period
