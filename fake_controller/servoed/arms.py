"""Drawn arms with position servos, and the MJCF file that describes each as if it had no effect."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from agent.robot import Dynamics, RobotDescription, load_robot
from fake_controller.actuation.friction import FrictionCurve
from fake_controller.actuation.machine import Machine, poses

GRAVITY = 9.81
_FRACTION_OF_RATE = 700.0  # rad/s that bristles may swing at, so that steps can follow them
_STEP = 0.002  # s, of the simulation that the file asks for
_STOP = 0.3  # rad beyond the range of commands, where a joint ends


@dataclass(frozen=True)
class ArmKind:
    """What arms of a kind have in common; pairs are the lowest and highest value that is drawn.

    `joints` least and most; `axes` in order; `length` [m], `mass` [kg] of a link, halved towards the tip as is the
    inertia of the `rotor` [kg·m²]; natural `frequency` [Hz] and `ratio` of damping of the servos; `friction` [rad] over
    kp; `presliding` [rad]; `encoder` steps a turn; `lag` [s] of the current loop; `on_link`: share of arms whose
    encoders are behind the gears.
    """

    name: str
    joints: tuple[int, int]
    axes: str
    length: tuple[float, float]
    mass: tuple[float, float]
    rotor: tuple[float, float]
    frequency: tuple[float, float]
    ratio: tuple[float, float]
    friction: tuple[float, float]
    presliding: tuple[float, float]
    encoder: float
    lag: tuple[float, float]
    on_link: float


KINDS = (
    ArmKind(
        "hobby", (3, 6), "zyyyxy", (0.06, 0.14), (0.06, 0.25), (0.01, 0.04), (1.8, 4.5), (0.6, 1.1),
        (0.004, 0.03), (1e-4, 5e-4), 4096.0, (5e-4, 3e-3), 1.0,
    ),
    ArmKind(
        "middle", (5, 7), "zyyxyxz", (0.15, 0.35), (0.8, 4.0), (0.1, 0.6), (3.5, 8.0), (0.7, 1.2),
        (8e-4, 5e-3), (2e-5, 1e-4), 2.0**16, (3e-4, 1.5e-3), 0.5,
    ),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class DrawnArm:
    """An arm and its servos, n joints, arrays (n,) unless said; SI on the joint side.

    origin (n, 3) of each joint in the link before, axes, mass, centre (n, 3), inertia (n, 3) about it; start and half
    of the range [rad]; armature, coulomb, viscous, kp, kv, limit [N·m], top speed of the motors [rad/s], the `lag` [s]
    of the current loop, `late` [s] from a command to it, `encoder` step [rad], whether it is `on_link`; `offset` (n,)
    [rad] at which servos stand off their set-points.
    """

    kind: ArmKind
    origin: np.ndarray
    axes: np.ndarray
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    start: np.ndarray
    half: np.ndarray
    armature: np.ndarray
    curves: tuple[FrictionCurve, ...]
    kp: np.ndarray
    kv: np.ndarray
    limit: np.ndarray
    top_speed: np.ndarray
    load: np.ndarray
    lag: float
    late: float
    encoder: float
    on_link: bool
    offset: np.ndarray

    @property
    def names(self) -> list[str]:
        """Of the joints."""
        return [f"joint_{k + 1}" for k in range(len(self.mass))]

    @property
    def coulomb(self) -> np.ndarray:
        """(n,) [N·m]."""
        return np.array([curve.coulomb for curve in self.curves])

    @property
    def numbers(self) -> dict[str, np.ndarray]:
        """What a file of this arm says, by the names that a diagnosis has for it.

        A torque that is late by the lag l of the current loop, kp (r(t - l) - q(t - l)) - kv q̇(t - l), is a delay of
        the command, and to first order in l less damping by kp l and less armature by kv l.
        """
        damping = self.kv - self.kp * self.lag + np.array([curve.viscous for curve in self.curves])
        armature, delay = self.armature - self.kv * self.lag, np.full(len(self.kp), self.late + self.lag)
        numbers = {"kp": self.kp, "damping": damping, "armature": armature, "friction": self.coulomb}
        return {**numbers, "delay_s": delay, "offset": self.offset}

    def mjcf(self) -> str:
        """The file that a user of MuJoCo has of the arm without effects."""
        numbers, delay = self.numbers, round(self.late + self.lag, 4)
        late = f'delay="{delay}" nsample="{int(np.ceil(delay / _STEP)) + 1}"'
        bodies, servos = [], []
        for k, name in enumerate(self.names):
            armature, friction, damping = (numbers[kind][k] for kind in ("armature", "friction", "damping"))
            low, high = self.start[k] - self.half[k], self.start[k] + self.half[k]
            bodies += [
                f'<body name="link_{k + 1}" pos="{_row(self.origin[k])}">',
                f'<joint name="{name}" axis="{_row(self.axes[k])}" range="{low - _STOP:.4g} {high + _STOP:.4g}"',
                f'damping="{self.curves[k].viscous:.4g}" armature="{armature:.4g}"',
                f'frictionloss="{friction:.4g}"/><inertial mass="{self.mass[k]:.6g}"',
                f'pos="{_row(self.centre[k])}" diaginertia="{_row(self.inertia[k])}"/>',
            ]
            kv = damping - self.curves[k].viscous
            servos += [
                f'<position name="{name}" joint="{name}" kp="{self.kp[k]:.4g}" kv="{kv:.4g}" {late}',
                f'ctrlrange="{low:.4g} {high:.4g}" forcerange="{-self.limit[k]:.4g} {self.limit[k]:.4g}"/>',
            ]
        head = [
            '<mujoco model="arm"><compiler angle="radian" autolimits="true"/>',
            f'<option timestep="{_STEP}" integrator="implicitfast" gravity="0 0 {-GRAVITY}"/><worldbody>',
        ]
        middle = [f"{'</body>' * len(self.names)}</worldbody><actuator>"]
        end = [f'</actuator><keyframe><key name="home" qpos="{_row(self.start)}"/></keyframe></mujoco>', ""]
        return "\n".join([*head, *bodies, *middle, *servos, *end])

    def machine(self) -> Machine:
        """As the plant has it."""
        robot = _robot(self)
        dynamics = Dynamics(robot)
        return Machine(
            robot=robot,
            parameters=dynamics.standard_parameters(),
            rotor_inertias=self.armature.copy(),
            gravity=np.array([0.0, 0.0, -GRAVITY]),
            coupling=np.eye(robot.dof),
            friction=list(self.curves),
            nominal=0.4 * self.limit,
            limit=self.limit,
            typical_inertia=_typical(dynamics, robot) + self.armature,
        )


def draw_arm(seed: int) -> DrawnArm:
    """The arm of a number; every other one is a hobby arm."""
    rng = np.random.default_rng([seed, 21])
    kind = KINDS[seed % len(KINDS)]
    n = int(rng.integers(kind.joints[0], kind.joints[1] + 1))
    smaller = 0.5 ** np.linspace(0, 1, n)
    axes = np.array([[axis == b for b in "xyz"] for axis in kind.axes[:n]], dtype=float)
    direction = np.stack([rng.uniform(0.3, 1.0, n), rng.uniform(-0.2, 0.2, n), rng.uniform(-0.5, 1.0, n)], axis=1)
    direction[0] = 0.0, 0.0, 1.0
    length = rng.uniform(*kind.length, n) * np.sqrt(smaller)
    out = length[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.vstack([[0.0, 0.0, 0.5 * length[0]], out[:-1]])
    mass = rng.uniform(*kind.mass, n) * smaller
    squares = (np.abs(out) + length[:, None] * rng.uniform(0.3, 0.6, (n, 3))) ** 2
    inertia = mass[:, None] / 12 * (squares.sum(axis=1, keepdims=True) - squares)
    armature = rng.uniform(*kind.rotor, n) * smaller
    half = rng.uniform(1.1, 1.7, n)
    none = np.zeros(n)
    bare = DrawnArm(
        kind, origin, axes, mass, 0.45 * out, inertia, rng.uniform(-0.3, 0.3, n), half, armature, (),
        none, none, none, none, none, 0.0, 0.0, 0.0, True, none,
    )  # fmt: skip
    robot = _robot(bare)
    dynamics = Dynamics(robot)
    whole = _typical(dynamics, robot) + armature
    postures = poses(robot, 64)
    load = np.abs(dynamics.inverse_dynamics(postures, np.zeros_like(postures), np.zeros_like(postures))).max(axis=0)
    kp = np.maximum((2 * np.pi * rng.uniform(*kind.frequency, n)) ** 2 * whole, load / 0.1)
    damping = 2 * rng.uniform(*kind.ratio, n) * np.sqrt(kp * whole)
    kv = damping * rng.uniform(0.3, 0.8, n)
    low, high = np.log(kind.friction).tolist()
    coulomb = kp * np.exp(rng.uniform(low, high, n))
    limit = (load + coulomb + 0.15 * kp) * rng.uniform(1.1, 1.6, n)
    stiffness = np.minimum(coulomb / rng.uniform(*kind.presliding, n), armature * _FRACTION_OF_RATE**2)
    rise, speed = coulomb * rng.uniform(0.0, 0.05, n), rng.uniform(0.01, 0.03, n)
    curves = tuple(
        FrictionCurve(level, rising, bent, viscous, 50.0, stiff)
        for level, rising, bent, viscous, stiff in np.column_stack(
            [coulomb, rise, speed, damping - kv, stiffness]
        ).tolist()
    )
    late = float(rng.choice([0.0, rng.uniform(0.002, 0.03)]))
    return replace(
        bare,
        curves=curves,
        kp=kp,
        kv=kv,
        limit=limit,
        top_speed=rng.uniform(6.0, 12.0, n),
        load=load,
        lag=float(rng.uniform(*kind.lag)),
        late=late,
        encoder=2 * np.pi / kind.encoder,
        on_link=bool(rng.random() < kind.on_link),
    )


def with_factor(arm: DrawnArm, joint: str, kp: float = 1.0, coulomb: float = 1.0, offset: float = 0.0) -> DrawnArm:
    """The arm with other times the servo gain and Coulomb friction of a joint, and an `offset` [rad] of its servo."""
    k = arm.names.index(joint)
    curves, gains, offsets = list(arm.curves), arm.kp.copy(), arm.offset.copy()
    curves[k], gains[k] = replace(curves[k], coulomb=coulomb * curves[k].coulomb), kp * gains[k]
    offsets[k] += offset
    return replace(arm, curves=tuple(curves), kp=gains, offset=offsets)


def _typical(dynamics: Dynamics, robot: RobotDescription) -> np.ndarray:
    """(n,) inertia of the links that each joint sees, over the workspace [kg·m²]."""
    return np.mean([np.diag(dynamics.mass_matrix(q)) for q in poses(robot, 32)], axis=0)


def _robot(arm: DrawnArm) -> RobotDescription:
    parts, parent = ['<robot name="arm"><link name="base"/>'], "base"
    for k, name in enumerate(arm.names):
        low, high = arm.start[k] - arm.half[k], arm.start[k] + arm.half[k]
        ixx, iyy, izz = arm.inertia[k]
        parts.append(
            f'<link name="link_{k + 1}"><inertial><origin xyz="{_row(arm.centre[k])}"/>'
            f'<mass value="{arm.mass[k]:.9g}"/>'
            f'<inertia ixx="{ixx:.9g}" iyy="{iyy:.9g}" izz="{izz:.9g}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="link_{k + 1}"/>'
            f'<origin xyz="{_row(arm.origin[k])}"/><axis xyz="{_row(arm.axes[k])}"/>'
            f'<limit lower="{low}" upper="{high}" velocity="6" effort="{2 + 4 * arm.limit[k]}"/></joint>'
        )
        parent = f"link_{k + 1}"
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "arm.urdf").write_text("".join([*parts, "</robot>"]), encoding="utf-8")
        path = Path(folder) / "robot.yaml"
        rows = [f"  - {{name: {k}, gear_ratio: 1, max_velocity: 6, max_acceleration: 60}}" for k in arm.names]
        head = ["name: arm", "urdf: arm.urdf", f"tip_frame: {parent}", f"gravity: [0, 0, {-GRAVITY}]", "joints:"]
        path.write_text("\n".join([*head, *rows]), encoding="utf-8")
        return load_robot(path)


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)
