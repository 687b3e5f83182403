"""How large a cause is, as people read it: value, interval, unit."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core import plus_minus
from agent.diagnosis.sizes import amplitude, intervals, leading_parameter, reported_parameters, size_text, unit_of
from agent.pages import closes, headline, summary
from agent.robot import SHARE

NUMBER = re.compile(r"-?[\d.]+(?:e[-+]?\d+)?")


@given(st.floats(-1e9, 1e9), st.floats(-6, 2))
def test_a_value_is_given_to_the_digits_of_its_interval(value: float, power: float):
    half = max(abs(value), 1e-3) * 10**power
    text = plus_minus(value, half)
    scale = 10 ** float(text.rpartition(")e")[2]) if ")e" in text else 1.0
    shown, spread = (scale * float(number) for number in NUMBER.findall(text)[:2])
    assert shown == pytest.approx(value, abs=0.06 * half)
    assert spread == pytest.approx(half, rel=0.06)
    assert "nan" not in text


def test_figures_have_their_units():
    assert plus_minus(4.0032, 0.0213) == "4.003 ± 0.021"
    assert plus_minus(133_269.5, 2114.0) == "133300 ± 2100"
    assert plus_minus(-0.001, 0.24) == "0.00 ± 0.24"
    assert size_text({"effect": "payload"}, "mass", 4.0, (3.98, 4.02)) == "4.000 ± 0.020 kg"
    assert size_text({"effect": "time_delay"}, "delay", 0.009, None) == "9 ms"
    assert size_text({"effect": "encoder_offset"}, "offset", 0.01, (0.009, 0.011)) == "10.0 ± 1.0 mrad"
    assert size_text({"effect": "torque_offset"}, "offset", 2.0, None) == "2 N·m"
    assert size_text({"effect": "torque_offset", "slides": True}, "offset", 2.0, None) == "2 N"
    assert size_text({"effect": "torque_constant"}, "scale_error", 0.05, None) == "5 %"
    assert unit_of("contact", "force_x_2") == "N"


def test_an_interval_is_what_leaving_motions_out_says():
    """Five motions, or of what happens once its two segments: delete-a-group jackknife, Student's t."""

    def reported(reference, settings, named):
        return {**settings, **named, "twice": 2 * named["level"]}

    effect = SimpleNamespace(reported=reported)
    causes = [
        SimpleNamespace(effect=effect, settings={"speed": 0.1}, names=("level",), transient=k) for k in (False, True)
    ]
    fit = SimpleNamespace(reference=None, folds=range(5), segment_folds=(5, 6), values=np.array([[3.0], [7.0]]))
    fit.fitted = lambda fold: (None, np.array([[2.0 + fold], [3.0 * fold]]))
    repeats, transient = intervals(SimpleNamespace(fit=fit, causes=causes))
    half, of_once = 2.7764 * np.sqrt(4 / 5 * 10), 3.1824 * np.sqrt(1 / 2 * 4.5)
    assert repeats["level"] == pytest.approx((3 - half, 3 + half), rel=1e-4)
    assert repeats["twice"] == pytest.approx((6 - 2 * half, 6 + 2 * half), rel=1e-4)
    assert transient["level"] == pytest.approx((7 - of_once, 7 + of_once), rel=1e-4)
    assert {*repeats} == {*transient} == {"level", "twice"}, "what every fold says alike has none"
    fit.folds = (2, 2)  # two motions that agree by chance
    assert intervals(SimpleNamespace(fit=fit, causes=causes))[0]["level"][1] == pytest.approx(3 + 3.1824 / 2, rel=1e-4)


GAP = {"joints": ["elbow"], "units": [SHARE], "before": [0.04], "after": [0.01]}


def test_picks_the_leading_parameter_and_hides_minor_ones():
    payload = {"effect": "payload", "parameters": {"m0": 3.9, "hx0": 0.1, "mass": 4.0, "moment_x": 0.4}}
    assert leading_parameter(payload) == "mass"
    assert reported_parameters(payload) == ["mass", "moment_x"]
    one_sided = {"effect": "asymmetric_friction", "parameters": {"coulomb": 1.0, "coulomb_asymmetry": 28.3}}
    assert reported_parameters(one_sided) == ["coulomb_asymmetry"]
    assert leading_parameter({"effect": "inertial_mismatch", "parameters": {"link": 3.0, "m3": 1.0}}) == "m3"
    warms_up = {"coulomb_change": 0.0, "coulomb_drift": 0.7, "viscous_drift": 0.3}
    assert leading_parameter({"effect": "thermal_friction", "parameters": warms_up}) == "coulomb_drift"
    assert leading_parameter({"effect": "other", "parameters": {"odd": 1.0, "travel": 0.02}}) is None
    assert leading_parameter({"effect": "stribeck", "parameters": {"shape": 1.0, "speed": 0.02}}) == "speed"
    assert leading_parameter({"effect": "backlash", "parameters": {"stiffness": 2e5, "gap": 0.002}}) == "gap"


def test_a_change_has_its_sign_and_a_sum_of_harmonics_its_amplitude():
    assert size_text({"effect": "friction_change"}, "coulomb_change", 32.4, (32.2, 32.6)) == "+32.40 ± 0.20 N·m"
    assert size_text({"effect": "joint_elasticity"}, "stiffness", 197_612.0, None) == "197600 N·m/rad"
    spring = {"effect": "gravity_spring", "parameters": {"harmonics": 2.0, "cosine_1": 3.0, "sine_1": -4.0}}
    assert amplitude(spring, {}) == ("amplitude", 5.0, None)
    _, size, interval = amplitude(spring, {"cosine_1": (2.0, 4.0), "sine_1": (-5.0, -3.0)})
    assert (size, interval) == (5.0, pytest.approx((4.0, 6.0)))
    assert amplitude({"effect": "payload", "parameters": {"mass": 1.0}}, {}) is None
    push = {"effect": "contact", "parameters": {"force_x": 2.0, "force_y": -6.0, "force_z": 9.0}}
    assert amplitude(push, {}) == ("force", 11.0, None)


def test_the_headline_names_all_indistinguishable_causes():
    other = {"effect": "torque_offset", "joints": ["elbow"]}
    cause = {"effect": "asymmetric_friction", "joints": ["elbow"], "closure": 1.04, "probability": 0.95}
    cause["parameters"] = {"coulomb_asymmetry": -3.3}
    result = {"verdict": "ambiguous", "closure": 0.98, "causes": [cause | {"equivalent_to": [other]}]}
    result |= {"where": [], "next_experiment": None, "gap": GAP}
    assert headline(result) == (
        "elbow: friction differs between the two directions (asymmetric_friction), or the measured torque is shifted "
        "by a constant (torque_offset)."
    )
    said = summary(result)
    error = "4.00 % of nominal torque; 1.00 % with what was found"
    assert said["where"] == f"elbow. Torque error of elbow on held-out motion: {error}."
    assert said["what"].endswith("The first closes 98 % of the gap, coulomb asymmetry about -3.3 N·m.")
    assert said["how_sure"] == "These logs cannot distinguish them: together probability 0.95."
    assert said["next"] == ["Look at one-sided bearing load, seals, preload of a screw or belt."]
    elsewhere = [{"effect": "payload", "joints": []}, other, other, other]
    result["causes"][0]["equivalent_to"] = elsewhere
    assert "mass than in the model (payload) on the whole arm, or the measured" in headline(result)
    assert headline(result).endswith("(torque_offset), or one of 2 others.")


def test_a_cause_closes_as_much_as_its_attribution_step():
    cause = {"effect": "torque_offset", "joints": ["elbow"], "closure": 0.98, "parameters": {"offset": 2.0}}
    cause |= {"probability": 0.9, "equivalent_to": []}
    steps = [("torque_offset of elbow", 0.61), ("the model's own parameters", 0.38), ("remainder", 0.01)]
    result = {"verdict": "explained", "closure": 0.99, "causes": [cause], "where": [], "next_experiment": None}
    result |= {"gap": GAP, "waterfall": [{"step": step, "closes": part} for step, part in steps]}
    assert closes(cause, result) == "closes 61 % of the gap"
    assert closes({**cause, "closure": -0.004}, {"closure": 0.99}) == "closes less than 1 % of the gap"
    assert (
        "It closes 61 % of the gap, offset 2 N·m. Most of the gap closes with: torque_offset of elbow (61 %)"
        in (summary(result)["what"])
    )
    push = {"effect": "contact", "joints": [], "parameters": {"force_x": 0.1, "force_y": -6.0, "force_z": 9.0}}
    assert "gap, force 10.82 N." in summary(result | {"causes": [cause | push]})["what"], "not that of one axis"
