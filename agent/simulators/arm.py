"""One serial arm read from a simulator's file, in either format, and the identified model made from it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np

from agent.core import InputError
from agent.model import SIMULATOR, FrictionTerm, IdentifiedModel, ModelEffect, Reversal
from agent.robot import Dynamics, Joint, ParameterLayout, RobotDescription, chain_of, rigid_bodies
from agent.simulators.servos import PositionServos

#: Speed [rad/s or m/s] and acceleration of a joint whose file and robot say nothing.
USUAL_SPEED, _USUAL_ACCELERATION = np.pi, 10.0
_REVERSAL = 2e-3  # of the highest speed, over which Coulomb friction changes sign
_EXACT = 1e-6  # standard deviation of a parameter that may not move, over its value
_CUTOFF, _ORDER = 30.0, 8  # Hz, of the filter, where the caller knows no better
_ANGLE, _LENGTH = 0.05, 0.03  # rad, and part of the reach, by which the axes of one and the same arm may differ


@dataclass(frozen=True, eq=False)
class CarryingBody:
    """The heaviest body that a joint carries: changes of the link's inertia are written to it.

    `name` in the file, `pose` (4, 4) of its frame in the link's, `own` (10,) its parameters in the link's frame; `link`
    and `link_pose` are the same of the URDF that the arm is read as.
    """

    name: str
    pose: np.ndarray
    own: np.ndarray
    link: str
    link_pose: np.ndarray


@dataclass(frozen=True, eq=False)
class SimulatedArm:
    """One arm of a file: `robot` is its chain, with gear ratios of 1 and joints called as in the description or logs.

    Per joint (n,), on the joint side: armature [kg·m²], damping [N·m·s/rad], frictionloss [N·m], its impedance (1:
    it holds a stationary joint; less: that creeps), stiffness [N·m/rad] and the rest position [rad] of the spring;
    `file_joints` are the joints' names in the file. `carrying` (n,): which body takes a change of each link. `servos`:
    those of the file's joints, or why it has none. `step` [s] and `integrator` are those of the file's physics.
    `excluded`: pairs of bodies that collide in the file and are to pass through each other. `solver` (n,): how MuJoCo
    solves friction and limits of a joint, as attributes of an MJCF, where that is not its usual way. `model`: the
    compiled MJCF (MjModel) without these pairs, as compiling takes a second.
    """

    path: Path
    robot: RobotDescription
    file_joints: tuple[str, ...]
    armature: np.ndarray
    damping: np.ndarray
    frictionloss: np.ndarray
    impedance: np.ndarray
    stiffness: np.ndarray
    rest: np.ndarray
    carrying: tuple[CarryingBody, ...]
    notes: tuple[str, ...] = ()
    servos: PositionServos | str = "a URDF has no servos"
    step: float | None = None
    integrator: str | None = None
    excluded: tuple[tuple[str, str], ...] = ()
    solver: tuple[Mapping[str, str], ...] = ()
    model: Any = field(default=None, repr=False)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """(n,) names in the robot description or the logs."""
        return self.robot.joint_names

    @property
    def is_urdf(self) -> bool:
        """Whether its file is a URDF, by its name; else it is an MJCF."""
        return self.path.suffix.lower() == ".urdf"


def plain_joint(name: str, prismatic: bool, lower: float, upper: float, speed: float = 0.0) -> Joint:
    """A joint without drive data. A `speed` [rad/s or m/s] that is not positive and finite is set to a usual value."""
    return Joint(
        name=name,
        prismatic=prismatic,
        gear_ratio=1.0,
        nominal_motor_torque=None,
        max_velocity=float(speed) if 0 < speed < np.inf else USUAL_SPEED,
        max_acceleration=_USUAL_ACCELERATION,
        max_jerk=None,
        rotor_inertia=None,
        max_torque=None,
        torque_constant=None,
        lower=float(lower),
        upper=float(upper),
    )


def plain_robot(
    name: str, root: Element, tip_frame: str, gravity: Sequence[float], joints: Iterable[Joint]
) -> RobotDescription:
    """The robot description of a chain given as a URDF element."""
    joints, (x, y, z) = tuple(joints), map(float, gravity)
    return RobotDescription(
        name=re.sub(r"[^\w .+-]", "_", name).strip(" .+-")[:64] or "arm",
        urdf=tostring(root, encoding="unicode"),
        tip_frame=tip_frame,
        gravity=(x, y, z),
        cartesian_limits=None,
        joints=joints,
        motor_coupling=tuple(map(tuple, np.eye(len(joints)).tolist())),
    )


def described(arm: SimulatedArm, robot: RobotDescription | None) -> tuple[RobotDescription, tuple[str, ...]]:
    """The robot in the file, with the drives of `robot` if given, and notes for the user.

    Raises:
        InputError: the file's arm is not that of the description.
    """
    drives = arm.robot if robot is None else robot
    for joint, own in zip(drives.joints, arm.robot.joints, strict=True):
        if joint.prismatic != own.prismatic:
            kinds = ("turns", "slides")
            raise InputError(
                f"{arm.path}: {joint.name} {kinds[own.prismatic]} here and {kinds[joint.prismatic]} in robot "
                f"{drives.name}: it is a model of another arm, or joints are matched wrongly (--map)"
            )
    # the file says what turns with a joint, so where bodies and rotors are distinguished, that is where to start from
    joints = tuple(
        replace(joint, rotor_inertia=float(inertia) / joint.gear_ratio**2 or joint.rotor_inertia)
        for joint, inertia in zip(drives.joints, arm.armature, strict=True)
    )
    description = replace(arm.robot, name=drives.name, cartesian_limits=drives.cartesian_limits, joints=joints)
    if robot is None:
        return description, ()
    _check_same_arm(arm, description, robot)
    coupled = (
        "armature, damping and frictionloss of the file act on its joints, so the motor coupling of the description is "
        "no part of the simulator"
    )
    return description, (coupled,) if np.any(robot.coupling - np.eye(robot.dof)) else ()


def _check_same_arm(arm: SimulatedArm, description: RobotDescription, robot: RobotDescription) -> None:
    """Raise InputError where the angle or distance of neighbouring axes differs from that of `robot`."""
    angles, distances, reach = _between_axes(description)
    wanted, apart, other_reach = _between_axes(robot)
    for k, (angle, distance) in enumerate(zip(np.abs(angles - wanted), np.abs(distances - apart), strict=True)):
        if angle > _ANGLE or distance > _LENGTH * max(reach, other_reach):
            pair = " and ".join(robot.joint_names[k : k + 2])
            raise InputError(
                f"{arm.path}: a model of another arm than robot {robot.name}: the axes of {pair} are "
                f"{1e3 * distances[k]:.0f} mm and {np.degrees(angles[k]):.0f}° apart here, {1e3 * apart[k]:.0f} mm and "
                f"{np.degrees(wanted[k]):.0f}° there; name the right file, or match the joints with --map"
            )


def _between_axes(robot: RobotDescription) -> tuple[np.ndarray, np.ndarray, float]:
    """(n - 1,) angle [rad] and shortest distance [m] of neighbouring axes, and the sum of all distances.

    They are link constants (Denavit and Hartenberg), the same whatever the zero position, direction or base frame.
    """
    axes, points, tip = map(np.asarray, chain_of(robot).axes_at_zero())
    normals, ways = np.cross(axes[:-1], axes[1:]), np.diff(points, axis=0)
    sines = np.linalg.norm(normals, axis=1)
    parallel_distances = np.linalg.norm(np.cross(axes[:-1], ways), axis=1)  # of axes that are parallel
    distances = np.where(
        sines > 1e-3, np.abs(np.sum(normals * ways, axis=1)) / np.maximum(sines, 1e-3), parallel_distances
    )
    reach = float(np.sum(np.linalg.norm(np.diff([*points, tip[:3, 3]], axis=0), axis=1)))
    prismatic = np.array([joint.prismatic for joint in robot.joints])
    known = ~(prismatic[:-1] | prismatic[1:])  # the axis of a prismatic joint has no position
    return np.arcsin(np.minimum(sines, 1.0)), np.where(known, distances, 0.0), reach


def model_of(arm: SimulatedArm, robot: RobotDescription, provenance: dict[str, object]) -> IdentifiedModel:
    """The identified model that predicts what the file's simulator does. `robot` is that of `described`.

    Args:
        arm: as read from the file.
        robot: description that `described` gives.
        provenance: of the model.

    Raises:
        InputError: a mass matrix that is not positive, or joints that are not one serial chain.
    """
    check_mass_matrix(arm, robot)
    rigid = rigid_bodies(robot)
    n = robot.dof
    standard = np.concatenate([rigid.dynamics.standard_parameters(), arm.armature / robot.gear_ratios**2])
    terms: list[FrictionTerm] = []
    for k, joint in enumerate(robot.joints):
        reversal = Reversal("speed", _REVERSAL * joint.max_velocity)
        terms += [FrictionTerm(k, "coulomb", reversal), FrictionTerm(k, "viscous")]
    friction = np.stack([arm.frictionloss, arm.damping], axis=1).ravel()
    values = np.append(rigid.projection @ standard, friction)
    size = np.abs(values) + 1e-3 * np.abs(values).max(initial=1e-6)
    springs = tuple(
        ModelEffect(
            "gravity_spring",
            (robot.joint_names[k],),
            {"constant": float(-arm.stiffness[k] * arm.rest[k]), "stiffness": float(arm.stiffness[k])},
        )
        for k in np.flatnonzero(arm.stiffness)
    )
    return IdentifiedModel(
        robot=robot,
        independent=rigid.independent,
        projection=rigid.projection,
        standard_names=rigid.standard_names,
        combinations=rigid.combinations,
        terms=tuple(terms),
        values=values,
        covariance=np.diag((_EXACT * size) ** 2),
        cutoff=_CUTOFF,
        order=_ORDER,
        method=SIMULATOR,
        weights=np.ones((2, n)),
        residual_rmse=np.zeros(n),
        held_out_rmse=np.zeros(n),
        condition_number=float("inf"),
        standard=standard,
        notes=(f"read from {arm.path.name}, not identified: its parameters have no uncertainty", *arm.notes),
        effects=springs,
        provenance=dict(provenance),
    )


def smooth_torque(arm: SimulatedArm, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(S, n) joint torque [N·m] of everything in the file but Coulomb friction, which each simulator reverses its way.

    By the bodies themselves: base parameters drop directions that rotations of few digits nearly cancel.
    """
    bodies = Dynamics(arm.robot).inverse_dynamics(q, qd, qdd)
    return np.asarray(bodies + arm.armature * qdd + arm.damping * qd + arm.stiffness * (q - arm.rest))


def check_mass_matrix(arm: SimulatedArm, robot: RobotDescription) -> None:
    """Raise InputError unless the mass matrix is positive definite at random postures."""
    links = Dynamics(robot)
    low, high = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    for q in np.random.default_rng(0).uniform(low, high, (20, robot.dof)):
        matrix = links.mass_matrix(q) + np.diag(arm.armature)
        size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        least = float(np.linalg.eigvalsh(matrix / np.outer(size, size))[0])
        if np.any(np.diag(matrix) <= 0) or least <= 1e-9:
            blocks = ParameterLayout.of(robot).blocks(np.append(links.standard_parameters(), np.zeros(robot.dof)))
            light = [name for name, block in zip(robot.joint_names, blocks, strict=True) if block[0] <= 0]
            which = f"; moved by {', '.join(light)} there is no mass" if light else ""
            raise InputError(
                f"{arm.path}: the mass matrix is not positive, so this arm could not be simulated{which}; "
                "give its links mass and inertia, or its joints armature"
            )
