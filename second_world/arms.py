"""Arms of four builds with proportions of their own: what MuJoCo simulates, and what a URDF tells of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

#: What a public URDF with placeholder inertials says of every link [kg].
PLACEHOLDERS = (0.01, 1.0, 3.0)


@dataclass(frozen=True)
class Build:
    """A kind of arm; rows are joints. At zero all frames are parallel. Origin [m] in the parent link, axis, mass [kg]
    of the link, nominal torque [N·m], highest speed [rad/s], rotor inertia on the joint side [kg·m²], gear ratio."""

    name: str
    origin: tuple[tuple[float, float, float], ...]
    axis: str
    mass: tuple[float, ...]
    torque: tuple[float, ...]
    speed: tuple[float, ...]
    rotor: tuple[float, ...]
    ratio: float


BUILDS = (
    Build(
        "ur_like",
        ((0, 0, 0.16), (0, 0.13, 0), (0.42, -0.1, 0), (0.39, 0, 0), (0, 0.09, 0), (0, 0, -0.09)),
        "zyyyzy",
        (7, 13, 4, 2, 2, 0.7),
        (90, 130, 60, 14, 10, 8),
        (2.0, 2.0, 3.0, 3.0, 3.0, 3.0),
        (1.2, 1.2, 0.7, 0.15, 0.12, 0.1),
        101.0,
    ),
    Build(
        "panda_like",
        ((0, 0, 0.33), (0, 0, 0), (0, 0, 0.32), (0.08, 0, 0), (-0.08, 0, 0.38), (0, 0, 0), (0.09, 0, 0)),
        "zyzyzyz",
        (4, 4, 3.5, 3.5, 3, 1.6, 1.1),
        (45, 60, 30, 30, 9, 8, 5),
        (2.0, 2.0, 2.2, 2.2, 2.6, 2.6, 2.6),
        (0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.15),
        100.0,
    ),
    Build(
        "ns16_like",
        ((0, 0, 0.45), (0.15, 0, 0), (0, 0, 0.65), (0.2, 0, 0.1), (0.4, 0, 0), (0.1, 0, 0)),
        "zyyxyx",
        (110, 60, 40, 12, 6, 2),
        (500, 800, 400, 60, 50, 30),
        (2.7, 2.6, 2.9, 5.0, 5.0, 6.0),
        (20, 25, 12, 1.2, 1.0, 0.6),
        140.0,
    ),
    Build(
        "tx40_like",
        ((0, 0, 0.32), (0, 0.04, 0), (0, 0, 0.23), (0, -0.03, 0.1), (0, 0, 0.13), (0, 0, 0.07)),
        "zyyzyz",
        (8, 6, 2.5, 1.5, 0.9, 0.3),
        (22, 28, 12, 3.5, 3, 1.8),
        (4.5, 4.0, 4.5, 6.0, 6.0, 7.0),
        (0.6, 0.6, 0.25, 0.05, 0.04, 0.03),
        75.0,
    ),
)


@dataclass
class Arm:
    """One individual. n joints, SI on the joint side; `inertia` (n, 3) are principal moments along the link's axes.

    `inside` are masses fixed to a link beside its own: (link, mass, place). `gear` is what gives way in a joint:
    joint -> (stiffness [N·m/rad], damping, dead zone [rad]); `wrist` (first, second, ratio, inertia, Coulomb, viscous)
    of a shaft that turns by the second joint and `ratio` times the first.
    """

    build: Build
    origin: np.ndarray
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    rotor: np.ndarray
    coulomb: np.ndarray
    viscous: np.ndarray
    travel: np.ndarray
    by_engine: bool
    gravity: np.ndarray
    range: np.ndarray
    described_mass: np.ndarray
    described_centre: np.ndarray
    inside: list[tuple[int, float, np.ndarray]] = field(default_factory=list)
    gear: dict[int, tuple[float, float, float]] = field(default_factory=dict)
    wrist: tuple[int, int, float, float, float, float] | None = None

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.mass)

    @property
    def torque(self) -> np.ndarray:
        """(n,) nominal [N·m]."""
        return np.array(self.build.torque)

    @property
    def speed(self) -> np.ndarray:
        """(n,) highest [rad/s]."""
        return np.array(self.build.speed)

    @property
    def axes(self) -> np.ndarray:
        """(n, 3)."""
        return np.array([[a == b for b in "xyz"] for a in self.build.axis], dtype=float)

    @property
    def joint_names(self) -> list[str]:
        """As in the description."""
        return [f"joint_{k + 1}" for k in range(self.n)]


def draw_arm(machine: int) -> Arm:
    """The individual of a seed."""
    rng = np.random.default_rng([machine, 5])
    build = BUILDS[machine % len(BUILDS)]
    n = len(build.mass)
    origin = np.array(build.origin, dtype=float) * rng.uniform(0.8, 1.2, (n, 1))
    mass = np.array(build.mass) * rng.uniform(0.8, 1.2, n)
    out = np.vstack([origin[1:], 0.5 * origin[-1:]])  # to the next joint
    centre = 0.45 * out + rng.uniform(-0.03, 0.03, (n, 3))
    size = np.abs(out) + rng.uniform(0.06, 0.14, (n, 3))
    squares = size**2
    inertia = mass[:, None] / 12 * (squares.sum(axis=1, keepdims=True) - squares)
    torque, speed = np.array(build.torque), np.array(build.speed)
    wide = np.where(rng.random(n) < 0.5, 2.4, 1.8)
    wide[1:3] = 1.5
    return Arm(
        build,
        origin,
        mass,
        centre,
        inertia,
        np.array(build.rotor) * rng.uniform(0.8, 1.2, n),
        coulomb=torque * rng.uniform(0.04, 0.1, n),
        viscous=torque * rng.uniform(0.04, 0.12, n) / speed,
        travel=rng.uniform(3e-4, 1.5e-3, n),
        by_engine=bool(rng.random() < 0.5),
        gravity=np.array([0.0, 0.0, -9.80665]),
        range=wide,
        described_mass=mass * rng.uniform(0.9, 1.1, n),
        described_centre=centre + rng.uniform(-0.01, 0.01, (n, 3)),
    )


def _row(values: Any) -> str:
    return " ".join(f"{value:.9g}" for value in np.atleast_1d(values))


def mujoco_text(arm: Arm, bristles: np.ndarray) -> str:
    """The MJCF. Joints marked in `bristles` (n,) get no friction from the engine."""
    parts = [
        '<mujoco><option timestep="0.001" integrator="implicitfast" '
        f'gravity="{_row(arm.gravity)}"><flag contact="disable"/></option><worldbody>'
    ]
    for k in range(arm.n):
        axis = _row(arm.axes[k])
        friction = ""
        if not bristles[k]:
            friction = f'frictionloss="{arm.coulomb[k]:.9g}" damping="{arm.viscous[k]:.9g}"'
        parts.append(f'<body name="shaft_{k}" pos="{_row(arm.origin[k])}">' if k in arm.gear else "")
        motor = f'<joint name="{arm.joint_names[k]}" axis="{axis}" armature="{arm.rotor[k]:.9g}" {friction}/>'
        if k in arm.gear:
            stiffness, damping, gap = arm.gear[k]
            parts.append(motor + '<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-6 1e-6 1e-6"/>')
            spring = f'stiffness="{stiffness:.9g}" damping="{damping:.9g}"'
            if gap:  # the engine's stop, not a formula
                spring = (
                    f'damping="{damping:.9g}" limited="true" range="{-gap / 2:.9g} {gap / 2:.9g}" '
                    'solreflimit="0.006 0.7"'
                )
            motor = f'<joint name="twist_{k}" axis="{axis}" {spring}/>'
        at = "0 0 0" if k in arm.gear else _row(arm.origin[k])
        parts.append(f'<body name="link_{k}" pos="{at}">{motor}')
        parts.append(
            f'<inertial pos="{_row(arm.centre[k])}" mass="{arm.mass[k]:.9g}" diaginertia="{_row(arm.inertia[k])}"/>'
        )
        for number, (link, mass, place) in enumerate(arm.inside):
            if link == k:
                bulk = _row(np.full(3, mass * 2.5e-4))
                parts.append(
                    f'<body name="inside_{number}" pos="{_row(place)}">'
                    f'<inertial pos="0 0 0" mass="{mass:.9g}" diaginertia="{bulk}"/></body>'
                )
    parts.append("</body>" * (arm.n + len(arm.gear)) + "</worldbody>")
    if arm.wrist:
        first, second, ratio, inertia, coulomb, viscous = arm.wrist
        parts.append(
            f'<tendon><fixed armature="{inertia:.9g}" frictionloss="{coulomb:.9g}" damping="{viscous:.9g}">'
            f'<joint joint="{arm.joint_names[first]}" coef="{ratio:.9g}"/>'
            f'<joint joint="{arm.joint_names[second]}" coef="1"/>'
            "</fixed></tendon>"
        )
    return "".join([*parts, "</mujoco>"])


def write_description(arm: Arm, folder: Path, placeholder: float | None) -> Path:
    """`robot.yaml` and the URDF beside it; with `placeholder` every link weighs that [kg] and is a ball."""
    parts, rows, parent = [f'<robot name="{arm.build.name}"><link name="base"/>'], [], "base"
    for k, name in enumerate(arm.joint_names):
        mass, centre, moments = arm.described_mass[k], arm.described_centre[k], arm.inertia[k]
        if placeholder is not None:
            mass, centre, moments = placeholder, np.zeros(3), np.full(3, 0.01 * placeholder)
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="{_row(centre)}"/><mass value="{mass:.6g}"/>'
            f'<inertia ixx="{moments[0]:.6g}" iyy="{moments[1]:.6g}" izz="{moments[2]:.6g}" ixy="0" ixz="0" iyz="0"/>'
            f'</inertial></link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{k}"/><origin xyz="{_row(arm.origin[k])}"/><axis xyz="{_row(arm.axes[k])}"/>'
            f'<limit lower="{-arm.range[k] - 0.3}" upper="{arm.range[k] + 0.3}" velocity="{arm.speed[k]}" '
            f'effort="{5 * arm.torque[k]}"/></joint>'
        )
        parent = f"link_{k}"
        ratio = arm.build.ratio
        rows.append(
            f"  - {{name: {name}, gear_ratio: {ratio}, nominal_motor_torque: {arm.torque[k] / ratio:.6g}, "
            f"max_velocity: {arm.speed[k]}, max_acceleration: {4 * arm.speed[k]}, "
            f"rotor_inertia: {arm.build.rotor[k] / ratio**2:.6g}}}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text("".join([*parts, "</robot>"]), encoding="utf-8")
    path = folder / "robot.yaml"
    head = [f"name: {arm.build.name}", "urdf: arm.urdf", f"tip_frame: {parent}", "joints:"]
    path.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")
    return path
