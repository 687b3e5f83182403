"""Serial arms for tests: links of bars, and gears that are all alike."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from agent.robot import Joint, RobotDescription

#: Axes of the joints of most arms here, base first.
AXES = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0")


class Bar(NamedTuple):
    """A joint, R or P, and the link that it moves: mass [kg], its centre, moments of inertia about it (xx, yy, zz)."""

    kind: str
    origin: str
    axis: str
    mass: float
    centre: str
    inertia: tuple[float, float, float]


def serial_arm(
    bars: Sequence[Bar],
    *,
    name: str = "bars",
    gears: Sequence[float] | float = 100.0,
    coupling: np.ndarray | None = None,
    nominal: float | None = None,
    speed: float = 2.5,
    acceleration: float = 8.0,
    rotor: float = 2e-4,
    limit: float = 2.0,
) -> RobotDescription:
    """`speed`, `acceleration` and `limit` are those of every joint; `nominal` and `rotor` those of every motor."""
    n = len(bars)
    parts, parent = [f'<robot name="{name}"><link name="base"/>'], "base"
    for k, bar in enumerate(bars, start=1):
        xx, yy, zz = bar.inertia
        parts.append(
            f'<link name="link_{k}"><inertial><origin xyz="{bar.centre}"/><mass value="{bar.mass}"/>'
            f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint_{k}" type="{"revolute" if bar.kind == "R" else "prismatic"}"><parent link="{parent}"/>'
            f'<child link="link_{k}"/><origin xyz="{bar.origin}"/><axis xyz="{bar.axis}"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="3" effort="9000"/></joint>'
        )
        parent = f"link_{k}"
    ends = -limit, limit
    joints = tuple(
        Joint(f"joint_{k}", bar.kind == "P", float(gear), nominal, speed, acceleration, None, rotor, None, None, *ends)
        for k, (bar, gear) in enumerate(zip(bars, np.broadcast_to(gears, n), strict=True), start=1)
    )
    rows = np.eye(n) if coupling is None else np.asarray(coupling, dtype=float)
    gravity = (0.0, 0.0, -9.80665)
    urdf = "".join([*parts, "</robot>"])
    return RobotDescription(name, urdf, parent, gravity, None, joints, tuple(map(tuple, rows.tolist())))
