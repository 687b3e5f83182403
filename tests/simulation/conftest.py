"""Arms and motions for the simulation's tests."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from agent.robot import Joint, RobotDescription, load_robot


def make_arm(
    links: int, *, prismatic_first: bool = False, coupling: np.ndarray | None = None, gear: float = 100.0
) -> RobotDescription:
    """A serial arm of bars that turn about z, y, y, x, y, x, y; the first may slide along x."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0")
    parts = ['<robot name="bars"><link name="base"/>']
    parent = "base"
    for k in range(links):
        mass, length = 20.0 / (k + 1), 0.4
        bar = mass * length**2 / 12
        kind, axis = ("prismatic", "1 0 0") if k == 0 and prismatic_first else ("revolute", axes[k])
        parts.append(
            f'<link name="link_{k + 1}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="{0.1 * bar}" iyy="{bar}" izz="{bar}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint_{k + 1}" type="{kind}"><parent link="{parent}"/><child link="link_{k + 1}"/>'
            f'<origin xyz="{length if k else 0} 0 0"/><axis xyz="{axis}"/>'
            '<limit lower="-2" upper="2" velocity="3" effort="1000"/></joint>'
        )
        parent = f"link_{k + 1}"
    parts.append("</robot>")
    joint = {
        "nominal_motor_torque": None,
        "max_velocity": 2.5,
        "max_acceleration": 8.0,
        "max_jerk": None,
        "rotor_inertia": 2e-4,
        "max_torque": None,
        "torque_constant": None,
        "lower": -2.0,
        "upper": 2.0,
    }
    return RobotDescription(
        name="bars",
        urdf="".join(parts),
        tip_frame=parent,
        gravity=(0.0, 0.0, -9.80665),
        cartesian_limits=None,
        joints=tuple(
            Joint(name=f"joint_{k + 1}", prismatic=k == 0 and prismatic_first, gear_ratio=gear, **joint)
            for k in range(links)
        ),
        motor_coupling=tuple(tuple(float(v) for v in row) for row in (np.eye(links) if coupling is None else coupling)),
    )


@pytest.fixture(name="make_arm", scope="session")
def make_arm_fixture() -> Callable[..., RobotDescription]:
    return make_arm


@pytest.fixture(scope="session")
def ns16() -> RobotDescription:
    return load_robot("comau_ns16")


def stop_and_go(
    targets: np.ndarray, duration: float, pause: float = 0.1, period: float = 0.002
) -> tuple[np.ndarray, np.ndarray]:
    """(S, n) set-points and velocities from target to target (K, n), fifth-order and at rest in between."""
    samples = round(duration / period)
    s = np.arange(1, samples + 1)[:, None] / samples
    shape, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2 / duration
    still = np.zeros((round(pause / period), targets.shape[1]))
    q, qd = [still + targets[0]], [still]
    for start, end in pairwise(targets):
        q += [start + (end - start) * shape, still + end]
        qd += [(end - start) * slope, still]
    return np.concatenate(q), np.concatenate(qd)


@pytest.fixture(name="stop_and_go", scope="session")
def stop_and_go_fixture() -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    return stop_and_go
