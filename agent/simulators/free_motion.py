"""A simulator's free motion: MuJoCo runs an MJCF under the recorded set-points, with its own servos.

(I + Iₐ) q̈ + d q̇ + F sgn q̇ + g(q) + k (q − q₀) = clip(kₚ (clip(r(t − τ)) + b − q) − k_v q̇)

The command r acts late by τ, limits of set-point and force after that. A command that is held from frame to frame
enters every step as its mean over that step, so the motion is a smooth function of τ.

Damping is explicit here, and h d / 2 of armature are added to a step of h: the trapezoidal rule, which has second order
and is stable. MuJoCo's implicit damping is early by half a step, which counts as inertia (`added_inertia`), and it does
not let friction stop a joint within a step.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from agent.core import InputError
from agent.model import pseudo_inertia
from agent.simulators.arm import SimulatedArm
from agent.simulators.mjcf import compiled, mujoco_package, without_warnings
from agent.simulators.servos import PositionServos

LOST = 1e3  # rad/s or m/s: a simulator that has blown up
_HOLD = 1e6  # armature that holds a joint that is not compared, over the arm's mass
_COARSEST = 2e-3  # s, of a step; the file's own where that is shorter


@dataclass(frozen=True, eq=False)
class ServoNumbers:
    """Numbers of n joints and their servos, (n,) each, on the joint side.

    armature [kg·m²], damping [N·m·s/rad] of joint and servo (kv) together, friction [N·m] (Coulomb), kp [N·m/rad],
    stiffness [N·m/rad] of a spring at the joint, as cables are, about the file's rest, delay [s] from the recorded
    command to the servo, offset [rad] b at which the servo stands off its set-point.
    """

    armature: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    kp: np.ndarray
    stiffness: np.ndarray
    delay: np.ndarray
    offset: np.ndarray

    @classmethod
    def of(cls, arm: SimulatedArm) -> ServoNumbers:
        """Those of a file."""
        servos = servos_of(arm)
        return cls(
            arm.armature.copy(),
            arm.damping + servos.damping,
            arm.frictionloss.copy(),
            servos.stiffness.copy(),
            arm.stiffness.copy(),
            servos.delay.copy(),
            servos.offset.copy(),
        )

    @property
    def table(self) -> np.ndarray:
        """(7, n) in the order of the fields."""
        return np.stack([getattr(self, each.name) for each in fields(self)])

    @classmethod
    def of_table(cls, table: np.ndarray) -> ServoNumbers:
        """From (7, n) in the order of the fields."""
        return cls(*np.array(table, dtype=float))

    @property
    def possible(self) -> ServoNumbers:
        """The nearest numbers that can be: none is below zero but an offset."""
        return replace(self, **{kind: np.maximum(getattr(self, kind), 0.0) for kind in KINDS if kind != "offset"})


#: Kinds of numbers, in the order of `ServoNumbers.table`.
KINDS = tuple(each.name for each in fields(ServoNumbers))


@dataclass(frozen=True, eq=False)
class RecordedCommand:
    """Set-points (S, n) [rad or m] recorded at times (S,) [s]; `held` until the next one, or else smooth between.

    Smooth is a cubic with Akima's slopes: straight lines between frames take (ω h)² / 12 off a motion at ω, 3 % at 3 Hz
    and 30 frames a second, which armature and damping then make up for; a spline would overshoot at a step.
    """

    time: np.ndarray
    set_points: np.ndarray
    held: bool

    @cached_property
    def _smooth(self) -> Akima1DInterpolator:
        return Akima1DInterpolator(self.time, self.set_points, method="makima")

    def between(self, edges: np.ndarray, delay: np.ndarray) -> np.ndarray:
        """(T, n) its mean between `edges` (T + 1,) [s] as it arrives, late by `delay` (n,) [s]."""
        if not self.held:
            middle = (edges[1:] + edges[:-1]) / 2
            first, last = self.time[0], self.time[-1]
            at = {late: self._smooth(np.clip(middle - late, first, last)) for late in set(delay.tolist())}
            return np.stack([at[late][:, j] for j, late in enumerate(delay.tolist())], axis=1)
        ends = np.append(self.time, self.time[-1] + np.median(np.diff(self.time)))
        area = np.concatenate([np.zeros((1, len(delay))), np.cumsum(self.set_points * np.diff(ends)[:, None], axis=0)])
        means = np.empty((len(edges) - 1, len(delay)))
        for j, late in enumerate(delay):
            at, first, last = edges - late, self.set_points[0, j], self.set_points[-1, j]
            outside = first * np.minimum(at - ends[0], 0.0) + last * np.maximum(at - ends[-1], 0.0)
            means[:, j] = np.diff(np.interp(at, ends, area[:, j]) + outside) / np.diff(edges)
        return means


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A simulated motion at times (T,) [s] in steps; q, qd, qdd, torque of the servos, r as it reached them: (T, n).

    `stuck` (T, n) bool: friction holds the joint; `limited` (T, n): the servo is at its limit.
    """

    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray
    command: np.ndarray
    stuck: np.ndarray
    limited: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """(S, n) positions at times (S,) [s]."""
        return np.stack([np.interp(times, self.time, column) for column in self.q.T], axis=1)


def servos_of(arm: SimulatedArm) -> PositionServos:
    """The servos of a file.

    Raises:
        InputError: it has none for each joint.
    """
    if isinstance(arm.servos, PositionServos):
        return arm.servos
    raise InputError(f"{arm.path}: it has no position servo for each joint: {arm.servos}")


class FreeSimulator:
    """An MJCF that moves under set-points, with other numbers than its own where wanted."""

    def __init__(self, arm: SimulatedArm):
        self.arm, self.servos = arm, servos_of(arm)
        from mujoco.rollout import Rollout

        self._mujoco = mujoco = mujoco_package()
        self._rollout = Rollout(nthread=0).rollout
        self.model = model = copy(arm.model)
        self._at = np.array([int(model.joint(name).qposadr[0]) for name in arm.file_joints])
        self._dof = np.array([int(model.joint(name).dofadr[0]) for name in arm.file_joints])
        self._joints = [int(model.joint(name).id) for name in arm.file_joints]
        locked = np.setdiff1d(np.arange(model.nv), self._dof)
        model.dof_armature[locked] = _HOLD * max(float(model.body_mass.sum()), 1.0)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        others = np.setdiff1d(np.arange(model.nu), self.servos.actuators)
        model.actuator_gainprm[others] = model.actuator_biasprm[others] = 0.0
        if hasattr(model, "actuator_delay"):
            model.actuator_delay[:] = 0.0  # the command is late already
        model.opt.timestep = self.step = min(float(model.opt.timestep), _COARSEST)
        self._integrator = int(model.opt.integrator)
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)

    def colliding(self, positions: np.ndarray) -> tuple[tuple[str, str], ...]:
        """Names of pairs of bodies that touch where the joints are at `positions` (S, n)."""
        mujoco, model = self._mujoco, self.model
        data, pairs = mujoco.MjData(model), set()
        for q in positions:
            data.qpos[self._at] = q
            mujoco.mj_fwdPosition(model, data)
            contact = data.contact
            for geoms in contact.geom[contact.dist < contact.includemargin]:
                pairs.add(tuple(sorted(model.body(int(model.geom_bodyid[geom])).name for geom in geoms)))
        return tuple(sorted(pair for pair in pairs if all(pair)))

    def excluding(self, pairs: tuple[tuple[str, str], ...]) -> FreeSimulator:
        """The same arm, with pairs of bodies that pass through each other."""
        excluded = (*self.arm.excluded, *pairs)
        return FreeSimulator(replace(self.arm, excluded=excluded, model=compiled(self.arm.path, excluded)))

    def without_contacts(self, pairs: tuple[tuple[str, str], ...] = ()) -> FreeSimulator:
        """The same where only these `pairs` would touch, so that contacts need not be looked for."""
        model = copy(self.arm.model)
        model.opt.disableflags |= int(self._mujoco.mjtDisableBit.mjDSBL_CONTACT)
        return FreeSimulator(replace(self.arm, excluded=(*self.arm.excluded, *pairs), model=model))

    def carrying(self, load: np.ndarray) -> FreeSimulator:
        """The same arm with a load: standard parameters (10,) that its link gains; as it is where no body has them."""
        body = self.arm.carrying[self.arm.robot.load_link]
        loaded, model = copy(self), copy(self.model)
        index, back = model.body(body.name).id, np.linalg.inv(body.pose)
        matrix = np.empty(9)
        self._mujoco.mju_quat2Mat(matrix, model.body_iquat[index])
        mass, centre, rotation = model.body_mass[index], model.body_ipos[index], matrix.reshape(3, 3)
        spread = rotation @ np.diag(0.5 * model.body_inertia[index].sum() - model.body_inertia[index]) @ rotation.T
        own = np.block([[spread + mass * np.outer(centre, centre), mass * centre[:, None]], [mass * centre, mass]])
        whole = own + back @ pseudo_inertia(load) @ back.T
        mass, centre = whole[3, 3], whole[:3, 3] / whole[3, 3]
        values, axes = np.linalg.eigh(whole[:3, :3] - mass * np.outer(centre, centre))
        if mass <= 0 or values[0] <= 0:
            return self
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        model.body_mass[index], model.body_ipos[index] = mass, centre
        model.body_inertia[index] = values.sum() - values
        quaternion = np.empty(4)
        self._mujoco.mju_mat2Quat(quaternion, axes.ravel())
        model.body_iquat[index] = quaternion
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))
        loaded.model = model
        return loaded

    def holding(self) -> FreeSimulator:
        """The same arm whose friction holds a stationary joint as real friction does, where MuJoCo's gives way."""
        firm, model = copy(self), copy(self.model)
        model.dof_solimp[self._dof, 0] = self._mujoco.mjMAXIMP
        model.dof_solref[self._dof] = 2 * self.step, 1.0  # stops within a step
        firm.model, firm.arm = model, replace(self.arm, impedance=np.array(model.dof_solimp[self._dof, 0]))
        firm.__dict__.pop("creep", None)
        return firm

    @cached_property
    def creep(self) -> np.ndarray:
        """(n,) [1/s] damping over inertia of a joint that friction holds: MuJoCo's friction is a soft constraint.

        With impedance d, f = −d / (1 − d) M (a + b v): a stationary joint gives way at v = −f (1 − d) / (d b M).
        """
        model = self.model
        impedance = np.clip(model.dof_solimp[self._dof, 0], 1e-4, 1 - 1e-4)
        first, second = model.dof_solref[self._dof].T
        rate = np.where(first > 0, 2 / np.maximum(model.dof_solimp[self._dof, 1] * first, 1e-9), -second)
        return np.asarray(rate * impedance / (1 - impedance))

    def added_inertia(self, numbers: ServoNumbers) -> np.ndarray:
        """(n,) [kg·m²] that a step of the file's own integrator adds: implicit damping is early, explicit late."""
        kinds, own = self._mujoco.mjtIntegrator, self._servos(numbers).damping
        implicit = {
            kinds.mjINT_IMPLICIT: numbers.damping,
            kinds.mjINT_IMPLICITFAST: numbers.damping,
            kinds.mjINT_EULER: numbers.damping - 2 * own,
        }
        return np.asarray(0.5 * self.step * implicit.get(self._integrator, np.zeros(len(own))))

    @cached_property
    def numbers(self) -> ServoNumbers:
        """Those of the file."""
        return ServoNumbers.of(self.arm)

    @without_warnings()  # the answer says what blows up
    def run(
        self,
        numbers: ServoNumbers,
        command: RecordedCommand,
        start: tuple[float, np.ndarray, np.ndarray],
        until: float,
        push: np.ndarray | None = None,
    ) -> FreeMotion | None:
        """The motion from a state (time [s], q (n,), q̇ (n,)) on; `push` (T, n) [N·m] acts on the joints in addition.

        None where the simulation blows up.
        """
        begin, q, qd = start
        count = int(np.ceil((until - begin) / self.step - 1e-6)) + 1
        time = begin + self.step * np.arange(count)
        model = self._set(numbers)
        # a control is that of the step's start, as where the actuator has the delay; its mean around is smooth in it
        asked = command.between(np.append(time, time[-1] + self.step) - 0.5 * self.step, numbers.delay)
        inputs = np.zeros((count, model.nu))
        inputs[:, list(self.servos.inputs)] = self._servos(numbers).controls(asked)
        kinds = self._mujoco.mjtState
        spec = int(kinds.mjSTATE_CTRL)
        if push is not None:
            spec |= int(kinds.mjSTATE_QFRC_APPLIED)
            forces = np.zeros((count, model.nv))
            forces[:, self._dof] = push[:count]
            inputs = np.hstack([inputs, forces])
        data = self._mujoco.MjData(model)
        data.qpos[self._at], data.qvel[self._dof] = q, qd
        state = np.empty(self._mujoco.mj_stateSize(model, kinds.mjSTATE_FULLPHYSICS))
        self._mujoco.mj_getState(model, data, state, kinds.mjSTATE_FULLPHYSICS)
        after, _ = self._rollout([model], [data], state[None], inputs[None], control_spec=spec)
        states = np.concatenate([state[None], after[0]])
        position, speed = states[:, 1 + self._at], states[:, 1 + model.nq + self._dof]
        if not np.all(np.abs(speed) < LOST):
            return None
        torque = self._servos(numbers).torque(asked, position[:-1], speed[:-1])
        low, high = self.servos.low, self.servos.high
        sticking = np.abs(speed[:-1]) < numbers.friction / np.maximum(self.creep * self._inertia(numbers, data), 1e-12)
        return FreeMotion(
            time,
            position[:-1],
            speed[:-1],
            np.diff(speed, axis=0) / self.step,
            np.clip(torque, low, high),
            asked,
            sticking,
            (torque >= high) | (torque <= low),
        )

    def _servos(self, numbers: ServoNumbers) -> PositionServos:
        kv = np.minimum(self.servos.damping, numbers.damping)
        return replace(self.servos, stiffness=numbers.kp, damping=kv, offset=numbers.offset)

    def _inertia(self, numbers: ServoNumbers, data: Any) -> np.ndarray:
        """(n,) [kg·m²] that each joint moves at the state that `data` began with."""
        self._mujoco.mj_forward(self.model, data)
        mass = np.zeros((self.model.nv, self.model.nv))
        self._mujoco.mj_fullM(self.model, data, mass)
        return np.diag(mass)[self._dof]

    def _set(self, numbers: ServoNumbers) -> Any:
        """The compiled model with these numbers; what damping is less than the file's kv comes off the servo's."""
        model, own = self.model, self.servos
        model.dof_armature[self._dof] = numbers.armature + 0.5 * self.step * numbers.damping
        model.dof_frictionloss[self._dof] = numbers.friction
        model.jnt_stiffness[self._joints] = numbers.stiffness
        servos = self._servos(numbers)
        model.dof_damping[self._dof] = numbers.damping - servos.damping
        for j, actuator in enumerate(own.actuators):
            gain, bias = servos.parameters(j)
            model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, :3] = gain, bias
        self._mujoco.mj_setConst(model, self._mujoco.MjData(model))  # MuJoCo keeps the inertia of an arm of one joint
        return model
