"""Fixtures for all tests."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of measured data beside the checkout; skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip("measured data is not here: ../shared/data beside the checkout is missing")
    return SHARED


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Note a figure for docs/measured.md: `measured("what", value, "unit", "at most 2 %", ok)`.

    It only writes where `make verify` asked for it; the assertion stays in the test.
    """

    def note(what: str, value: float | str, unit: str = "", target: str = "", ok: bool = True) -> None:
        path = os.environ.get("CALIBRATION_FIGURES")
        if path:
            entry = {"what": what, "value": value, "unit": unit, "target": target, "ok": bool(ok)}
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps({"test": request.node.nodeid, **entry}) + "\n")

    return note


@pytest.fixture(scope="session")
def arm(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The robot.yaml of a small arm with two joints."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    (folder / "robot.yaml").write_text(DESCRIPTION, encoding="utf-8")
    return str(folder / "robot.yaml")


def _link(name: str, mass: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="0.2 0 0"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
    )


def _joint(name: str, parent: str, child: str, x: float) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="500" velocity="3"/></joint>'
    )


URDF = (
    '<robot name="small_arm"><link name="base"/>'
    + _link("upper", 5.0)
    + _link("lower", 3.0)
    + '<link name="tip"/>'
    + _joint("shoulder", "base", "upper", 0.0)
    + _joint("elbow", "upper", "lower", 0.4)
    + '<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.4 0 0"/></joint></robot>'
)

DESCRIPTION = """\
name: small_arm
urdf: arm.urdf
tip_frame: tip
cartesian_limits: {linear_speed: 1.5, linear_acceleration: 3, rotational_speed: 2, rotational_acceleration: 6}
joints:
  - {name: shoulder, gear_ratio: 100, nominal_motor_torque: 1, max_velocity: 2, max_acceleration: 6}
  - {name: elbow, gear_ratio: -80, nominal_motor_torque: 1, max_velocity: 3, max_acceleration: 9}
"""
