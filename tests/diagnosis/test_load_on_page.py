"""The page of a diagnosis gives the centre of mass of a load in millimetres, and in which frame."""

import re

import pytest

from agent.diagnosis import diagnose
from agent.pages.diagnosis.page import diagnosis_report
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

CENTRE = (0.02, 0.0, 0.06)


def test_the_centre_of_mass_is_in_the_frame_of_the_flange():
    robot = make_arm("RRRR")
    load = {"effect": "payload", "joints": [], "parameters": {"mass": 4.0, "centre": [*CENTRE]}}
    logs = [record(Plant(robot, seed=3, effects=(load,)), f"{seed}", seed) for seed in (21, 22)]
    page = diagnosis_report(diagnose(robot, logs, learn(robot)))
    (shown,) = re.findall(r"centre of mass in link_4</td>\s*<td[^>]*>([^<]*) mm<", page)
    assert [float(part.split("±")[0]) for part in shown.split(",")] == pytest.approx([1e3 * x for x in CENTRE], abs=1.5)
