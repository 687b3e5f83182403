"""Friction: its forms, how reversals are learned, and which terms the select_friction_terms takes."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.estimation import EstimationSettings, estimate
from agent.estimation.selection import paper_terms
from agent.model.friction_terms import AxleMotion, FrictionTerm, Reversal, axle_columns, dahl, steady_columns
from agent.robot.bodies import rigid_bodies
from agent.validation import predict_log


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), size=st.integers(1, 400), travel=st.floats(0.01, 10))
def test_dahl_friction_equals_the_step_by_step_form(seed, size, travel):
    path = np.cumsum(np.random.default_rng(seed).normal(size=size))
    state, expected = 0.0, []
    for step in np.diff(path, prepend=path[:1]):
        state = np.sign(step) - (np.sign(step) - state) * np.exp(-abs(step) / travel)
        expected.append(state)
    assert np.allclose(dahl(path, np.array([travel]))[:, 0], expected, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(travel=st.floats(1e-5, 1e-2), stop=st.floats(0.1, 1.0))
def test_presliding_state_survives_a_stop_and_decays_with_travel(travel, stop):
    there = np.linspace(0, 20 * travel, 200)
    path = np.concatenate([there, np.full(50, there[-1]), there[-1] - there])
    state = dahl(path, np.array([travel]))[:, 0]
    assert state[199] == pytest.approx(1, abs=1e-6)
    assert state[249] == pytest.approx(state[199])
    assert state[-1] == pytest.approx(-1, abs=1e-6)
    assert np.abs(state).max() <= 1


def test_the_paper_s_terms_are_its_formula():
    speed = np.array([[-2.0], [0.0], [3.0]])
    columns = axle_columns(paper_terms([Reversal()]), AxleMotion(speed, speed))
    assert np.array_equal(columns, [[-1, -2, -4], [0, 0, 0], [1, 3, 9]])


def test_friction_terms_match_their_formulas():
    speed, load = np.array([[-0.5], [2.0]]), np.array([[-3.0], [4.0]])
    sharp = Reversal("speed", 1e-6)
    terms = (
        FrictionTerm(0, "offset"),
        FrictionTerm(0, "viscous_asymmetry"),
        FrictionTerm(0, "stribeck", sharp, 0.5),
        FrictionTerm(0, "load", sharp),
    )
    columns = axle_columns(terms, AxleMotion(speed, speed, load))
    assert np.allclose(columns, [[1, 0.5, -np.exp(-1), -3], [1, 2.0, np.exp(-4), 4]])


@pytest.mark.parametrize("reversal", [Reversal(), Reversal("speed", 0.4), Reversal("travel", 1e-3)])
@pytest.mark.parametrize("speed", [-1.5, -0.2, 0.3, 2.0])
def test_steady_friction_is_the_limit_of_a_long_slide(reversal, speed):
    terms = (*paper_terms([reversal]), FrictionTerm(0, "offset"), FrictionTerm(0, "stribeck", reversal, 0.5))
    terms = (*terms, FrictionTerm(0, "viscous_asymmetry"), FrictionTerm(0, "load", reversal))
    way = speed * np.arange(100.0)[:, None]
    long_after = axle_columns(terms, AxleMotion(way, np.full_like(way, speed), np.zeros_like(way)))[-1]
    assert np.allclose(steady_columns(terms, np.array([speed, 0.0])), [long_after, np.zeros(len(terms))], rtol=1e-12)
    full = steady_columns(terms, np.array([speed]), sharp=True)
    assert full[0, 0] == np.sign(speed)


@pytest.fixture(scope="module")
def machine(arm, multisine, make_log):
    """`machine(terms, values, seed, stops)` → log of a two-joint arm with that friction, a little noise, and stops."""
    robot = arm(2)
    rigid = rigid_bodies(robot)
    links = rigid.projection @ np.append(rigid.dynamics.standard_parameters(), np.full(2, 1e-4))

    def run(terms, values, seed=0, name="a.mcap", seconds=20):
        t = np.arange(seconds * 500) / 500
        phase = t + 0.45 * np.sin(2 * np.pi * t / 4) * 4 / 2 / np.pi / 0.45 * 0.98  # nearly stops every four seconds
        speed = np.gradient(phase, t)
        acceleration = np.gradient(speed, t)
        q, q1, q2 = multisine(2, phase, seed)
        qd, qdd = q1 * speed[:, None], q2 * speed[:, None] ** 2 + q1 * acceleration[:, None]
        rigid_torque = rigid.torque(q, qd, qdd, links)
        columns = axle_columns(terms, AxleMotion.of(robot, q, qd, rigid_torque))
        torque = rigid_torque + columns * values @ robot.coupling[[term.axle for term in terms]]
        noise = np.random.default_rng(seed).normal(size=torque.shape) * 0.05
        return make_log(robot, t, q, torque + noise, name=name)

    return robot, run


@pytest.mark.parametrize("reversal", [Reversal("speed", 0.02), Reversal("travel", 4e-4)])
def test_estimates_the_reversal_width(machine, reversal):
    robot, run = machine
    terms = paper_terms([reversal] * 2)
    values = np.tile([3.0, 1.0, 0.1], 2)
    model = estimate(robot, [run(terms, values)], EstimationSettings.create(method="weighted"))
    for found in (term.reversal for term in model.terms if term.form == "coulomb"):
        assert found.kind == reversal.kind
        assert found.scale == pytest.approx(reversal.scale, rel=0.4)
    unseen = predict_log(model, run(terms, values, seed=5))
    assert np.sqrt(np.mean(unseen.error**2, axis=0)).max() < 0.05


def test_adds_friction_terms_that_the_data_show(machine):
    robot, run = machine
    reversal = Reversal("speed", 0.02)
    extra = (FrictionTerm(0, "viscous_asymmetry"), FrictionTerm(1, "stribeck", reversal, 0.15))
    terms = (*paper_terms([reversal] * 2), *extra)
    values = np.array([3.0, 1.0, 0.1, 3.0, 1.0, 0.1, 0.4, 1.5])
    model = estimate(robot, [run(terms, values)], EstimationSettings.create(method="weighted"))
    names = [term.name for term in model.terms]
    assert "f1_asymmetry_1" in names
    assert "stribeck_2" in names
    assert model.values[list(model.names).index("f1_asymmetry_1")] == pytest.approx(0.4, abs=0.05)
    assert "f1_asymmetry_2" not in names


def test_adds_no_friction_terms_that_the_data_do_not_show(machine):
    robot, run = machine
    terms = paper_terms([Reversal("speed", 0.02)] * 2)
    model = estimate(robot, [run(terms, np.tile([3.0, 1.0, 0.1], 2))], EstimationSettings.create(method="weighted"))
    assert [term.form for term in model.terms if term.form != "offset"] == ["coulomb", "viscous", "quadratic"] * 2


def test_stiction_at_standstill_is_down_weighted(arm, make_log):
    """At rest friction is anything within stiction: here it pushes the held torque off the gravity torque."""
    robot = arm(2)
    rigid = rigid_bodies(robot)
    links = rigid.projection @ np.append(rigid.dynamics.standard_parameters(), np.full(2, 1e-4))
    rng = np.random.default_rng(0)
    period, t = 2.0, np.arange(20_000) / 500
    number, inside = np.divmod(t, period)
    s = np.clip(inside / 1.0, 0, 1)
    ramp = s**3 * (10 - 15 * s + 6 * s**2)
    points = rng.uniform(-1, 1, (21, 2))
    start, end = points[number.astype(int)], points[number.astype(int) + 1]
    q = start + (end - start) * ramp[:, None]
    qd = np.gradient(q, t, axis=0)
    moving = (inside < 1.0)[:, None]
    stuck = np.repeat(rng.uniform(-3, 3, (20, 2)), 1000, axis=0)
    torque = rigid.torque(q, qd, np.gradient(qd, t, axis=0), links)
    torque += np.where(moving, 3.0 * np.sign(qd) + qd, stuck) + 0.02 * rng.normal(size=q.shape)
    model = estimate(
        robot, [make_log(robot, t, q, torque)], EstimationSettings.create(method="weighted", friction="paper")
    )
    error = model.base_values - links
    gravity = [k for k, name in enumerate(model.names[: rigid.count]) if name.startswith("m")]
    assert gravity
    assert np.abs(error[gravity]).max() < 0.05
    assert np.all(model.weights[1] < 0.05 * model.weights[0])
    assert any("Standstill" in note for note in model.notes)
