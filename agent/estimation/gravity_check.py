"""Whether gravity acts as the description says, by the masses that it gives its links.

A pendulum's torque fits gravity in any direction of its plane of motion, as its centre of mass is free; so do slow
motions of an arm with gravity upside down. Its gravity torque is known all the same, but for a constant, and may be
compared with that of the description. A description whose inertials were never measured says nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from agent.estimation.prior_choice import placeholders
from agent.robot import Dynamics, RobotDescription

_REFUTED = 0.9  # of the gravity torque, root mean square, that the description leaves at least, and
_FITS = 0.5  # at most, with one thing undone
_THOUSAND = (300.0, 3000.0)  # times the described gravity torque: N·mm
_SEEN = 0.2  # of the heaviest joint's torque that gravity must make up


def gravity_directions(robot: RobotDescription) -> Iterator[RobotDescription]:
    """The robot with gravity along each axis of its base, downwards first, but not as it is."""
    size = float(np.linalg.norm(robot.gravity)) or 9.80665
    for direction in (*-np.eye(3)[::-1], *np.eye(3)):
        x, y, z = (float(size * value) + 0.0 for value in direction)
        if not np.allclose((x, y, z), robot.gravity, atol=1e-3 * size):
            yield replace(robot, gravity=(x, y, z))


def gravity_text(robot: RobotDescription) -> str:
    """Its direction as a user writes it."""
    return f"({', '.join(f'{value:.4g}' for value in robot.gravity)})"


def described_gravity_doubts(
    robot: RobotDescription, q: np.ndarray, fitted: np.ndarray, torque: np.ndarray
) -> Iterator[str]:
    """What speaks against the description's gravity, or for N·mm, in a fit's gravity torque and all torque (S, n)."""
    masses = Dynamics(robot).standard_parameters()
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    fitted = (fitted - fitted.mean(axis=0))[:, turning]
    size = float(np.linalg.norm(fitted))
    if placeholders(masses) or size < _SEEN * np.linalg.norm((torque - torque.mean(axis=0))[:, turning]):
        return

    def described(of: RobotDescription) -> np.ndarray:
        gravity = (Dynamics(of).regressor(q, 0 * q, 0 * q) @ masses)[:, turning]
        return gravity - gravity.mean(axis=0)

    given = described(robot)
    if np.linalg.norm(fitted - given) < _REFUTED * size:
        return
    times = float(np.sum(fitted * given) / max(np.sum(given**2), 1e-300))
    if _THOUSAND[0] < times < _THOUSAND[1] and np.linalg.norm(fitted - times * given) < _FITS * size:
        yield f"torques look like N·mm: gravity moves the joints by {times:.3g} times what the described masses weigh"
        return
    left, other = min(
        ((float(np.linalg.norm(fitted - described(other))), other) for other in gravity_directions(robot)),
        key=lambda pair: pair[0],
    )
    if left < _FITS * size:
        yield (
            f"gravity in the base frame looks like {gravity_text(other)}, or the described centres of mass are wrong: "
            f"of the gravity torque, the described masses explain {100 * (1 - left / size):.0f} % so, and none as given"
        )
