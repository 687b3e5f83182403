"""Rigid-body dynamics and forward kinematics. Beside `collision` the only module that imports Pinocchio."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import pinocchio as pin

from agent.core import InputError
from agent.robot.description import RobotDescription
from agent.robot.parameter_layout import ParameterLayout

#: Samples from which on a copy of the model costs less than as many calls.
_MANY = 50


@dataclass(frozen=True)
class Tool:
    """What is mounted on the tip frame: `frame` (4, 4) of the TCP and `centre_of_mass` (3,) [m] in it, mass [kg]."""

    frame: np.ndarray
    mass: float = 0.0
    centre_of_mass: np.ndarray | None = None

    def text(self) -> str:
        """The same in a line, equal for equal tools."""
        centre = np.zeros(3) if self.centre_of_mass is None else self.centre_of_mass
        turned = pin.log3(self.frame[:3, :3])
        parts = [("frame", 1e3 * self.frame[:3, 3], "mm"), ("turned", np.degrees(turned), "deg")]
        parts += [("mass", np.array([self.mass]), "kg"), ("centre of mass", 1e3 * np.asarray(centre), "mm")]
        # rounded and without negative zeros
        return ", ".join(f"{name} {' '.join(f'{x:g}' for x in np.round(v, 4) + 0.0)} {unit}" for name, v, unit in parts)


class Dynamics:
    """A robot's rigid bodies, optionally with a tool. Not thread-safe: it owns one Pinocchio `Data`.

    All methods take arrays with samples first: q, q̇, q̈ are (S, n), joint side [rad, rad/s, rad/s²].

    Raises:
        InputError: a URDF that Pinocchio refuses, or joints that are not one serial chain in the order given.
    """

    def __init__(self, robot: RobotDescription, tool: Tool | None = None):
        self.robot = robot
        self.tool = tool
        self._model = pinocchio_model(robot, tool)
        self._data = self._model.createData()
        self._tip = frame_id(self._model, robot.tip_frame)

    @property
    def dof(self) -> int:
        """Number of joints n."""
        return self.robot.dof

    def inverse_dynamics(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n) joint torque of the rigid bodies [N·m], without rotors and friction (recursive Newton-Euler)."""
        if len(q) >= _MANY:
            # All in one call, on one thread: two are slower.
            samples = (np.asarray(values, dtype=float).T for values in (q, qd, qdd))
            torque = pin.rneaInParallel(1, pin.ModelPool(self._model, 1), *samples)
            return np.asarray(torque).reshape(self.dof, -1).T  # of a single joint it is a vector
        torque = np.empty(np.shape(q))
        for k in range(len(torque)):
            torque[k] = pin.rnea(self._model, self._data, q[k], qd[k], qdd[k])
        return torque

    def torque_slope(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, n) ∂τ / ∂q of `inverse_dynamics`, row by joint torque (Carpentier, Mansard, RSS 2018)."""
        slope = np.empty((len(q), self.dof, self.dof))
        for k in range(len(slope)):
            slope[k] = pin.computeRNEADerivatives(self._model, self._data, q[k], qd[k], qdd[k])[0]
        return slope

    def regressor(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n, 10 n) regressor of the standard inertial parameters: τ = Y π, links base to tip."""
        if len(q) >= _MANY:
            return self.regressor_by_joint(q, qd, qdd).transpose(2, 0, 1)
        columns = np.empty((len(q), self.dof, ParameterLayout.of(self.robot, rotors=False).size))
        for k in range(len(columns)):
            columns[k] = pin.computeJointTorqueRegressor(self._model, self._data, q[k], qd[k], qdd[k])
        return columns

    def regressor_by_joint(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(n, 10 n, S) the columns of `regressor`, joint by joint, six times quicker than Pinocchio's."""
        from agent.compiled import regressor_columns

        samples = (np.asarray(values, dtype=float) for values in (q, qd, qdd))
        return regressor_columns(*self._frames, self._model.gravity.linear.copy(), *samples)

    @property
    def chain(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """What compiled loops take: of each joint its frame's rotation (n, 3, 3) and origin (n, 3) [m], its axis (n, 3)
        and whether it slides (n,); gravity (3,) [m/s²]; of each link its standard parameters (n, 10)."""
        parameters = self.standard_parameters().reshape(self.dof, -1)
        return *self._frames, self._model.gravity.linear.copy(), parameters

    @cached_property
    def _frames(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of each joint's frame in the one before its rotation (n, 3, 3) and origin (n, 3) [m], of each joint its axis
        (n, 3) and whether it slides (n,)."""
        placements = list(self._model.jointPlacements)[1:]
        prismatic = np.array([joint.prismatic for joint in self.robot.joints])
        pin.computeJointJacobians(self._model, self._data, pin.neutral(self._model))
        own = [
            pin.getJointJacobian(self._model, self._data, k + 1, pin.ReferenceFrame.LOCAL).reshape(6, -1)[:, k]
            for k in range(self.dof)
        ]
        return (
            np.array([placement.rotation for placement in placements]),
            np.array([placement.translation for placement in placements]),
            np.array([screw[:3] if slides else screw[3:] for screw, slides in zip(own, prismatic, strict=True)]),
            prismatic,
        )

    def standard_parameters(self) -> np.ndarray:
        """(10 n,) inertial parameters of URDF and tool, in the regressor's order."""
        return np.concatenate([self._model.inertias[k + 1].toDynamicParameters() for k in range(self.dof)])

    def link_ends(self) -> np.ndarray:
        """(n, 3) where the next joint, after the last one the tip, is in the frame of each joint's link [m]."""
        joints = [self._model.jointPlacements[k + 1].translation for k in range(1, self.dof)]
        return np.array([*joints, self._model.frames[self._tip].placement.translation])

    def with_parameters(self, parameters: np.ndarray) -> Dynamics:
        """A copy whose links have these (10 n,) standard parameters; they need not be physical.

        A massless link is given 1e-12 kg so that its first moment can be represented.
        """
        other = copy(self)
        other._model = pin.Model(self._model)
        other._data = other._model.createData()
        for k, block in enumerate(ParameterLayout.of(self.robot).blocks(parameters)):
            block = np.where(np.arange(len(block)) == 0, np.where(abs(block[0]) < 1e-12, 1e-12, block[0]), block)
            other._model.inertias[k + 1] = pin.Inertia.FromDynamicParameters(block)
        return other

    def with_gravity(self, gravity: np.ndarray) -> Dynamics:
        """A copy with gravity (3,) [m/s²] in the base frame."""
        robot = replace(self.robot, gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])))
        return Dynamics(robot, self.tool).with_parameters(self.standard_parameters())

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """(n, n) of the rigid bodies at one q (n,), without rotors."""
        return pin.crba(self._model, self._data, q).copy()

    def acceleration_function(self, axle_inertia: np.ndarray) -> Callable[..., np.ndarray]:
        """A function (q, q̇, joint torque, added=None) → q̈, all (n,), for stepping many times; it owns its own data.

        `axle_inertia` (n,) [kg·m²] is what turns with the axles besides the links: reflected rotors. `added` (n,) or
        None is inertia on top of it in one step, which is how an implicit integrator brings in damping. Without
        motor coupling both are the armature of the articulated-body algorithm, else the mass matrix itself is solved.
        """
        model = pin.Model(self._model)
        data = model.createData()
        model.armature = np.array(axle_inertia, dtype=float)
        coupling = self.robot.coupling
        if not np.any(coupling - np.eye(self.dof)):
            armature = model.armature  # a view

            def accelerate(
                q: np.ndarray, qd: np.ndarray, torque: np.ndarray, added: np.ndarray | None = None
            ) -> np.ndarray:
                if added is not None:
                    np.add(axle_inertia, added, out=armature)
                return pin.aba(model, data, q, qd, torque)

            return accelerate
        from scipy.linalg.lapack import dposv

        model.armature = np.zeros(self.dof)
        rotors = coupling.T @ np.diag(axle_inertia) @ coupling

        def accelerate_coupled(
            q: np.ndarray, qd: np.ndarray, torque: np.ndarray, added: np.ndarray | None = None
        ) -> np.ndarray:
            # crba fills the upper triangle only, which is all that dposv reads.
            matrix = pin.crba(model, data, q) + rotors
            if added is not None:
                matrix = matrix + coupling.T @ (added[:, None] * coupling)
            return dposv(matrix, torque - pin.nonLinearEffects(model, data, q, qd))[1]

        return accelerate_coupled

    def tcp_pose(self, q: np.ndarray) -> np.ndarray:
        """(S, 4, 4) pose of the tool centre point (the tip frame without a tool) in the base frame."""
        poses = self.tip_pose(q)
        return poses if self.tool is None else poses @ self.tool.frame

    def tip_pose(self, q: np.ndarray) -> np.ndarray:
        """(S, 4, 4) pose of the tip frame in the base frame."""
        return self._poses(q, self._tip)

    def tcp_jacobian(self, q: np.ndarray) -> np.ndarray:
        """(S, 6, n) Jacobian of the TCP: linear velocity of its origin, then angular, in the base frame."""
        offset = np.zeros(3) if self.tool is None else self.tool.frame[:3, 3]
        jacobians = np.empty((len(q), 6, self.dof))
        for k in range(len(jacobians)):
            jacobian = pin.computeFrameJacobian(
                self._model, self._data, q[k], self._tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
            ).reshape(6, -1)  # a vector for a single joint
            lever = self._data.oMf[self._tip].rotation @ offset
            jacobian[:3] -= pin.skew(lever) @ jacobian[3:]
            jacobians[k] = jacobian
        return jacobians

    def joint_screws(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocity per joint speed (S, 6, n), linear of a point that passes the base's origin, then angular, all in the
        base frame; and the far end of every link (S, n, 3) [m], which is the next joint's origin, or the tip's."""
        screws, ends = np.empty((len(q), 6, self.dof)), np.empty((len(q), self.dof, 3))
        for k in range(len(q)):
            jacobian = pin.computeJointJacobians(self._model, self._data, q[k])
            screws[k] = jacobian.reshape(6, -1)  # a vector for a single joint
            for link in range(self.dof - 1):
                ends[k, link] = self._data.oMi[link + 2].translation
            ends[k, -1] = pin.updateFramePlacement(self._model, self._data, self._tip).translation
        return screws, ends

    @cached_property
    def reach(self) -> float:
        """Largest distance of the tip from the base over random postures [m], at least 0.1."""
        tips = self.tip_pose(np.random.default_rng(0).uniform(-3, 3, (50, self.dof)))[:, :3, 3]
        return max(float(np.linalg.norm(tips, axis=1).max()), 0.1)

    def link_rotations(self, q: np.ndarray, link: int) -> np.ndarray:
        """(S, 3, 3) rotation in the base frame of the link that a joint (from 0) moves."""
        rotations = np.empty((len(q), 3, 3))
        for k in range(len(q)):
            pin.forwardKinematics(self._model, self._data, q[k])
            rotations[k] = self._data.oMi[link + 1].rotation
        return rotations

    def link_poses(self, q: np.ndarray, link: str) -> np.ndarray:
        """(S, 4, 4) pose of a URDF link's frame in the base frame."""
        return self._poses(q, frame_id(self._model, link))

    def _poses(self, q: np.ndarray, frame: int) -> np.ndarray:
        poses = np.empty((len(q), 4, 4))
        for k in range(len(poses)):
            pin.forwardKinematics(self._model, self._data, q[k])
            poses[k] = pin.updateFramePlacement(self._model, self._data, frame).homogeneous
        return poses


def pinocchio_model(robot: RobotDescription, tool: Tool | None = None) -> pin.Model:
    """The arm in Pinocchio's terms: the joints of the description in order, others held, no rotors, no geometry.

    Raises:
        InputError: a URDF that Pinocchio refuses, or joints that are not one serial chain in the order given.
    """
    try:
        full = _rigid_bodies(robot.urdf)
    except Exception as error:  # Pinocchio raises several kinds, all of them the URDF's fault
        raise InputError(f"robot {robot.name}: the URDF cannot be used: {error}") from None
    locked = [full.getJointId(name) for name in list(full.names)[1:] if name not in robot.joint_names]
    model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else pin.Model(full)
    names = tuple(list(model.names)[1:])
    if names != robot.joint_names:
        raise InputError(
            f"robot {robot.name}: joints: the chain of the URDF is {', '.join(names)}; "
            f"list them in that order, not {', '.join(robot.joint_names)}"
        )
    if any(model.parents[k + 1] != k for k in range(model.njoints - 1)):
        raise InputError(f"robot {robot.name}: the joints are not one serial chain")
    model.gravity.linear = np.array(robot.gravity)
    model.armature = np.zeros(model.nv)
    if tool is not None and tool.mass > 0:
        frame = model.frames[frame_id(model, robot.tip_frame)]
        lever = np.zeros(3) if tool.centre_of_mass is None else np.asarray(tool.centre_of_mass, dtype=float)
        centre = tool.frame[:3, :3] @ lever + tool.frame[:3, 3]
        inertia = pin.Inertia(tool.mass, centre, np.zeros((3, 3)))
        model.inertias[frame.parentJoint] += frame.placement.act(inertia)
    return model


def frame_id(model: pin.Model, name: str) -> int:
    """Index of the frame of a link or, if no link has this name, of a joint: one of each may be called the same."""
    kinds = (pin.FrameType.BODY, pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT)
    return next(model.getFrameId(name, kind) for kind in kinds if model.existFrame(name, kind))


@lru_cache(maxsize=16)
def _rigid_bodies(urdf: str) -> pin.Model:
    return pin.buildModelFromXML(_without_meshes(urdf))


def _without_meshes(urdf: str) -> str:
    """Drop visual and collision geometry, give continuous joints one coordinate, and the robot a name."""
    tree = ElementTree.fromstring(urdf)
    tree.set("name", tree.get("name") or "robot")
    for link in tree.findall("link"):
        for kind in ("visual", "collision"):
            for geometry in link.findall(kind):
                link.remove(geometry)
    for joint in tree.findall("joint"):
        if joint.get("type") == "continuous":
            joint.set("type", "revolute")
        if joint.get("type") in ("revolute", "prismatic"):
            limit = joint.find("limit")
            if limit is None:
                limit = ElementTree.SubElement(joint, "limit")
            for key, value in (("lower", "-1e9"), ("upper", "1e9"), ("velocity", "1e9"), ("effort", "1e9")):
                limit.set(key, value)
    return ElementTree.tostring(tree, encoding="unicode")
