"""Masses in grams and lengths in millimetres are found in a description, whichever of its numbers they are."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import pytest

from agent.data_quality import check_quality
from fake_controller.plant import Plant
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
        ({"mass": 1e3, "length": 1e3, "centre": 1e3}, "masses in g and joint origins in mm and centres of mass in mm:"),
    ],
)
def test_unit_of_the_description_is_named(arm, units, said):
    robot, logs = arm
    (found,) = check_quality(rescaled(robot, **units), logs)
    assert found.refuses
    assert said in found.text
    assert "kg and m" in found.advice


@pytest.mark.parametrize("units", [{}, {"mass": 3.0}, {"mass": 0.3}, {"centre": 2.0}])
def test_an_arm_that_may_exist_is_in_kg_and_m(arm, units):
    robot, logs = arm
    assert not any(
        "the description looks like" in found.text for found in check_quality(rescaled(robot, **units), logs)
    )
