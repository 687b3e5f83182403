"""Legs and corners of a path: straight in a vector space, while the tool turns by quaternion slerp.

The space is that of positions [m], or of joints divided by their speed limits [s]. A corner cuts `cut` off either leg
and goes round on the circle or the parabola that touches both there. The way on a parabola is that of its control
polygon.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

_STRAIGHT = 1e-4  # rad; a circle through less is one of infinite radius
_CORNER_KNOTS = 33


@dataclass(frozen=True, eq=False)
class Leg:
    """Straight from `start` to `end` (d,), the tool from `turn` by the rotation vector `by` (3,), for one move."""

    start: np.ndarray
    end: np.ndarray
    turn: Rotation
    by: np.ndarray

    @property
    def length(self) -> float:
        """Length of the path in its space."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def direction(self) -> np.ndarray:
        """(d,) unit vector."""
        return (self.end - self.start) / self.length

    def at(self, part: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Points (K, d) and K orientations at fractions (K,) of the path, 0 to 1."""
        return self.start + part[:, None] * (self.end - self.start), self.turn * Rotation.from_rotvec(
            part[:, None] * self.by
        )


def corner_angle(first: Leg, second: Leg) -> float:
    """[rad] by which the way turns from one leg to the next."""
    return float(np.arccos(np.clip(first.direction @ second.direction, -1.0, 1.0)))


def cut_off(angle: float, family: str) -> float:
    """Distance between curve and corner point for a cut of one."""
    if family == "parabola":
        return 0.5 * float(np.sin(angle / 2))
    return (1.0 - float(np.cos(angle / 2))) / max(float(np.sin(angle / 2)), 1e-12)


def corner(first: Leg, second: Leg, cut: float, family: str) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Distance (K,) from its beginning, points (K, d) and orientations of the corner between two legs."""
    angle = corner_angle(first, second)
    u_in, u_out = first.direction, second.direction
    sigma = np.linspace(0.0, 1.0, _CORNER_KNOTS)
    if family == "circle" and angle > _STRAIGHT:
        radius = cut / np.tan(angle / 2)
        normal = (u_out - np.cos(angle) * u_in) / np.sin(angle)
        turned = (sigma * angle)[:, None]
        places = first.end - cut * u_in + radius * (np.sin(turned) * u_in + (1 - np.cos(turned)) * normal)
        distance = radius * angle * sigma
    else:
        places = first.end + cut * (sigma[:, None] ** 2 * u_out - (1 - sigma[:, None]) ** 2 * u_in)
        distance = (
            2.0 * cut * sigma
        )  # in time it is a parabola too: one acceleration from the one velocity to the other
    # The orientation leaves and arrives at the rate per metre that it has on the legs.
    u = sigma + (distance[-1] / (2 * cut) - 1) * sigma * (1 - sigma) * (1 - 2 * sigma)
    first_turn, second_turn = first.by * cut / first.length, second.by * cut / second.length
    into = second.turn * Rotation.from_rotvec((u - 1)[:, None] * first_turn)
    out = second.turn * Rotation.from_rotvec(u[:, None] * second_turn)
    return distance, places, into * Rotation.from_rotvec(u[:, None] * (into.inv() * out).as_rotvec())


def arc(start: np.ndarray, via: np.ndarray, end: np.ndarray, part: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Length, and points (K, 3) at fractions (K,) of the circle from start via `via` to end; None if there is none."""
    a, b = via - start, end - start
    axis = np.cross(a, b)
    area = float(axis @ axis)
    if area < 1e-16:
        return None
    centre = start + (np.cross(axis, a) * (b @ b) + np.cross(b, axis) * (a @ a)) / (2 * area)
    axis /= np.sqrt(area)
    x = start - centre
    y = np.cross(axis, x)
    angle = float(np.arctan2(y @ (end - centre), x @ (end - centre))) % (2 * np.pi)
    turned = (part * angle)[:, None]
    return angle * float(np.linalg.norm(x)), centre + np.cos(turned) * x + np.sin(turned) * y
