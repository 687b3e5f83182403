"""A log with the drives off tells an offset of a torque channel from friction by direction, its equal in motion."""

from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.diagnosis import channel_zero, diagnose
from agent.experiment import open_pairs
from fake_controller.plant import Plant
from tests.small_arms import record

JOINT = 1
OFFSET = 6.0
CHANNELS = ("t", "position", "velocity", "effort")


@pytest.fixture(scope="module")
def logs(arm, model):
    """Two motions, the torque of one joint shifted while it slides: one-sided friction, or an offset of its channel."""
    plant = Plant(arm, seed=3)
    healthy = [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]
    shift = OFFSET * (np.arange(arm.dof) == JOINT)
    return [replace(log, effort=log.effort + shift) for log in healthy]


@pytest.fixture(scope="module")
def plain(arm, model, logs):
    """What is said of these without a log with the drives off."""
    return diagnose(arm, logs, model).document


def at_rest(log, torque, seconds=4.0):
    """A log of the arm on its brakes whose channels show `torque` (n,) and noise."""
    count = round(seconds * log.sample_rate)
    rng = np.random.default_rng(2)
    position = np.tile(log.position[0], (count, 1))
    channels = {"velocity": 0 * position, "effort": torque + 0.05 * rng.normal(size=position.shape)}
    whole = {"reference_position": None, "segments": ((0, count),), "cycle_starts": ()}
    return replace(log, t=np.arange(count) / log.sample_rate, position=position, **channels, **whole)


def known_before(model, logs, known):
    """A model with such an offset already, and logs of the arm with the same offset."""
    here = [term.name for term in model.terms].index(f"offset_{JOINT + 1}") + len(model.independent)
    values = model.values + known * (np.arange(len(model.values)) == here)
    more = known * (np.arange(model.robot.dof) == JOINT)
    return replace(model, values=values), [replace(log, effort=log.effort + more) for log in logs]


def test_offset_and_asymmetric_friction_are_equivalent_without_a_drives_off_record(plain):
    (cause,) = plain.causes
    assert {cause.effect, *(place.effect for place in cause.equivalent_to)} >= {"torque_offset", "asymmetric_friction"}


@pytest.mark.parametrize(
    ("known", "shown", "shows"),
    [
        (0.0, OFFSET, False),
        (20.0, OFFSET + 20.0, True),
        *(
            pytest.param(*draw, marks=pytest.mark.verify)
            for draw in (
                (0.0, OFFSET, True),
                (20.0, OFFSET, True),
                (20.0, OFFSET, False),
                (20.0, OFFSET + 20.0, False),
            )
        ),
    ],
)
def test_torque_present_with_the_drives_off_is_an_offset_and_absent_is_friction(arm, model, logs, known, shown, shows):
    """With what the model took for one before, or without: that may have been friction."""
    model, logs = known_before(model, logs, known)
    zero = at_rest(logs[0], (shown - OFFSET * (not shows)) * (np.arange(arm.dof) == JOINT))
    found = diagnose(arm, logs, model, drives_off=zero).document
    (cause,) = found.causes
    places = {cause.effect, *(place.effect for place in cause.equivalent_to)}
    assert ("torque_offset" in places, "asymmetric_friction" in places) == (shows, not shows)
    if shows:
        assert (found.verdict, cause.joints, places) == ("explained", ("joint_2",), {"torque_offset"})
        assert cause.parameters["offset"] == pytest.approx(OFFSET, rel=0.1)
        assert any("its channel has an offset" in text for text in found.warnings)


@pytest.mark.parametrize(
    ("wave", "noise", "warning"),
    [(0.0, 0.0, "is off with its drive"), (8.0, 1.0, "too restless")],
    ids=["dead", "noisy"],
)
def test_a_channel_without_a_signal_or_a_noisy_one_settles_nothing(arm, model, logs, plain, wave, noise, warning):
    zero = at_rest(logs[0], OFFSET * (np.arange(arm.dof) == JOINT))
    slow = wave * np.sin(2 * np.pi * 0.25 * zero.t[:, None])
    found = diagnose(arm, logs, model, drives_off=replace(zero, effort=noise * zero.effort + slow)).document
    assert found.verdict == "ambiguous"
    assert [(c.effect, c.equivalent_to) for c in found.causes] == [(c.effect, c.equivalent_to) for c in plain.causes]
    assert any(warning in text for text in found.warnings)


def test_refuses_a_drives_off_record_with_motor_torque(arm, model, logs):
    arm = replace(arm, joints=tuple(replace(joint, nominal_motor_torque=1.5) for joint in arm.joints))
    zero, nominal = at_rest(logs[0], np.zeros(arm.dof)), arm.nominal_torque
    swing = 0.5 * nominal * np.sin(2 * np.pi * 5 * zero.t[:, None])
    still = np.zeros((1, arm.dof))
    torque, friction = model.predict_parts(zero.position[:1], still, still)
    for effort, message in (
        (zero.effort + swing, "which no motor without current does"),
        (zero.effort + 1.5 * nominal, "that is no zero of a channel"),
        (zero.effort + (torque - friction), "its drives are on"),
    ):
        with pytest.raises(InputError, match=message):
            channel_zero(arm, replace(zero, effort=effort), model)


def test_an_offset_not_seen_in_motion_is_reported_and_settles_nothing(arm, model, logs, plain):
    shown = 20.0 * (np.arange(arm.dof) == 0) + OFFSET * (np.arange(arm.dof) == JOINT)
    found = diagnose(arm, logs, model, drives_off=at_rest(logs[0], shown)).document
    assert {cause.joints for cause in found.causes} == {cause.joints for cause in plain.causes}
    (text,) = [text for text in found.warnings if "in motion no offset of its channel was found" in text]
    assert "joint_1" in text


def test_a_drives_off_record_of_a_healthy_arm_settles_nothing(arm, model, logs):
    plant = Plant(arm, seed=3)
    healthy = [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]
    found = diagnose(arm, healthy, model, drives_off=at_rest(healthy[0], np.zeros(arm.dof))).document
    assert found.verdict == "no_gap"
    assert any("no torque channel shows an offset" in text for text in found.warnings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: replace(log, effort=None), "has no torque"),
        (lambda log: replace(log, position=log.position + 0.1 * log.t[:, None]), r"joint_1 moves by 0\.4 rad"),
        (lambda log: replace(log, t=0.1 * log.t), r"0\.4 s with the drives off are too short"),
        (lambda log: replace(log, **{name: getattr(log, name)[::250] for name in CHANNELS}), "10 samples at least"),
    ],
)
def test_refuses_an_unusable_drives_off_log(arm, model, logs, change, message):
    with pytest.raises(InputError, match=message):
        diagnose(arm, logs, model, drives_off=change(at_rest(logs[0], np.zeros(arm.dof))))


@pytest.mark.verify
def test_a_ruled_out_effect_is_not_asked_about_again(arm, model, logs):
    zero = at_rest(logs[0], np.zeros(arm.dof))
    found = [diagnose(arm, logs, model, drives_off=drives) for drives in (None, zero)]
    asked = [{name for pair in open_pairs(one) for name in pair.names} for one in found]
    assert ["torque_offset" in names for names in asked] == [True, False]
    assert [one.selected.zero_known for one in found] == [False, True]
