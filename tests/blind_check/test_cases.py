"""Which runs the emulator's world draws."""

from collections import Counter

import numpy as np

from agent.robot import load_robot
from fake_controller import actuation
from fake_controller.build import build_controller
from fake_controller.plant import Plant
from fake_controller.withheld.cases import OUTSIDE, draw_cases, draw_effect
from fake_controller.withheld.runs import draw_programs, link_recipe

ROBOT = load_robot("comau_ns16")


def test_kinds_and_effects_are_spread_evenly():
    cases = draw_cases(400, 1, ROBOT)
    kinds = Counter(case.kind for case in cases)
    assert kinds["none"] == 140
    assert set(kinds) == {"none", "one", "two", "outside"}
    assert all(len(case.effects) == {"none": 0, "two": 2}.get(case.kind, 1) for case in cases)
    named = Counter(e["effect"] for case in cases if case.kind != "outside" for e in case.effects)
    assert set(named) == set(actuation.EFFECTS)
    assert max(named.values()) <= min(named.values()) + 6
    assert {e["effect"] for case in cases if case.kind == "outside" for e in case.effects} == set(OUTSIDE)
    joints = Counter(joint for case in cases for effect in case.effects for joint in effect["joints"])
    assert set(joints) == set(ROBOT.joint_names)


def test_twelve_cases_contain_every_kind():
    assert {case.kind for case in draw_cases(12, 5, ROBOT)} == {"none", "one", "two", "outside"}


def test_draws_cover_every_joint_and_both_signs_of_friction():
    cases = draw_cases(2000, 1, ROBOT)
    drawn = [effect for case in cases for effect in case.effects]
    for name in ("joint_elasticity", "backlash", "encoder_offset"):
        assert {e["joints"][0] for e in drawn if e["effect"] == name} == set(ROBOT.joint_names)
    for name, value in (("friction_change", "coulomb"), ("inertial_mismatch", "scale"), ("torque_constant", "scale")):
        assert {e["parameters"][value] > 1 for e in drawn if e["effect"] == name} == {True, False}


def test_the_seed_determines_the_cases():
    assert draw_cases(20, 3, ROBOT) == draw_cases(20, 3, ROBOT)
    assert draw_cases(20, 3, ROBOT) != draw_cases(20, 4, ROBOT)


def test_the_fake_controller_takes_every_effect():
    assert set(OUTSIDE) == set(actuation.OUTSIDE)
    assert not set(OUTSIDE) & set(actuation.EFFECTS)
    rng = np.random.default_rng(2)
    for name in [*actuation.EFFECTS, *OUTSIDE]:
        for strength in (0.015, 0.5, 2.0):
            Plant(ROBOT, effects=[draw_effect(name, ROBOT, strength, rng)])


def test_a_serial_does_not_reveal_the_seed():
    """Whoever knew it could run the machine again without its effect."""
    (case,) = draw_cases(1, 3, ROBOT)
    assert case.machine > 2**40
    secret, known = (build_controller(ROBOT.name, seed, "fast").serial for seed in (case.machine, 7))
    assert known == "FAKE-0007"
    assert not any(str(case.machine)[at : at + 6] in secret for at in range(13))


def test_a_program_sets_the_tool_that_its_blends_refer_to():
    """What another program has left in the controller shapes the corners of joint moves, too."""
    programs = draw_programs(link_recipe(ROBOT.name), 3, 2.0)
    assert all("$TOOL := POS(0, 0, 0, 0, 0, 0" in text for text in programs.values())
