"""An arm that does not do what its program says, on command: another path, another way, servos that do not follow."""

from __future__ import annotations

import numpy as np

_RAMP = 0.2  # s, in which a joint goes astray


class Astray:
    """What is put onto the set-points of n joints; nothing until somebody says so."""

    def __init__(self, joints: int, period: float) -> None:
        self._period = period
        self._path = _Offset(joints)
        self._servo = _Offset(joints)
        self._scale = np.ones(joints)

    def leave_path(self, joint: int, by: float) -> None:
        """The set-points of a joint go off by so much [rad] from now on."""
        self._path.go(joint, by)

    def lose_servo(self, joint: int, by: float) -> None:
        """A joint goes off its set-points by so much [rad] from now on."""
        self._servo.go(joint, by)

    def change_way(self, joint: int, times: float) -> None:
        """A joint makes `times` the way that the program says, from where it starts."""
        self._scale[joint] = times

    def changed(self, position: np.ndarray, velocity: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Set-points (K, n) and their velocities in place of a program's that begins at `start` (n,)."""
        offset, rate = self._path.next(len(position), self._period)
        return start + self._scale * (position - start) + offset, self._scale * velocity + rate

    def followed(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the servos go to in place of set-points (K, n)."""
        offset, rate = self._servo.next(len(position), self._period)
        return position + offset, velocity + rate


class _Offset:
    """From zero to its value in a half cosine."""

    def __init__(self, joints: int) -> None:
        self._value = np.zeros(joints)
        self._passed = 0.0

    def go(self, joint: int, by: float) -> None:
        self._value[joint] = by
        self._passed = 0.0

    def next(self, count: int, period: float) -> tuple[np.ndarray, np.ndarray]:
        """(K, n) the offset at the next `count` samples, and its rate."""
        part = np.minimum((self._passed + period * np.arange(1, count + 1)) / _RAMP, 1.0)
        self._passed = _RAMP * float(part[-1]) if count else self._passed
        rate = np.pi / 2 / _RAMP * np.sin(np.pi * part)
        return np.outer(0.5 - 0.5 * np.cos(np.pi * part), self._value), np.outer(rate, self._value)
