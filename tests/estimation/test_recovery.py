"""What estimation must give back when the data hold the answer."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from agent.core.errors import InputError
from agent.estimation import EstimationSettings, FilterSettings, estimate
from agent.estimation.estimators import weighted
from agent.estimation.partition import partition
from agent.estimation.prior import link_prior
from agent.estimation.problem import Problem
from agent.estimation.selection import paper_terms
from agent.estimation.signals.observation import observe
from agent.model.friction_terms import AxleMotion, FrictionTerm, Reversal, axle_columns
from agent.robot.bodies import rigid_bodies

PAPER = EstimationSettings.create(method="weighted", friction="paper")


def torque_of(robot, rigid, terms, values, q, qd, qdd):
    """(S, n) of base parameters and friction terms, by their definition."""
    links = rigid.columns(q, qd, qdd) @ values[: rigid.count]
    friction = axle_columns(terms, AxleMotion.of(robot, q, qd, links)) * values[rigid.count :]
    return links + friction @ robot.coupling[[term.axle for term in terms]]


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    dof=st.integers(1, 7),
    seed=st.integers(0, 10_000),
    slides=st.sets(st.integers(0, 6), max_size=2),
    coupled=st.booleans(),
)
def test_any_parameters_are_recovered(arm, multisine, make_log, dof, seed, slides, coupled):
    coupling = np.eye(dof)
    if coupled and dof > 1:
        coupling[-1, -2] = 0.5
    robot = arm(dof, tuple(slides), coupling)
    rng = np.random.default_rng(seed)
    t = np.arange(10_000) / 500
    q, qd, qdd = multisine(dof, t, seed, 3.0, rest=True)
    rigid = rigid_bodies(robot)
    terms = paper_terms([Reversal("speed", 0.05)] * dof)
    start = observe(rigid, [make_log(robot, t, q, 10 * qd + 50)], FilterSettings())
    mean, deviation = link_prior(start)
    standard = rng.normal(mean, deviation)
    values = np.append(rigid.projection @ standard, rng.normal(size=len(terms)))
    log = make_log(robot, t, q, torque_of(robot, rigid, terms, values, q, qd, qdd))
    observation = observe(rigid, [log], FilterSettings())
    found = weighted(Problem.pose(observation, partition(observation.segments), terms))
    scale = np.abs(values) + np.append(np.full(rigid.count, 1e-3), np.ones(len(terms)))
    assert np.max(np.abs(found.parameters - values) / scale) < 2e-6


@pytest.fixture(scope="module")
def case(arm, multisine, make_log):
    """A three-joint arm, its motion, the torque of known parameters, and noise."""
    robot = arm(3)
    t = np.arange(6000) / 500
    q, qd, qdd = multisine(3, t)
    rigid = rigid_bodies(robot)
    terms = paper_terms([Reversal()] * 3)
    standard = np.append(rigid.dynamics.standard_parameters() * 1.1, np.full(3, 1.3e-4))
    values = np.append(rigid.projection @ standard, np.tile([3.0, 2.0, 0.3], 3))
    torque = torque_of(robot, rigid, terms, values, q, qd, qdd)
    noise = np.random.default_rng(0).normal(size=torque.shape) * [0.5, 0.5, 5.0]
    return robot, t, q, torque, noise, values


@pytest.fixture(scope="module")
def noisy(case, make_log):
    robot, t, q, torque, noise, _ = case
    return make_log(robot, t, q, torque + noise)


def test_least_squares_is_linear_in_the_torque(case, multisine, make_log):
    robot, t, q, torque, *_ = case
    one = estimate(robot, [make_log(robot, t, q, torque)], PAPER)
    twice = estimate(robot, [make_log(robot, t, q, 2 * torque)], PAPER)
    braked = estimate(robot, [make_log(robot, t, q, torque + 1.5 * multisine(3, t)[1])], PAPER)
    assert np.allclose(twice.values, 2 * one.values, rtol=1e-5, atol=1e-4)
    more = np.where([name.startswith("f1") for name in one.names], 1.5, 0.0)
    assert np.allclose(braked.values, one.values + more, rtol=1e-5, atol=1e-4)


def test_units_of_a_column_do_not_matter(case, noisy):
    """Gears ten times faster: rotor inertias a hundredth, all else as it was."""
    robot, *_ = case
    changed = [{"gear_ratio": 10 * j.gear_ratio, "rotor_inertia": j.rotor_inertia / 100} for j in robot.joints]
    fast = replace(robot, joints=tuple(replace(j, **new) for j, new in zip(robot.joints, changed, strict=True)))
    one, two = estimate(robot, [noisy], PAPER), estimate(fast, [noisy], PAPER)
    factor = np.where(one.independent >= 30, 100.0, 1.0)
    assert np.allclose(two.base_values * factor, one.base_values, rtol=1e-6, atol=1e-9)
    assert np.allclose(two.held_out_rmse, one.held_out_rmse, rtol=1e-6)


def test_the_order_of_logs_does_not_matter(case, make_log):
    robot, t, q, torque, noise, _ = case
    halves = [make_log(robot, t[k : k + 3000], q[k : k + 3000], (torque + noise)[k : k + 3000]) for k in (0, 3000)]
    forward, backward = estimate(robot, halves, PAPER), estimate(robot, halves[::-1], PAPER)
    assert np.allclose(forward.values, backward.values, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("method", ["weighted", "huber", "consistent", "paper"])
def test_every_method_finds_the_parameters_in_noise(case, noisy, method):
    robot, *_, noise, values = case
    model = estimate(robot, [noisy], EstimationSettings.create(method=method, friction="paper"))
    assert model.method == method
    assert np.all(np.abs(model.values - values) < 5 * model.standard_deviations + 1e-9)
    assert np.all(model.residual_rmse < 1.1 * np.sqrt(np.mean(noise**2, axis=0)))
    if method == "weighted":
        assert model.weights[0, 0] / model.weights[0, 2] == pytest.approx(100, rel=0.3), "a noisy joint gets little"


def test_auto_explains_its_choice(case, noisy):
    model = estimate(case[0], [noisy])
    assert model.method in ("weighted", "huber", "consistent")
    assert any(f"Method: {model.method}" in note for note in model.notes)


def test_huber_is_less_sensitive_to_knocks(case, make_log):
    robot, t, q, torque, noise, values = case
    knocked = torque + 0.1 * noise
    knocked[2000:2300] += 60.0
    log = make_log(robot, t, q, knocked)
    plain, robust = (
        estimate(robot, [log], EstimationSettings.create(method=m, friction="paper")) for m in ("weighted", "huber")
    )
    probe = [100, 2500, 4000, 5500]
    motion = (q[probe], np.gradient(q, t, axis=0)[probe], np.zeros((4, 3)))
    truth = replace(plain, values=values).predict(*motion)
    assert np.abs(robust.predict(*motion) - truth).max() < 0.5 * np.abs(plain.predict(*motion) - truth).max()


def test_the_default_cutoff_takes_the_bias_of_noisy_positions_away(arm, multisine, make_log):
    """At 30 Hz noise in q̈ makes least squares see too little inertia; the default chooses a lower cut-off."""
    robot = arm(1)
    t = np.arange(10_000) / 500
    q, qd, qdd = multisine(1, t, 3, 3.0)
    rigid = rigid_bodies(robot)
    terms = paper_terms([Reversal()])
    values = np.append(rigid.projection @ np.append(rigid.dynamics.standard_parameters(), 1e-4), [1.0, 1.0, 0.1])
    torque = torque_of(robot, rigid, terms, values, q, qd, qdd)
    noisy = q + np.random.default_rng(0).normal(size=q.shape) * 1e-3
    log = make_log(robot, t, noisy, torque)
    inertia = int(np.flatnonzero(rigid.independent == 9)[0])

    def ratio(cutoff):
        settings = EstimationSettings.create(cutoff, "weighted", friction="paper")
        return estimate(robot, [log], settings).values[inertia] / values[inertia]

    plain = ratio(30.0)
    assert plain < 0.97
    assert abs(ratio(None) - 1) < 0.3 * abs(plain - 1)


@pytest.mark.parametrize("thin", [1.0, 0.1])
def test_the_consistent_fit_gives_physical_bodies(case, multisine, make_log, thin):
    """Also where the data ask for less inertia than the first moments of a link allow."""
    robot, t, q, _, noise, values = case
    rigid = rigid_bodies(robot)
    bodies = 1.1 * rigid.dynamics.standard_parameters().reshape(3, 10) * np.where(np.arange(10) < 4, 1.0, thin)
    asked = np.append(rigid.projection @ np.append(bodies, np.full(3, 1.3e-4)), values[rigid.count :])
    torque = torque_of(robot, rigid, paper_terms([Reversal()] * 3), asked, *multisine(3, t))
    short = slice(0, 1500)
    log = make_log(robot, t[short], q[short], torque[short] + 10 * thin * noise[short])
    model = estimate(robot, [log], EstimationSettings.create(method="consistent", friction="paper"))
    links, rotors = np.split(model.standard, [30])
    for m, mx, my, mz, xx, xy, yy, xz, yz, zz in links.reshape(-1, 10):
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        pseudo = np.zeros((4, 4))
        pseudo[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        pseudo[:3, 3] = pseudo[3, :3] = mx, my, mz
        pseudo[3, 3] = m
        assert np.linalg.eigvalsh(pseudo).min() > 0
    assert np.all(rotors > -1e-12)
    friction = {
        term.name: value for term, value in zip(model.terms, model.values[len(model.base_values) :], strict=True)
    }
    assert min(value for name, value in friction.items() if name.startswith(("f0", "f1"))) > -1e-9
    assert np.allclose(model.projection @ model.standard, model.base_values, atol=1e-9)


def test_unexcited_parameters_stay_near_the_urdf_and_are_named(arm, multisine, make_log):
    robot = arm(3)
    t = np.arange(6000) / 500
    q, qd, qdd = multisine(3, t)
    for signal in (q, qd, qdd):
        signal[:, 1:] = 0.0  # only the first, vertical axis turns
    rigid = rigid_bodies(robot)
    terms = paper_terms([Reversal()] * 3)
    values = np.append(rigid.projection @ np.append(rigid.dynamics.standard_parameters(), np.full(3, 1e-4)), np.ones(9))
    torque = torque_of(robot, rigid, terms, values, q, qd, qdd)
    torque += np.random.default_rng(0).normal(size=torque.shape)
    model = estimate(robot, [make_log(robot, t, q, torque)], PAPER)
    assert np.all(np.abs(model.base_values - values[: rigid.count]) < 3 * model.standard_deviations[: rigid.count])
    assert np.abs(model.base_values).max() < 3 * np.abs(values[: rigid.count]).max()
    note = next(note for note in model.notes if "Record more varied motion" in note)
    assert "f1_2" in note or "f2_2" in note or "f0_2" in note
    assert not np.isfinite(model.condition_number) or model.condition_number > 1000
    assert any("condition number" in note.lower() for note in model.notes)


def test_refuses_logs_without_data_to_fit(case, make_log):
    robot, t, q, torque, _, _ = case
    with pytest.raises(InputError, match="no logs"):
        estimate(robot, [])
    with pytest.raises(InputError, match=r"silent\.mcap.*no torque"):
        estimate(robot, [make_log(robot, t, q, None, name="silent.mcap")])
    with pytest.raises(InputError, match=r"other\.mcap: its joints are"):
        estimate(robot, [replace(make_log(robot, t, q, torque, name="other.mcap"), joint_names=("a", "b", "c"))])
    twice = [make_log(robot, t, q, torque, name=name) for name in ("one.mcap", "copy.mcap")]
    with pytest.raises(InputError, match=r"one\.mcap and copy\.mcap are the same recording"):
        estimate(robot, twice)
    with pytest.raises(InputError, match="method 'magic' is not known; choose one of auto, weighted"):
        EstimationSettings.create(method="magic")


def test_friction_follows_the_coupling_of_the_motors(arm, multisine, make_log):
    """Coulomb friction of the coupled motor brakes both joints."""
    coupling = np.eye(2)
    coupling[1, 0] = 1.0
    robot = arm(2, coupling=coupling)
    terms = (FrictionTerm(1, "coulomb", Reversal()),)
    q, qd, _ = multisine(2, np.arange(100) / 500)
    friction = axle_columns(terms, AxleMotion.of(robot, q, qd)) @ coupling[[1]]
    assert np.allclose(friction[:, 0], np.sign(qd[:, 0] + qd[:, 1]))
    assert np.allclose(friction[:, 1], friction[:, 0])


def test_logs_of_different_rates_get_one_filter(case, make_log):
    robot, t, q, torque, noise, values = case
    slow, fast = make_log(robot, t[::10], q[::10], torque[::10]), make_log(robot, t, q, torque + noise)
    model = estimate(robot, [fast, slow], PAPER)
    assert model.cutoff == pytest.approx(15.0)
    assert np.all(np.abs(model.values - values) < 5 * model.standard_deviations + 0.1)
