"""Arms of every shape, built from a few numbers a joint."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from agent.robot import Joint, RobotDescription
from agent.robot.kinematics.closed_form import ClosedFormKinematics

#: One joint: (kind, origin xyz, origin rpy, axis); kind "R" or "P".
JointSpec = tuple[str, Sequence[float], Sequence[float], Sequence[float]]


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def build(
    joints: Sequence[JointSpec],
    tip: tuple[Sequence[float], Sequence[float]] = ((0, 0, 0), (0, 0, 0)),
    gravity: Sequence[float] = (0.0, 0.0, -9.80665),
    ratios: Sequence[float] | None = None,
    coupling: np.ndarray | None = None,
    limit: float = np.pi,
) -> RobotDescription:
    """A description with some physical inertia in every link."""
    n = len(joints)
    parts = ['<robot name="arm"><link name="base"/>']
    for k, (kind, xyz, rpy, axis) in enumerate(joints, start=1):
        parent = "base" if k == 1 else f"l{k - 1}"
        parts.append(
            f'<joint name="j{k}" type="{"revolute" if kind == "R" else "prismatic"}"><parent link="{parent}"/>'
            f'<child link="l{k}"/><origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/><axis xyz="{_numbers(axis)}"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="3" effort="100"/></joint>'
            f'<link name="l{k}"><inertial><origin xyz="0.03 -0.02 {0.1 / k}"/><mass value="{8.0 / k}"/>'
            f'<inertia ixx="{0.2 / k}" ixy="0.01" ixz="-0.004" iyy="{0.25 / k}" iyz="0.006" izz="{0.15 / k}"/>'
            "</inertial></link>"
        )
    parts.append(
        f'<joint name="mount" type="fixed"><parent link="l{n}"/><child link="tip"/>'
        f'<origin xyz="{_numbers(tip[0])}" rpy="{_numbers(tip[1])}"/></joint><link name="tip"/></robot>'
    )
    ratios = [100.0] * n if ratios is None else ratios
    matrix = np.eye(n) if coupling is None else coupling
    return RobotDescription(
        name="arm",
        urdf="".join(parts),
        tip_frame="tip",
        gravity=(float(gravity[0]), float(gravity[1]), float(gravity[2])),
        cartesian_limits=None,
        joints=tuple(
            Joint(f"j{k}", spec[0] == "P", float(ratio), 1.0, 3.0, 10.0, None, 1e-4, None, None, -limit, limit)
            for k, (spec, ratio) in enumerate(zip(joints, ratios, strict=True), start=1)
        ),
        motor_coupling=tuple(tuple(float(value) for value in row) for row in matrix),
    )


def spherical(
    offset: float = 0.3,
    lateral: float = 0.0,
    upper: float = 0.7,
    forearm: tuple[float, float] = (-0.2, 0.6),
    hand: float = 0.1,
    axis_signs: Sequence[int] = (1, 1, 1, 1, 1, 1),
    twist: float = 0.0,
    base: Sequence[float] = (0.0, 0.0, 0.0),
    pi: float = np.pi,
) -> RobotDescription:
    """A six-axis arm with spherical wrist; `twist`: of axis 6 from axis 4 at zero; `base`: rpy of its mount."""
    s = axis_signs
    return build(
        [
            ("R", (0.1, -0.2, 0.3), base, (0, 0, s[0])),
            ("R", (offset, lateral / 2, 0.2), (-pi / 2, 0, 0), (0, 0, s[1])),
            ("R", (0, -upper, lateral / 2), (0, 0, 0), (0, 0, s[2])),
            ("R", (forearm[0], -forearm[1] / 3, 0), (pi / 2, 0, 0), (0, 0, s[3])),
            ("R", (0, 0, 2 * forearm[1] / 3), (-pi / 2, 0, 0), (0, 0, s[4])),
            ("R", (0, 0, 0), (pi / 2, twist, 0), (0, 0, s[5])),
        ],
        tip=((0.02, -0.01, hand), (0.3, -0.2, 0.7)),
    )


def check_branches(kinematics: ClosedFormKinematics, q: np.ndarray, accuracy: float) -> None:
    """All solutions of the poses at q (S, 6) reach them, each on a branch of its own, and q is one of them."""
    poses = kinematics.forward(q)
    found = kinematics.inverse(poses)
    assert not found.unreachable.any()
    sample, branch = np.nonzero(found.valid)
    np.testing.assert_allclose(kinematics.forward(found.q[sample, branch]), poses[sample], atol=accuracy)
    assert np.isnan(found.q[~found.valid]).all()
    for there, solutions, valid in zip(q, found.q, found.valid, strict=True):
        mine = solutions[valid]
        apart, away = (np.abs(np.angle(np.exp(1j * (mine[:, None] - other)))).max(axis=2) for other in (mine, there))
        assert apart[~np.eye(len(mine), dtype=bool)].min(initial=1.0) > 1e-6, "two branches are one"
        assert away.min() < 1e-7, "the configuration itself is missing"
        assert len({kinematics.branch(row) for row in mine}) == len(mine)


#: Arms of the fixture `arms`.
NAMES = ("slide", "lift", "planar", "planar, flat", "anthropomorphic", "gantry", "scara", "skew", "spherical")
NAMES = (*NAMES, "coupled wrist", "seven axes", "comau_ns16")
SEVEN_AXES: list[JointSpec] = [
    ("R", (0, 0, 0.34), (0, 0, 0), (0, 0, 1)),
    ("R", (0, 0, 0), (-np.pi / 2, 0, 0), (0, 0, 1)),
    ("R", (0, -0.4, 0), (np.pi / 2, 0, 0), (0, 0, 1)),
    ("R", (0, 0, 0), (np.pi / 2, 0, 0), (0, 0, 1)),
    ("R", (0, 0.4, 0), (-np.pi / 2, 0, 0), (0, 0, 1)),
    ("R", (0, 0, 0), (-np.pi / 2, 0, 0), (0, 0, 1)),
    ("R", (0, 0, 0), (np.pi / 2, 0, 0), (0, 0, 1)),
]


@pytest.fixture(scope="session")
def make_arm() -> Callable[..., RobotDescription]:
    """`build` above."""
    return build


@pytest.fixture(scope="session")
def make_spherical() -> Callable[..., RobotDescription]:
    """`spherical` above."""
    return spherical


@pytest.fixture(scope="session")
def arms(ns16: RobotDescription) -> dict[str, RobotDescription]:
    """Arms of one to seven joints, by a name that says what they are."""
    gantry: list[JointSpec] = [
        ("P", (0, 0, 1), (0, 0, 0), (1, 0, 0)),
        ("P", (0, 0, 0), (0, 0, 0), (0, 1, 0)),
        ("P", (0, 0, 0), (0, 0, 0), (0, 0, -1)),
        ("R", (0, 0, -0.1), (0, 0, 0), (0, 0, 1)),
    ]
    scara: list[JointSpec] = [
        ("R", (0, 0, 0.4), (0, 0, 0), (0, 0, 1)),
        ("R", (0.4, 0, 0), (0, 0, 0), (0, 0, 1)),
        ("P", (0.3, 0, 0), (0, 0, 0), (0, 0, -1)),
        ("R", (0, 0, 0), (0, 0, 0), (0, 0, 1)),
    ]
    planar: list[JointSpec] = [("R", (0, 0, 0), (0, 0, 0), (0, 1, 0)), ("R", (0.5, 0, 0), (0, 0, 0), (0, 1, 0))]
    skew: list[JointSpec] = [
        ("R", (0, 0, 0.3), (0.2, 0.1, 0), (0.6, 0, 0.8)),
        ("R", (0.2, 0.1, 0.4), (0.5, -0.7, 0.2), (0, 0.6, -0.8)),
        ("R", (0.3, 0, 0.1), (0.1, 0.4, -0.9), (1, 2, 2)),
        ("R", (0.1, -0.2, 0.3), (-0.6, 0.2, 0.4), (2, -1, 2)),
        ("R", (0.1, 0.1, 0.1), (0.9, 0.3, 0.1), (0, 1, 0)),
        ("R", (0.05, 0.1, 0.1), (-0.3, 0.8, 0.1), (1, 0, 0)),
    ]
    forward = ((0.3, 0.0, 0.0), (0.0, 0.0, 0.0))
    return {
        "slide": build([("P", (0, 0, 0), (0, 0, 0), (1, 0, 0))], ratios=[314.0]),
        "lift": build([("P", (0, 0, 0), (0, 0, 0), (0, 0, 1))], ratios=[-400.0]),
        "planar": build(planar, tip=forward),
        "planar, flat": build(planar, tip=forward, gravity=(0.0, -9.80665, 0.0)),
        "anthropomorphic": build(
            [("R", (0, 0, 0.5), (0, 0, 0), (0, 0, 1)), *((k, x, r, a) for k, x, r, a in planar)], tip=forward
        ),
        "gantry": build(gantry),
        "scara": build(scara),
        "skew": build(skew, tip=((0, 0, 0.1), (0, 0.4, 0))),
        "spherical": spherical(lateral=0.05, axis_signs=(1, -1, 1, -1, 1, -1), base=(0.3, 0.4, 0.5)),
        "coupled wrist": build(
            [(k, x, r, a) for k, x, r, a in SEVEN_AXES[:6]],
            coupling=np.eye(6) + np.tril(0.05 * np.ones((6, 6)), -1) * (np.arange(6) >= 3),
        ),
        "seven axes": build(SEVEN_AXES, tip=((0, 0, 0.126), (0, 0, 0))),
        "comau_ns16": ns16,
    }
