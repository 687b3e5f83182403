"""A machine on a day: the world's arm with what effects change of it, moved in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np

from second_world.arms import row
from second_world.kernel import step
from second_world.motions import RATE, Motions
from second_world.world import DrawnWorld

_STEPS = 2  # of the simulation a set-point
_DT = 1.0 / (RATE * _STEPS)
_PAUSE = 5.0  # s between motions
_STANDARD = 9.80665
_MEAN = 5  # samples that a change of torque is averaged over

#: Changes the signals (3, S, n) that are reported, positions, velocities and torques, of a motion that began at t [s].
Report = Callable[[np.ndarray, float], np.ndarray]


@dataclass(frozen=True)
class AddedBody:
    """A mass bolted to a link: kg, m and principal moments [kg·m²] in the link's frame."""

    link: int
    mass: float
    place: np.ndarray
    moments: np.ndarray


@dataclass(frozen=True)
class Push:
    """A force [N] on a link: (elapsed share of a motion, position and velocity (3,) of the link) → (3,)."""

    link: int
    force: Callable[[float, np.ndarray, np.ndarray], np.ndarray]


@dataclass(eq=False)
class DrawnMachine:
    """Parameters of a world that effects may change; n joints.

    `wrist_inertia` (first, second, ratio, inertia [kg·m²]) turns at the speed v[second] + ratio · v[first];
    `base` (stiffness [N·m/rad], damping) is what the base gives way by, about x and y. `gravity` says where
    down is at a time [s]. `path` changes the set-points of a motion before they are executed.
    """

    world: DrawnWorld
    mass: np.ndarray = field(init=False)
    centre: np.ndarray = field(init=False)
    inertia: np.ndarray = field(init=False)
    friction: np.ndarray = field(init=False)
    servo: np.ndarray = field(init=False)
    gears: np.ndarray = field(init=False)
    terms: list[list[float]] = field(init=False)
    pairs: list[list[float]] = field(default_factory=list)
    bodies: list[AddedBody] = field(default_factory=list)
    pushes: list[Push] = field(default_factory=list)
    reports: list[Report] = field(default_factory=list)
    wrist_inertia: tuple[int, int, float, float] | None = None
    base: tuple[float, float] | None = None
    gravity: Callable[[float], np.ndarray] | None = None
    path: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        arm = self.world.arm
        self.mass, self.centre, self.inertia = arm.mass.copy(), arm.centre.copy(), arm.inertia.copy()
        self.friction, self.servo = self.world.friction_rows.copy(), self.world.servo_rows.copy()
        self.gears = np.zeros((arm.n, 5))
        self.terms = self.world.terms.tolist()

    def drift(self, day: int) -> None:
        """A healthy machine is a little different every day."""
        rng = np.random.default_rng(np.random.SeedSequence([self.world.machine, 6, day]))
        n = self.world.arm.n
        self.friction[:, 1] *= rng.normal(1.0, 0.01, n)
        self.friction[:, 4] *= rng.normal(1.0, 0.02, n)
        self.servo[:, 9] += 5e-4 * self.world.arm.torque * rng.normal(size=n)

    def add(self, kind: int, joint: int, size: float, *numbers: float) -> None:
        """A term of `second_world.kernel.Kind`."""
        self.terms.append([float(kind), float(joint), size, *numbers, *[0.0] * (5 - len(numbers))])

    @property
    def effective_inertia(self) -> np.ndarray:
        """(n,) [kg·m²] that each joint sees at zero, all others held, rotor included."""
        model = mujoco.MjModel.from_xml_string(_mjcf(DrawnMachine(self.world)))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        return np.diag(full).copy()

    def run(self, motions: Motions) -> dict[str, np.ndarray]:
        """(3, S, n) reported position, velocity and torque of each motion, at `RATE`, without noise.

        Warm parts stay warm from one motion to the next.
        """
        simulation = _Simulation(self)
        reported = {}
        for name, (set_points, _) in motions.items():
            began = simulation.time
            signals = simulation.move(self.executed(set_points))
            for report in self.reports:
                signals = report(signals, began)
            reported[name] = signals
            simulation.time += _PAUSE
        return reported

    def executed(self, set_points: np.ndarray) -> np.ndarray:
        """(S, n) set-points that are really executed, as many as are planned."""
        return set_points if self.path is None else self.path(set_points)


class _Simulation:
    def __init__(self, machine: DrawnMachine):
        self._machine = machine
        arm = machine.world.arm
        self._model = model = mujoco.MjModel.from_xml_string(_mjcf(machine))
        self._data = mujoco.MjData(model)
        self._index = np.array([model.joint(name).id for name in arm.joint_names])  # every joint has one coordinate
        self._links = [model.body(f"link_{k}").id for k in range(arm.n)]
        self._servo = machine.servo.copy()
        self._servo[:, 1:5] *= machine.effective_inertia[:, None]
        self._servo[:, 6] = -np.expm1(-self._servo[:, 6] * _DT)
        self._terms = np.array(machine.terms, dtype=float).reshape(-1, 8)
        self._pairs = np.array(machine.pairs, dtype=float).reshape(-1, 5)
        self._x = np.zeros((arm.n, 16))
        self._states = np.zeros((len(self._terms) + len(self._pairs), 4))
        self.time = 0.0

    def move(self, q_ref: np.ndarray) -> np.ndarray:
        model, data, index = self._model, self._data, self._index
        mujoco.mj_resetData(model, data)
        data.qpos[index] = q_ref[0] - self._servo[:, 7]
        warm = self._x[:, 3].copy()
        self._x[:] = 0.0
        self._x[:, 3] = warm
        qd_ref = np.gradient(q_ref, 1 / RATE, axis=0)
        targets = np.stack([q_ref, qd_ref, np.gradient(qd_ref, 1 / RATE, axis=0)], axis=1)
        steps = np.arange(_STEPS * len(q_ref)) / _STEPS
        before = np.minimum(steps.astype(int), len(q_ref) - 2)
        share = (steps - before)[:, None, None]
        targets = (1 - share) * targets[before] + share * targets[before + 1]
        self._settle(targets[0])
        samples, n = q_ref.shape
        out = np.empty((samples, 3, n))
        spare = np.empty((3, n))
        qpos, qvel, bias, applied = data.qpos, data.qvel, data.qfrc_bias, data.qfrc_applied
        constant = self._servo, self._machine.friction, self._machine.gears, self._terms, self._pairs
        outside = bool(self._machine.pushes) or self._machine.gravity is not None
        for k in range(samples):
            for half in range(_STEPS):
                mujoco.mj_step1(model, data)
                if outside:
                    self._push(k / samples)
                step(
                    self.time,
                    _DT,
                    index,
                    qpos,
                    qvel,
                    bias,
                    applied,
                    targets[_STEPS * k + half],
                    *constant,
                    self._x,
                    self._states,
                    out[k] if half == 0 else spare,
                )
                mujoco.mj_step2(model, data)
                self.time += _DT
        return np.ascontiguousarray(out.transpose(1, 0, 2))

    def _settle(self, target: np.ndarray) -> None:
        """The servo holds the arm as at the end of a long rest: the integral carries what it has to."""
        mujoco.mj_forward(self._model, self._data)
        bias = self._data.qfrc_bias[self._index]
        self._x[:, 1] = bias
        self._x[:, 4] = bias
        self._x[:, 0] = np.where(self._servo[:, 4] > 0, bias * (1 - self._servo[:, 0]), 0.0)
        sag = np.where(self._servo[:, 4] > 0, 0.0, bias * (1 - self._servo[:, 0]) / self._servo[:, 2])
        self._data.qpos[self._index] = target[0] - self._servo[:, 7] - sag
        gears = self._machine.gears
        for k in np.flatnonzero(gears[:, 0]):
            self._x[k, 7:10] = self._data.qpos[self._index[k]] + bias[k] / gears[k, 1], 0.0, 1.0

    def _push(self, share: float) -> None:
        machine, data = self._machine, self._data
        if machine.gravity is not None:
            self._model.opt.gravity[:] = _STANDARD * machine.gravity(self.time)
        for push in machine.pushes:
            body = self._links[push.link]
            spin = np.zeros(6)
            mujoco.mj_objectVelocity(self._model, data, mujoco.mjtObj.mjOBJ_BODY, body, spin, 0)
            data.xfrc_applied[body, :3] = push.force(share, data.xipos[body], spin[3:])


def _mjcf(machine: DrawnMachine) -> str:
    arm = machine.world.arm
    parts = [
        f'<mujoco><option timestep="{_DT}" integrator="implicitfast" gravity="0 0 {-_STANDARD}">'
        '<flag contact="disable"/></option><worldbody>'
    ]
    if machine.base is not None:
        stiffness, damping = machine.base
        give = "".join(
            f'<joint name="base_{axis}" axis="{at}" stiffness="{stiffness:.9g}" damping="{damping:.9g}"/>'
            for axis, at in (("x", "1 0 0"), ("y", "0 1 0"))
        )
        plate = float(arm.mass[0])
        parts.append(
            f'<body name="base">{give}<inertial pos="0 0 0" mass="{plate:.9g}" '
            f'diaginertia="{row(np.full(3, 0.05 * plate))}"/>'
        )
    for k in range(arm.n):
        armature = 0.0 if machine.gears[k, 0] else arm.rotor[k]
        parts.append(
            f'<body name="link_{k}" pos="{row(arm.origin[k])}"><joint name="{arm.joint_names[k]}" '
            f'axis="{row(arm.axes[k])}" armature="{armature:.9g}"/><inertial pos="{row(machine.centre[k])}" '
            f'mass="{machine.mass[k]:.9g}" diaginertia="{row(machine.inertia[k])}"/>'
        )
        parts += [
            f'<body pos="{row(body.place)}"><inertial pos="0 0 0" mass="{body.mass:.9g}" '
            f'diaginertia="{row(body.moments)}"/></body>'
            for body in machine.bodies
            if body.link == k
        ]
    parts.append("</body>" * (arm.n + (machine.base is not None)) + "</worldbody>")
    if machine.wrist_inertia:
        first, second, ratio, inertia = machine.wrist_inertia
        parts.append(
            f'<tendon><fixed armature="{inertia:.9g}"><joint joint="{arm.joint_names[first]}" coef="{ratio:.9g}"/>'
            f'<joint joint="{arm.joint_names[second]}" coef="1"/></fixed></tendon>'
        )
    return "".join([*parts, "</mujoco>"])


def largest_change(first: dict[str, np.ndarray], second: dict[str, np.ndarray], nominal: np.ndarray) -> float:
    """Largest root mean square change of torque over nominal, by motion and joint, smoothed over 5 ms."""
    largest = 0.0
    for name, signals in first.items():
        length = min(len(signals[2]), len(second[name][2]))
        change = np.cumsum((signals[2, :length] - second[name][2, :length]) / nominal, axis=0)
        rms = np.sqrt(np.mean(((change[_MEAN:] - change[:-_MEAN]) / _MEAN) ** 2, axis=0))
        largest = max(largest, float(rms.max()))
    return largest
