"""Arms of four classes with proportions of their own: what MuJoCo simulates, and the description a user gets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

#: Masses [kg] that a URDF with placeholder inertials gives every link.
PLACEHOLDERS = (0.01, 1.0, 3.0)


@dataclass(frozen=True)
class ArmClass:
    """A kind of arm; rows are joints. At zero all frames are parallel.

    `origin` [m] in the parent link, `axis`, `mass` [kg] of the link, `torque` nominal [N·m], `speed` highest [rad/s],
    `rotor` inertia on the joint side [kg·m²], gear `ratio`, `friction` (lowest, highest) Coulomb level over nominal
    torque, `balance`: torque of the counterbalance on joint 2 over nominal, 0 without one.
    """

    name: str
    origin: tuple[tuple[float, float, float], ...]
    axis: str
    mass: tuple[float, ...]
    torque: tuple[float, ...]
    speed: tuple[float, ...]
    rotor: tuple[float, ...]
    ratio: float
    friction: tuple[float, float]
    balance: float = 0.0


CLASSES = (
    ArmClass(
        "equal_six",  # one size of drive in five of six joints
        ((0, 0, 0.15), (0, 0.12, 0), (0.41, -0.1, 0), (0.38, 0, 0), (0, 0.1, 0), (0, 0, -0.1)),
        "zyyyzy",
        (6, 11, 5, 2.4, 2.2, 0.8),
        (75, 110, 75, 24, 24, 24),
        (2.2, 2.2, 2.6, 3.0, 3.0, 3.0),
        (1.3, 1.3, 0.9, 0.25, 0.25, 0.25),
        101.0,
        (0.05, 0.12),
    ),
    ArmClass(
        "seven_axes",
        ((0, 0, 0.34), (0, 0, 0), (0, 0, 0.36), (0.06, 0, 0), (-0.06, 0, 0.38), (0, 0, 0), (0.08, 0, 0.06)),
        "zyzyzyz",
        (4.5, 4.2, 3.6, 3.2, 2.6, 1.8, 0.9),
        (50, 70, 36, 36, 14, 12, 7),
        (2.0, 2.0, 2.2, 2.2, 2.6, 2.6, 2.8),
        (0.7, 0.7, 0.5, 0.5, 0.2, 0.2, 0.15),
        120.0,
        (0.04, 0.1),
    ),
    ArmClass(
        "heavy_balanced",  # carries 150 kg; a cylinder at joint 2 is part of the healthy arm
        ((0, 0, 0.68), (0.3, 0, 0), (0, 0, 1.1), (0.35, 0, 0.2), (0.75, 0, 0), (0.2, 0, 0)),
        "zyyxyx",
        (480, 260, 230, 70, 45, 18),
        (2600, 3200, 1900, 420, 380, 220),
        (1.8, 1.7, 1.8, 2.6, 2.6, 3.4),
        (190, 240, 120, 14, 12, 6),
        220.0,
        (0.05, 0.11),
        0.7,
    ),
    ArmClass(
        "table_top",
        ((0, 0, 0.2), (0, 0.03, 0), (0, 0, 0.26), (0, -0.03, 0.12), (0, 0, 0.14), (0, 0, 0.06)),
        "zyyzyz",
        (3.2, 2.6, 1.4, 0.8, 0.5, 0.2),
        (11, 15, 8, 2.6, 2.2, 1.4),
        (3.0, 2.8, 3.0, 4.2, 4.2, 5.0),
        (0.3, 0.35, 0.15, 0.04, 0.03, 0.02),
        80.0,
        (0.15, 0.35),
    ),
)


@dataclass(frozen=True, eq=False)
class Arm:
    """One individual. n joints, SI on the joint side; `inertia` (n, 3) are principal moments along the link's axes.

    `described_mass`, `described_centre` and `described_inertia` are what its URDF says.
    """

    kind: ArmClass
    origin: np.ndarray
    mass: np.ndarray
    centre: np.ndarray
    inertia: np.ndarray
    rotor: np.ndarray
    range: np.ndarray
    described_mass: np.ndarray
    described_centre: np.ndarray
    described_inertia: np.ndarray

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.mass)

    @property
    def torque(self) -> np.ndarray:
        """(n,) nominal [N·m]."""
        return np.array(self.kind.torque, dtype=float)

    @property
    def speed(self) -> np.ndarray:
        """(n,) highest [rad/s]."""
        return np.array(self.kind.speed, dtype=float)

    @property
    def axes(self) -> np.ndarray:
        """(n, 3)."""
        return np.array([[a == b for b in "xyz"] for a in self.kind.axis], dtype=float)

    @property
    def joint_names(self) -> list[str]:
        """As in the description."""
        return [f"joint_{k + 1}" for k in range(self.n)]


def draw_arm(kind: ArmClass, rng: np.random.Generator) -> Arm:
    """An individual of a class, and how well its URDF describes it: nearly, or by placeholders."""
    n = len(kind.mass)
    origin = np.array(kind.origin, dtype=float) * rng.uniform(0.8, 1.2, (n, 1))
    mass = np.array(kind.mass) * rng.uniform(0.8, 1.2, n)
    out = np.vstack([origin[1:], 0.5 * origin[-1:]])  # to the next joint
    reach = float(np.abs(origin).sum())
    centre = 0.45 * out + 0.02 * reach * rng.uniform(-1, 1, (n, 3))
    squares = (np.abs(out) + reach * rng.uniform(0.04, 0.09, (n, 3))) ** 2
    inertia = mass[:, None] / 12 * (squares.sum(axis=1, keepdims=True) - squares)
    wide = np.where(rng.random(n) < 0.5, 2.4, 1.8)
    wide[1:3] = 1.4
    described = mass * rng.uniform(0.9, 1.1, n), centre + 0.01 * rng.uniform(-1, 1, (n, 3)), inertia
    if rng.random() < 0.4:
        placeholder = float(rng.choice(PLACEHOLDERS))
        described = np.full(n, placeholder), np.zeros((n, 3)), np.full((n, 3), 0.01 * placeholder)
    rotor = np.array(kind.rotor) * rng.uniform(0.8, 1.2, n)
    return Arm(kind, origin, mass, centre, inertia, rotor, wide, *described)


def row(values: Any) -> str:
    """Numbers as XML has them."""
    return " ".join(f"{value:.9g}" for value in np.atleast_1d(values))


def write_description(arm: Arm, folder: Path) -> Path:
    """Write `robot.yaml` and the URDF that it names; returns the path of the former."""
    parts, rows, parent = [f'<robot name="{arm.kind.name}"><link name="base"/>'], [], "base"
    for k, name in enumerate(arm.joint_names):
        mass, moments = arm.described_mass[k], arm.described_inertia[k]
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="{row(arm.described_centre[k])}"/><mass value="{mass:.6g}"/>'
            f'<inertia ixx="{moments[0]:.6g}" iyy="{moments[1]:.6g}" izz="{moments[2]:.6g}" ixy="0" ixz="0" iyz="0"/>'
            f'</inertial></link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{k}"/><origin xyz="{row(arm.origin[k])}"/><axis xyz="{row(arm.axes[k])}"/>'
            f'<limit lower="{-arm.range[k] - 0.3}" upper="{arm.range[k] + 0.3}" velocity="{arm.speed[k]}" '
            f'effort="{5 * arm.torque[k]}"/></joint>'
        )
        parent, ratio = f"link_{k}", arm.kind.ratio
        rows.append(
            f"  - {{name: {name}, gear_ratio: {ratio}, nominal_motor_torque: {arm.torque[k] / ratio:.6g}, "
            f"max_velocity: {arm.speed[k]}, max_acceleration: {4 * arm.speed[k]}, "
            f"rotor_inertia: {arm.kind.rotor[k] / ratio**2:.6g}}}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.urdf").write_text("".join([*parts, "</robot>"]), encoding="utf-8")
    path = folder / "robot.yaml"
    head = [f"name: {arm.kind.name}", "urdf: arm.urdf", f"tip_frame: {parent}", "joints:"]
    path.write_text("\n".join([*head, *rows, ""]), encoding="utf-8")
    return path
