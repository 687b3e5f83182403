"""Masses in grams and lengths in millimetres are found in a description, whichever of its numbers they are."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from agent.data_quality import check_quality
from fake_controller.plant import Plant
from tests.arms import Bar, serial_arm
from tests.small_arms import make_arm, record


@pytest.fixture(scope="module")
def arm():
    """An arm of three joints and two motions of it."""
    robot = make_arm("RRR")
    plant = Plant(robot, seed=3)
    return robot, [record(plant, "first", 11), record(plant, "second", 12)]


def rescaled(robot, mass=1.0, length=1.0, centre=1.0):
    """The robot with numbers of another unit in its URDF."""
    root = ElementTree.fromstring(robot.urdf)
    for element in root.findall("link/inertial/mass"):
        element.set("value", str(mass * float(element.get("value"))))
    for path, factor in (("link/inertial/origin", centre), ("joint/origin", length)):
        for element in root.findall(path):
            element.set("xyz", " ".join(str(factor * float(x)) for x in element.get("xyz").split()))
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))


@pytest.mark.parametrize(
    ("units", "said"),
    [
        ({"mass": 1e3}, "masses in g:"),
        ({"mass": 1e-3}, "masses in t:"),
        ({"length": 1e3}, "joint origins in mm:"),
        ({"centre": 1e3}, "with centres of mass in mm:"),
        ({"length": 1e3, "centre": 1e3}, "joint origins in mm and centres of mass in mm:"),
        ({"mass": 1e3, "length": 1e3, "centre": 1e3}, "masses in g, joint origins in mm and centres of mass in mm:"),
    ],
)
def test_unit_of_the_description_is_named(arm, units, said):
    robot, logs = arm
    (found,) = check_quality(rescaled(robot, **units), logs)
    assert found.refuses
    assert said in found.text
    assert "kg and m" in found.advice


def test_zeros_of_two_joints_are_no_length():
    """Of parallel axes: a centre of mass that turns with the first zero hides most of both."""
    axes, bar = ("0 0 1", "0 1 0", "0 1 0", "1 0 0"), (0.5, 0.5, 0.05)
    origins = ("0 0 0", "0 0.06 0.35", "0 0 0.35", "0 0 0.35")
    places = enumerate(zip(origins, axes, strict=True), start=1)
    robot = serial_arm([Bar("R", origin, axis, 40.0 / k, "0.01 0.02 0.2", bar) for k, (origin, axis) in places])
    log = record(Plant(robot, seed=3), "upright", 14)
    found = check_quality(robot, [replace(log, position=log.position + np.radians([0, 90, -90, 0]))])
    assert any("zeros of joint_2 and joint_3 look 90° off" in finding.text for finding in found)


def test_a_urdf_needs_no_robot_name(arm):
    robot, (log, _) = arm
    nameless = replace(robot, urdf=robot.urdf.replace(f' name="{robot.name}"', "", 1))
    assert nameless.urdf != robot.urdf
    assert check_quality(nameless, [log]) == []


def test_the_unit_shows_without_gravity_too():
    """Both axes are along gravity: inertia shows it."""
    bars = [Bar("R", f"{0.3 * k} 0 0", "0 0 1", 8.0, "0.15 0 0", (0.02, 0.1, 0.1)) for k in range(2)]
    robot = serial_arm(bars, rotor=0.0)
    log = record(Plant(robot, seed=3), "flat", 13)
    (found,) = check_quality(rescaled(robot, length=1e3, centre=1e3), [log])
    assert found.refuses
    assert "joint origins in mm and centres of mass in mm" in found.text
    assert not any("description looks like" in found.text for found in check_quality(robot, [log]))


@pytest.mark.parametrize("units", [{}, {"mass": 3.0}, {"mass": 0.3}, {"centre": 2.0}])
def test_an_arm_that_may_exist_is_in_kg_and_m(arm, units):
    robot, logs = arm
    assert not any(
        "the description looks like" in found.text for found in check_quality(rescaled(robot, **units), logs)
    )
