"""A log that says a mass was mounted: taken for known, and named where nothing explains the gap."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agent.diagnosis import diagnose
from agent.model import PAYLOAD
from agent.pages.diagnosis.page import about_diagnosis
from fake_controller.plant import Plant
from tests.small_arms import record

CLAIMED = "6 kg, 0 mm, 0 mm, 60 mm"


@pytest.fixture(scope="module")
def found(arm, model):
    """More friction in both motions, and a mass that one of them claims and that nobody mounted."""
    effect = {"effect": "friction_change", "joints": ["joint_2"], "parameters": {"coulomb": 1.6}}
    plant = Plant(arm, seed=3, effects=[effect])
    first, second = (record(plant, name, seed) for name, seed in (("one", 21), ("two", 22)))
    return diagnose(arm, [first, replace(second, metadata={**second.metadata, PAYLOAD: CLAIMED})], model)


def test_names_the_claimed_mass_if_nothing_explains_the_gap(found):
    assert found.result["verdict"] == "unknown"
    (said,) = [text for text in found.warnings if CLAIMED in text]
    assert said == f"two.mcap says that {CLAIMED} were at the flange: if they were not, the gap may be that"


def test_the_page_header_shows_the_claimed_mass(found):
    assert ("mass at the flange", f"{CLAIMED} (two.mcap)") in about_diagnosis(found, [], found.result).identity
