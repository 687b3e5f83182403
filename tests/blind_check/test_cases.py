"""Which runs are drawn, and the key that holds them."""

from __future__ import annotations

import json
from collections import Counter

import numpy as np
import pytest

from agent.blind_check.cases import OUTSIDE, draw_cases, draw_effect
from agent.blind_check.key import key_text, open_key, seal
from agent.blind_check.motions import draw_programs
from agent.blind_check.runs import link_recipe
from agent.core import sha256_text
from agent.core.errors import InputError
from agent.model import CATALOGUE
from agent.robot import load_robot
from fake_controller import actuation
from fake_controller.plant import Plant

ROBOT = load_robot("comau_ns16")


def test_kinds_and_effects_are_spread_evenly():
    cases = draw_cases(400, 1, ROBOT)
    kinds = Counter(case.kind for case in cases)
    assert kinds["none"] == 150
    assert set(kinds) == {"none", "one", "two", "outside", "small"}
    assert all(len(case.effects) == {"none": 0, "two": 2}.get(case.kind, 1) for case in cases)
    named = Counter(e["effect"] for case in cases if case.kind != "outside" for e in case.effects)
    assert set(named) == set(CATALOGUE)
    assert max(named.values()) <= min(named.values()) + 6
    assert {e["effect"] for case in cases if case.kind == "outside" for e in case.effects} == set(OUTSIDE)
    joints = Counter(joint for case in cases for effect in case.effects for joint in effect["joints"])
    assert set(joints) == set(ROBOT.joint_names)


def test_a_dozen_has_some_of_every_kind():
    assert {case.kind for case in draw_cases(12, 5, ROBOT)} == {"none", "one", "two", "outside", "small"}


def test_the_seed_decides():
    assert draw_cases(20, 3, ROBOT) == draw_cases(20, 3, ROBOT)
    assert draw_cases(20, 3, ROBOT) != draw_cases(20, 4, ROBOT)


def test_the_fake_controller_takes_every_effect():
    assert set(OUTSIDE) == set(actuation.OUTSIDE)
    assert not set(OUTSIDE) & set(CATALOGUE)
    rng = np.random.default_rng(2)
    for name in [*CATALOGUE, *OUTSIDE]:
        for strength in (0.015, 0.5, 2.0):
            Plant(ROBOT, effects=[draw_effect(name, ROBOT, strength, rng)])


def test_the_key_is_fixed_before_it_is_opened(tmp_path):
    cases = draw_cases(12, 5, ROBOT)
    text = key_text(5, ROBOT.name, cases)
    digest = seal(tmp_path, text)
    assert not (tmp_path / "key.json").exists()
    assert "stribeck" not in "".join(path.read_text() for path in tmp_path.iterdir())
    assert seal(tmp_path, text) == digest
    with pytest.raises(InputError, match="another seed or number"):
        seal(tmp_path, key_text(6, ROBOT.name, draw_cases(12, 6, ROBOT)))
    open_key(tmp_path, text)
    opened = (tmp_path / "key.json").read_text()
    assert sha256_text(opened) == digest
    assert [case["kind"] for case in json.loads(opened)["cases"]] == [case.kind for case in cases]


def test_a_program_says_with_which_tool_its_corners_are_flown():
    """What another program has left in the controller shapes the corners of joint moves, too."""
    programs = draw_programs(link_recipe(ROBOT.name, "127.0.0.1:9"), 3, 2.0)
    assert all("$TOOL := POS(0, 0, 0, 0, 0, 0" in text for text in programs.values())
