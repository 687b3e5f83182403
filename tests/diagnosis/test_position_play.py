"""Play of a gear before what a position servo reads: how positions differ, by motor, teeth and link."""

import numpy as np
import pytest

from agent.blind_check.scoring import among, class_of
from agent.blind_check.worker import diagnose_run
from agent.compiled import servo_through_play
from fake_controller.servoed.__main__ import write

pytest.importorskip("mujoco")
KP, KV, VISCOUS, FRICTION, ROTOR, MASS = 6.0, 0.3, 0.05, 0.06, 0.012, 0.006
RATE, SUBSTEPS = 200.0, 20
#: Run of the blind world `positions`: an arm of five joints whose servos read the links.
TRUTH = {
    "machine": 2914479001988846812,
    "motion": 1044981598051068187,
    "motions": "both",
    "effects": [{"effect": "backlash", "joints": ["joint_5"], "parameters": {"gap": 0.018311378804736666}}],
    "frames": {"rate": 200.0, "jitter": 0.00018549010132712092, "clipped": False, "format": "csv"},
}


def swinging(load):
    """(6, S) a joint that follows a sine while its link carries a constant load as well."""
    time = np.arange(800) / RATE
    speed, push = 0.9 * np.cos(3 * time), -2.7 * np.sin(3 * time)
    carried = MASS * push + load
    torque = carried + ROTOR * push + VISCOUS * speed + FRICTION * np.sign(speed)
    ones = np.ones(len(time))
    return np.stack([torque, carried, speed, MASS * ones, 0 * ones, ones])


def moved(load, gap):
    servo = np.array([KP, KV, VISCOUS, FRICTION, ROTOR, -3.0, 3.0])
    stiffness, damper = np.array([300.0]), np.array([0.3])
    step = 1 / RATE / SUBSTEPS
    return servo_through_play(swinging(load), servo, stiffness, damper, np.array([gap]), step, SUBSTEPS)[0]


def test_a_closed_gear_moves_as_one_body():
    assert np.abs(moved(load=0.0, gap=0.0)).max() < 2e-3, "what the teeth give, and how friction turns, is all"


def test_play_shows_where_the_load_turns_and_not_under_a_weight_that_holds_one_flank():
    free, weighed = (np.abs(moved(load, 0.03) - moved(load, 0.0)).max() for load in (0.0, 0.2))
    assert free > 5e-3
    assert weighed < 1e-6


def test_a_servo_that_hunts_in_a_play_is_named_where_it_reads_the_link(tmp_path):
    write({"truth": TRUTH, "folder": str(tmp_path), "seconds": 16.0})
    answer = diagnose_run(tmp_path)
    assert answer["causes"], answer["verdict"]
    assert among(class_of(answer["causes"][0]), TRUTH["effects"])
