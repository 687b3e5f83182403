"""What a healthy arm has of the effects: how much, in which form, from which logs, and what that says of others."""

import tracemalloc
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from agent.diagnosis import diagnose, with_healthy_effects
from agent.diagnosis.hypotheses import healthy
from agent.estimation import estimate
from agent.estimation.signals import filtering
from agent.model import CATALOGUE, HealthyEffect, IdentifiedModel
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record

DELAY, OFFSET = 2e-3, 0.4  # s, N·m
ROBOT = SimpleNamespace(joint_names=("base", "elbow"))


@dataclass(frozen=True)
class Model:
    """As much of a model as is asked for."""

    robot: Any = field(default_factory=lambda: ROBOT)
    cutoff: float = 12.0
    sliding_rmse: Any = None
    noise_share: Any = None
    healthy: tuple[HealthyEffect, ...] = ()


def changed(log, delay=0.0, offset=0.0):
    """A log whose torque is late [s] on all joints, and shifted [N·m] on the second."""
    late = np.stack([np.interp(log.t - delay, log.t, torque) for torque in log.effort.T], axis=1)
    return replace(log, effort=late + [0.0, offset])


@pytest.fixture(scope="module")
def plant() -> Plant:
    return Plant(make_arm("RR"), seed=3)


@pytest.fixture(scope="module")
def model(plant) -> IdentifiedModel:
    """Of an arm whose torque is late, with another offset in each of three logs of slow motions."""
    offsets = {21: -OFFSET, 22: 0.0, 23: OFFSET}
    logs = [changed(record(plant, f"log {k}", k, 0.5), DELAY, offset) for k, offset in offsets.items()]
    return with_healthy_effects(estimate(plant.robot, logs), logs)


def test_an_amount_is_a_parameter_and_its_scatter_is_that_between_logs(plant, model):
    """Of three logs each is 1.5 times as far from the others' mean as from the mean of all."""
    known = {(one.effect, one.joints): one for one in model.healthy}
    assert IdentifiedModel.from_dict(model.to_dict()).healthy == model.healthy
    offset = known["torque_offset", (plant.robot.joint_names[1],)]
    apart = 1.5 * np.array([-OFFSET, 0.0, OFFSET])
    assert offset.amount["offset"] == pytest.approx(np.sqrt(np.sum(apart**2)), rel=0.2)
    mean, deviation = offset.value["offset"]
    assert mean == pytest.approx(0.0, abs=0.2 * OFFSET)
    assert deviation == pytest.approx(np.sqrt(4 / 3) * np.std(apart, ddof=1), rel=0.2)


@pytest.mark.parametrize(("more", "named"), [(0.0, set()), (12e-3, {"time_delay"})])
def test_what_the_arm_has_is_no_fault_on_a_faster_motion(plant, model, more, named):
    """Torque of the same delay is larger there."""
    log = changed(record(plant, "fast", 31), DELAY + more)
    assert {cause["effect"] for cause in diagnose(plant.robot, [log], model).result["causes"]} == named


@pytest.mark.parametrize(("like", "named"), [pytest.param((1, 2), False, marks=pytest.mark.verify), ((2,), True)])
def test_what_most_joints_have_is_no_fault_on_one_that_has_not_shown_it(like, named):
    """Joints whose torque is shifted anew in every log, and a log with a shift of the first joint."""
    plant = Plant(make_arm("RRR"), seed=3)
    scatter = np.isin(np.arange(3), like)
    shifts = {20: 0.0 * scatter, **{k: (k - 22) * OFFSET * scatter for k in (21, 22, 23)}}
    logs = [record(plant, f"log {k}", k, 0.5) for k in shifts]
    logs = [replace(log, effort=log.effort + shift) for log, shift in zip(logs, shifts.values(), strict=True)]
    model = with_healthy_effects(estimate(plant.robot, logs), logs)
    judged = record(plant, "judged", 31, 0.5)
    judged = replace(judged, effort=judged.effort + [2 * OFFSET, 0.0, 0.0])
    causes = diagnose(plant.robot, [judged], model).result["causes"]
    assert bool(causes) == named
    assert all("torque_offset" in {e["effect"] for e in (c, *c["equivalent_to"])} for c in causes)


@pytest.mark.parametrize(
    ("effect", "hidden", "known"),
    [
        ("stribeck", 0.02, [0.01] * 3),
        ("stribeck", 0.01, [0.01] * 3),
        ("stribeck", 0.0099, [0.01]),
        ("torque_offset", 0.02, [0.01]),  # no arm has one by its nature
    ],
)
def test_a_joint_whose_logs_would_not_have_shown_what_another_has_may_have_as_much(effect, hidden, known):
    """Two of three joints show nothing of what one has 1 % of nominal torque of."""
    more = {"effect": CATALOGUE[effect], "transient": False, "settings": {}, "names": ("amount",)}
    forms = [SimpleNamespace(key=(effect, (joint,)), joints=(joint,), **more) for joint in range(3)]
    log = SimpleNamespace(
        gains=np.array([5.0, -3.0, -3.0]),
        torque=np.array([0.01 / np.sqrt(3), 0.0, 0.0]),
        detection_limit=np.full(3, hidden),
        rms=[np.ones(1)] * 3,
        values=[np.zeros(1)] * 3,
    )
    effects = healthy._effects(forms, [log] * 3, ("a", "b", "c"))
    assert [size for size, _ in effects.values()] == pytest.approx(known)


def test_torque_that_the_recorder_of_the_only_log_delays_is_no_fault(plant):
    logs = [changed(record(plant, *motion), 6e-3) for motion in (("only", 21, 0.5), ("new", 31))]
    plain = estimate(plant.robot, logs[:1])
    model = with_healthy_effects(plain, logs[:1])
    assert "time_delay" in {entry.effect for entry in model.healthy}
    assert [diagnose(plant.robot, logs[1:], one).result["causes"] for one in (plain, model)] == [[], []]


def filtered(monkeypatch, work):
    """How many samples pass a filter: most of the time goes there, and other jobs on the machine do not change it."""
    count, respond = [0], filtering._respond

    def counted(signals, *more):
        count[0] += signals.size
        return respond(signals, *more)

    monkeypatch.setattr(filtering, "_respond", counted)
    found = work()
    monkeypatch.setattr(filtering, "_respond", respond)
    return found, count[0]


def test_work_grows_with_the_logs_and_stays_near_that_of_the_fit(plant, monkeypatch):
    """Raise no figure here without a reason: learning filters 3.8 times the fit's samples and 2.0 times as many with
    twice the logs, a diagnosis of as many logs 4.1 times."""
    logs, spent, fits = [record(plant, f"log {k}", k, 0.5) for k in (21, 22, 23, 24)], {}, {}
    for count in (2, 4):
        fitted, fits[count] = filtered(monkeypatch, lambda count=count: estimate(plant.robot, logs[:count]))
        known, learning = filtered(
            monkeypatch, lambda fitted=fitted, count=count: with_healthy_effects(fitted, logs[:count])
        )
        assert learning < 4.2 * fits[count]
        spent[count] = learning
    assert spent[4] < 2.1 * spent[2]
    (_, one), (_, two) = (
        filtered(monkeypatch, lambda count=count: diagnose(plant.robot, logs[:count], known)) for count in (1, 2)
    )
    assert two < 2.5 * one
    assert two < 4.5 * fits[2]


def test_memory_of_a_diagnosis_is_bounded_for_each_sample(plant):
    """Do not raise the figure without a reason: a diagnosis takes 1500 bytes for a sample of a joint."""
    logs = [record(plant, f"log {k}", k, 0.5) for k in (21, 22)]
    model = estimate(plant.robot, logs)
    diagnose(plant.robot, logs[:1], model)  # what is imported and kept once
    tracemalloc.start()
    try:
        diagnose(plant.robot, logs, model)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1700 * sum(log.position.size for log in logs)


def test_only_the_first_half_minute_of_a_log_is_looked_at(monkeypatch):
    def log(last):
        return SimpleNamespace(t=np.array([5.0, 6.0, last]), between=lambda *times: SimpleNamespace(t=np.array(times)))

    seen, nothing = [], SimpleNamespace(gains=np.empty(0), noise_share=np.ones(2))
    monkeypatch.setattr(healthy, "_judged", lambda model, logs: ([1.0], [], (seen.extend(logs), [nothing])[1]))
    assert healthy.with_healthy_effects(Model(), [log(70.0)], [log(35.0), log(35.1)]).healthy == ()
    assert [one.t.tolist() for one in seen] == [[5.0, 6.0, 35.0], [5.0, 35.0]]
    assert [hasattr(one, "between") for one in seen] == [True, False]


def test_what_an_arm_has_on_other_logs(monkeypatch):
    """Not of effects and joints that nobody knows any more, of forms that have other parameters, or `without`."""
    monkeypatch.setattr(healthy, "CATALOGUE", {"spring": "a spring", "offset": "an offset"})

    def candidates(wanted, rough):
        return [SimpleNamespace(of=one, stable=one[1] != (1,), names=("a", "b")) for one in wanted]

    amount, value = {"b": 2.0, "a": 1.0}, {"b": (0.2, 0.04), "a": (0.1, 0.03)}
    told = [
        *(("gone", ("base",), {}, amount), ("spring", ("base",), {"speed": 7.0}, amount, value)),
        *(("offset", ("base",), {}, amount), ("spring", ("base",), {}, {"a": 1.0}), ("spring", ("elbow",), {}, amount)),
        *(("spring", ("wrist",), {}, amount), ("spring", ("base", "elbow"), {}, amount)),
    ]
    model, fit = Model(healthy=tuple(HealthyEffect(*one) for one in told)), SimpleNamespace(candidates=candidates)
    found = healthy.healthy_on(fit, model, ("offset",))
    assert [one.candidate.of for one in found] == [("a spring", (0,), {"speed": 7.0}), ("a spring", (0, 1), {})]
    assert [one.amount.tolist() for one in found] == [[1.0, 2.0]] * 2
    assert (found[0].mean.tolist(), found[0].deviation.tolist()) == ([0.1, 0.2], [0.03, 0.04])
    assert (found[1].mean, found[1].deviation) == (None, None)
    assert len(healthy.healthy_on(fit, model)) == 3
    assert healthy.healthy_on(fit, Model()) is None


@pytest.mark.parametrize(
    ("logs_of_fit", "size", "verdict"), [(3, 0.35, "unknown"), (3, 0.1, "no_gap"), (1, 0.35, "no_gap")]
)
def test_a_joint_that_errs_by_more_than_chance_has_a_gap_though_no_effect_is_known(plant, logs_of_fit, size, verdict):
    """Friction that varies smoothly along the way, which the noise model takes for the model's own error.

    A model of one log may err as much on another motion.
    """
    baseline = [record(plant, f"log {k}", k) for k in (21, 22, 23)][:logs_of_fit]
    model = with_healthy_effects(estimate(plant.robot, baseline), baseline)
    logs = [record(plant, f"judged {k}", k) for k in (31, 32)]
    for number, log in enumerate(logs):
        way = log.position[:, 1]
        part = (way - way.min()) / np.ptp(way)
        drag = size * np.tanh(log.velocity[:, 1] / 0.02) * np.cos(np.pi * part)
        logs[number] = replace(log, effort=log.effort + np.column_stack([0 * drag, drag]))
    assert diagnose(plant.robot, logs, model, without=list(CATALOGUE)).verdict == verdict
