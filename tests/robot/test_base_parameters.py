"""Base parameters: the laws that define them, on arms of every shape."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.robot import Dynamics, RobotDescription, base_parameters, load_robot, rotor_regressor
from tests.robot.conftest import NAMES


def standard_regressor(robot: RobotDescription, rotors: bool, seed: int = 7) -> np.ndarray:
    """(S, n, p) of states other than those the base parameters were found with."""
    q, qd, qdd = np.random.default_rng(seed).normal(scale=1.5, size=(3, 80, robot.dof))
    columns = Dynamics(robot).regressor(q, qd, qdd)
    return np.concatenate([columns, rotor_regressor(robot, qdd)], axis=2) if rotors else columns


@pytest.mark.parametrize("rotors", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_base_parameters_span_the_regressor_without_redundancy(
    arms: dict[str, RobotDescription], name: str, rotors: bool
) -> None:
    robot = arms[name]
    base = base_parameters(robot, rotors)
    standard = standard_regressor(robot, rotors)
    reduced = standard[..., base.independent]
    size = np.abs(standard).max()
    np.testing.assert_allclose(reduced @ base.projection, standard, atol=1e-12 * size)
    values = np.random.default_rng(0).normal(size=standard.shape[2])
    torque = standard @ values
    np.testing.assert_allclose(reduced @ (base.projection @ values), torque, atol=1e-11 * np.abs(torque).max())

    matrix = reduced.reshape(-1, len(base.independent))
    lengths = np.linalg.norm(matrix, axis=0)
    singular = np.linalg.svd(matrix / lengths, compute_uv=False)
    assert singular[-1] > 1e-3 * singular[0], "a base parameter is a combination of others"
    full = standard.reshape(-1, standard.shape[2])
    length = np.linalg.norm(full, axis=0)
    moving = length > 1e-9 * lengths.min()
    assert np.linalg.matrix_rank(full[:, moving] / length[moving], tol=1e-8) == len(base.independent)


@pytest.mark.parametrize("name", NAMES)
def test_each_base_parameter_is_named_by_its_combination(arms: dict[str, RobotDescription], name: str) -> None:
    base = base_parameters(arms[name])
    assert base.projection.shape == (len(base.independent), 11 * arms[name].dof)
    np.testing.assert_array_equal(base.projection[:, base.independent], np.eye(len(base.independent)))
    assert np.all(np.diff(base.independent) > 0)
    for text, row, own in zip(base.names, base.projection, base.independent, strict=True):
        assert re.match(rf"{base.standard_names[own]}( [+-] |$)", text)
        told = np.zeros(len(row))
        for sign, number, parameter in re.findall(r"(?:(^|[+-])\s*)(?:([\d.e+-]+) )?([A-Za-z]+\d)", text):
            told[base.standard_names.index(parameter)] = (-1 if sign == "-" else 1) * float(number or 1)
        np.testing.assert_allclose(told, row, rtol=1e-4)


def counts(robot: RobotDescription) -> tuple[int, int]:
    return tuple(len(base_parameters(robot, rotors).independent) for rotors in (True, False))


def test_a_spherical_wrist_arm_has_40_base_parameters_and_36_without_rotors(ns16, make_spherical) -> None:
    """Neither a wrist coupling nor a URDF with four digits of pi changes the number."""
    coupling = np.eye(6)
    coupling[4, 3], coupling[5, 3], coupling[5, 4] = -0.02, 0.0204, 0.02
    coupled = replace(ns16, motor_coupling=tuple(map(tuple, coupling)))
    for robot in (ns16, coupled, make_spherical(), make_spherical(pi=3.1416)):
        assert counts(robot) == (40, 36)


def test_the_development_arm_has_40_and_36_base_parameters(shared_data: Path) -> None:
    assert counts(load_robot(shared_data / "gap-dev" / "robot.yaml")) == (40, 36)


def test_simple_arms_have_the_known_parameter_counts(arms: dict[str, RobotDescription]) -> None:
    """The rotor only adds to the mass of a slide; on a lift gravity distinguishes them."""
    known = {"slide": (1, 1), "lift": (2, 1), "planar": (7, 6), "planar, flat": (5, 4)}
    assert {name: counts(arms[name]) for name in known} == known


def test_coefficients_of_base_parameters_are_exact(ns16: RobotDescription, arms: dict[str, RobotDescription]) -> None:
    base = base_parameters(ns16)
    by_name = dict(zip((base.standard_names[k] for k in base.independent), base.names, strict=True))
    assert by_name["Izz1"].startswith("Izz1 + 0.09 m2 + Izz2")
    assert by_name["Izz1"].endswith(" + 32974 J1")
    assert by_name["Iyy2"] == "Iyy2 + 0.49 m3 + 0.49 m4 + 0.49 m5 + 0.49 m6 + 25364 J2"
    assert by_name["Izz6"] == "Izz6"
    row = base.projection[list(base.independent).index(base.standard_names.index("Iyy2"))]
    assert row[base.standard_names.index("m3")] == 0.49
    assert base_parameters(arms["slide"]).names == ("m1 + 98596 J1",)


def test_gravity_along_a_joint_changes_the_base_parameters(ns16: RobotDescription) -> None:
    """A tilted base shows the first moments of link 1 (and with them its rotor apart from nothing else)."""
    tilted = replace(ns16, gravity=(1.0, 0.5, -9.7))
    assert set(base_parameters(tilted).independent) - set(base_parameters(ns16).independent) == {1, 2}


def test_base_parameters_are_reproducible_and_independent_of_the_inertias(arms: dict[str, RobotDescription]) -> None:
    robot = arms["scara"]
    heavier = replace(robot, urdf=robot.urdf.replace('mass value="8.0"', 'mass value="80.0"'))
    assert heavier.urdf != robot.urdf
    one = base_parameters(robot)
    for other in map(base_parameters, (robot, heavier)):
        np.testing.assert_array_equal(one.projection, other.projection)
        assert one.names == other.names
