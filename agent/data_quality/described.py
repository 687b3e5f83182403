"""What the described masses say of torques that fit a rigid arm: direction and presence of gravity, unit of torque.

A pendulum's torque fits gravity in any direction of its plane of motion, as its centre of mass is free; so do slow
motions of an arm with gravity upside down, or torques without any. The gravity torque of the fit is known all the same,
but for a constant, and can be compared with that of the description. A description whose inertials were never measured
says nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from agent.data_quality.finding import QualityFinding
from agent.data_quality.ranges import drive_torque
from agent.data_quality.rigid_fit import Bodies, FitSamples
from agent.estimation import placeholders
from agent.robot import RobotDescription

_REFUTED = 0.9  # of the gravity torque, root mean square, that the description leaves at least, and
_FITS = 0.5  # at most, with one thing undone
_THOUSAND = (300.0, 3000.0)  # times the described gravity torque: N·mm
_SEEN = 0.2  # of a torque, and of the heaviest joint's described gravity, that gravity must make up to be judged
_SCALES = (0.25, 4.0)  # times the described gravity torque: beyond them another unit is likely
_ALIKE = 0.9  # correlation of both gravity torques from where on they differ in size alone
_UNIT = 1.35  # times, on average, that torques in a part of nominal torque differ from what that makes of them
_LIGHTEST = 1.0  # kg for each square metre of reach: a description of less holds placeholders
MEND_GRAVITY = "set `gravity` in the robot description to this (it follows from how the base is mounted)"
WITH_GRAVITY = (
    "record joint torque that includes gravity: take the controller's total torque or the motor currents instead of "
    "the gravity-compensated effort (UR's ROS 2 driver takes gravity off by default; libfranka's tau_J includes it)"
)


def gravity_axes(robot: RobotDescription) -> Iterator[RobotDescription]:
    """The robot with gravity along each axis of its base, downwards first, but not as it is."""
    size = float(np.linalg.norm(robot.gravity)) or 9.80665
    for direction in (*-np.eye(3)[::-1], *np.eye(3)):
        gravity = size * direction + 0.0
        if not np.allclose(gravity, robot.gravity, atol=1e-3 * size):
            yield with_gravity(robot, gravity)


def with_gravity(robot: RobotDescription, gravity: np.ndarray) -> RobotDescription:
    """The robot with gravity (3,) [m/s²] in the base frame."""
    x, y, z = map(float, gravity)
    return replace(robot, gravity=(x, y, z))


def gravity_text(robot: RobotDescription, found: RobotDescription) -> str:
    """Its direction as a user writes it, and how far it is from the described one."""
    a, b = np.array(robot.gravity), np.array(found.gravity)
    angle = np.degrees(np.arccos(np.clip(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12), -1, 1)))
    return f"gravity in the base frame looks like ({', '.join(f'{x:.4g}' for x in b)}), {angle:.0f}° from the described"


def against_description(robot: RobotDescription, s: FitSamples, fitted: np.ndarray) -> Iterator[QualityFinding]:
    """What the described masses say against a fit's gravity torque `fitted` (S, n)."""
    bodies = Bodies(robot)
    masses = bodies.dynamics.standard_parameters()
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    if placeholders(masses) or masses[::10].sum() < _LIGHTEST * bodies.reach() ** 2 or not turning.any():
        return

    def described(of: RobotDescription) -> np.ndarray:
        gravity = Bodies(of).dynamics.regressor(s.q, 0 * s.q, 0 * s.q) @ masses
        return (gravity - gravity.mean(axis=0)) * turning

    given, fitted, torque = (
        described(robot),
        (fitted - fitted.mean(axis=0)) * turning,
        (s.torque - s.torque.mean(axis=0)),
    )
    weight, seen, size = (np.std(values, axis=0) for values in (given, fitted, torque))
    heavy = weight > _SEEN * weight.max()
    if np.all(seen[heavy] < _SEEN * size[heavy]) and np.all(weight[heavy] > size[heavy]):
        whose = tuple(np.array(robot.joint_names)[heavy].tolist())
        yield QualityFinding(
            f"these torques carry no gravity: the described masses need {weight.max():.3g} N·m of it, "
            f"root mean square, and {', '.join(whose)} show next to none",
            whose,
            advice=WITH_GRAVITY,
            scale=True,
        )
        return
    length = float(np.linalg.norm(fitted))
    if length < _SEEN * np.linalg.norm(torque * turning):
        return
    if np.linalg.norm(fitted - given) >= _REFUTED * length:
        times = float(np.sum(fitted * given) / max(np.sum(given**2), 1e-300))
        if _THOUSAND[0] < times < _THOUSAND[1] and np.linalg.norm(fitted - times * given) < _FITS * length:
            text = (
                f"torques look like N·mm: gravity moves the joints by {times:.3g} times what the described masses weigh"
            )
            yield QualityFinding(text, robot.joint_names, scale=True)
            return
        left, other = min(
            ((float(np.linalg.norm(fitted - described(other))), other) for other in gravity_axes(robot)),
            key=lambda pair: pair[0],
        )
        if left < _FITS * length:
            yield QualityFinding(
                f"{gravity_text(robot, other)}, or the described centres of mass are wrong: of the gravity torque, the "
                f"described masses explain {100 * (1 - left / length):.0f} % so, and none as given",
                robot.joint_names,
                advice=MEND_GRAVITY,
            )
            return
    judged = heavy & (seen > _SEEN * size)
    yield from _other_unit(robot, given[:, judged], fitted[:, judged], np.flatnonzero(judged))


def _other_unit(
    robot: RobotDescription, given: np.ndarray, fitted: np.ndarray, joints: np.ndarray
) -> Iterator[QualityFinding]:
    """Torque of some joints that is like the described gravity in all but its size, (S, k) both."""
    product = np.sum(given * fitted, axis=0)
    alike = product > _ALIKE * np.linalg.norm(given, axis=0) * np.linalg.norm(fitted, axis=0)
    joints, times = joints[alike], (product / np.sum(given**2, axis=0))[alike]
    if not len(joints):
        return
    unit = ""
    if np.all((times < _SCALES[0]) | (times > _SCALES[1])):
        unit = "motor currents, or % or ‰ of a nominal torque"
    as_torque = np.mean(np.abs(np.log(times)))
    for name, whole in (("%", 100.0), ("‰", 1000.0)):
        as_part = np.mean(np.abs(np.log(times * drive_torque(robot)[joints] / whole)))
        if as_part < np.log(_UNIT) < as_torque / 2:
            unit = f"{name} of nominal torque"
    if unit:
        sizes = ", ".join(f"{robot.joint_names[k]} {value:.2g}" for k, value in zip(joints, times, strict=True))
        yield QualityFinding(
            f"the torques of {', '.join(robot.joint_names)} look like another unit ({unit}) in 100 % of the samples: "
            f"times what the described masses weigh, their gravity is {sizes}",
            robot.joint_names,
            advice="scale them by torque constant and gear ratio, or by nominal torque, when you import them",
            refuses=False,
            scale=True,
        )
