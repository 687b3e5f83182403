"""Where a joint turns back, dry friction holds it until the torque is large enough: what it is meanwhile is no gap."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.diagnosis import diagnose, with_healthy_effects
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.standstill import StandstillWhitening, stiction
from agent.estimation import EstimationSettings, estimate
from agent.model import CATALOGUE, IdentifiedModel
from agent.recording.log import Log
from agent.robot import Dynamics, RobotDescription
from tests.estimation.conftest import _arm, _links, _log, _multisine

COULOMB = 12.0  # N·m, of 100 nominal
RATE = 250.0  # Hz
HELD = 0.08  # s, at most
AWAY = 0.6  # rad, from where a joint that stands all through one log moves in another


def _record(robot: RobotDescription, seed: int, held: float, at_least: float = 0.0) -> Log:
    """A motion of one joint that is held for `at_least` to `held` [s] wherever it turns back."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 12, 1 / RATE)
    moves = _multisine(1, time, seed)
    turns = np.flatnonzero(np.diff(np.sign(moves[1][:, 0])))
    pauses = rng.integers(int(at_least * RATE), int(held * RATE) + 1, len(turns))
    at = np.insert(np.arange(len(time)), np.repeat(turns + 1, pauses), np.repeat(turns, pauses))
    still = np.diff(at, prepend=-1) == 0
    q = moves[0][at]
    qd, qdd = (np.where(still[:, None], 0.0, part[at]) for part in moves[1:])
    slides = np.sign(qd)
    for turn, pause in zip(turns, pauses, strict=True):
        stuck = np.flatnonzero((at == turn) & still)
        slides[stuck, 0] = np.linspace(*rng.uniform(-1, 1, 2), pause)
    torque = _links(robot, q, qd, qdd) + COULOMB * slides + 4 * qd + 0.1 * rng.normal(size=q.shape)
    return _log(robot, np.arange(len(q)) / RATE, q, torque, f"{seed}.mcap")


def test_stiction_at_a_reversal_is_not_a_gap():
    robot = _arm(1)
    model = estimate(robot, [_record(robot, seed, 0.0) for seed in (1, 2)], EstimationSettings.create(cutoff=20))
    found = diagnose(robot, [_record(robot, seed, HELD) for seed in (3, 4)], model, without=list(CATALOGUE))
    assert np.sqrt(np.mean(found.dataset.residual**2)) > 0.01 * robot.nominal_torque[0], "the error is there"
    assert found.document.verdict == "no_gap"


@pytest.mark.parametrize("held", [0.0, 0.3])
def test_a_reversal_leaves_open_the_part_of_the_filters_window_in_which_the_joint_stands(held):
    """All that stiction may be in the middle of a long one, little of it where it passes between two rows."""
    robot = _arm(1)
    logs = [_record(robot, seed, held, held) for seed in (1, 2)]
    fit = assemble(robot, estimate(robot, logs, EstimationSettings.create(cutoff=20)), logs, None).fit
    moving, level = fit.sigma.min(), stiction(fit.reference)[0] / np.sqrt(3)
    for log, signals, sigma in zip(logs, fit.signals, fit.sigmas, strict=True):
        kept = signals.time[signals.kept]
        turns = log.t[:-1][np.diff(np.sign(np.diff(log.position[:, 0])), append=0.0) != 0]
        away = np.min(np.abs(kept[:, None] - turns), axis=1)
        inside = np.interp(kept, log.t, np.abs(np.gradient(log.position[:, 0]))) == 0
        assert sigma[~inside & (away > 0.1), 0].max() < 1.5 * moving
        if held:
            assert sigma[inside & (away > 0.1), 0].min() > 0.95 * level
        else:
            assert 2 * moving < sigma[away < 0.01, 0].min() < sigma[:, 0].max() < 0.5 * level


def test_the_error_of_a_model_leaves_out_what_stiction_leaves_open():
    """Its rows in motion include some that the filter reaches from a joint that is held."""
    robot = _arm(1)
    logs = [_record(robot, seed, HELD) for seed in (1, 2, 3)]
    model = with_healthy_effects(estimate(robot, logs, EstimationSettings.create(cutoff=20)), logs)
    assert model.sliding_rmse < 0.5 * model.group_rmse[0]
    assert IdentifiedModel.from_dict(model.to_dict()).sliding_rmse == model.sliding_rmse


def _beside(robot: RobotDescription, seed: int, offset: float, stuck: float | None = None) -> Log:
    """A motion of two joints, or of the second while stiction holds the first with `stuck` of its level."""
    time = np.arange(0, 12, 1 / RATE)
    q, qd, qdd = _multisine(2, time, seed)
    friction = np.sign(qd)
    if stuck is not None:
        qd[:, 0] = qdd[:, 0] = 0.0
        q[:, 0], friction[:, 0] = q[:, 0].max() + AWAY, stuck
    noise = 0.1 * np.random.default_rng(seed).normal(size=q.shape)
    torque = _links(robot, q, qd, qdd) + COULOMB * friction + 4 * qd + [offset, 0] + noise
    return _log(robot, time, q, torque, f"{seed}.mcap")


@pytest.mark.parametrize("stuck", [-0.9, 0.9])
def test_stiction_of_a_stationary_joint_is_not_evidence(stuck):
    robot = _arm(2)
    model = estimate(robot, [_beside(robot, seed, 0.0) for seed in (1, 2)], EstimationSettings.create(cutoff=20))
    found = diagnose(robot, [_beside(robot, 3, 4.0), _beside(robot, 4, 4.0, stuck)], model)
    assert found.document.verdict == "ambiguous"
    first = found.document.causes[0]
    assert {first.effect, *(e.effect for e in first.equivalent_to)} == {"torque_offset", "asymmetric_friction"}


def test_a_joint_that_never_moves_has_no_gap_below_its_stiction():
    """Any constant torque up to the Coulomb level is right there: it is nothing that is not known."""
    robot = _arm(2)
    model = estimate(robot, [_beside(robot, seed, 0.0) for seed in (1, 2)], EstimationSettings.create(cutoff=20))
    for stuck in (1.0, -1.0):
        found = diagnose(robot, [_beside(robot, 4, 0.0, stuck)], model)
        assert found.document.verdict == "no_gap"
        assert found.document.gap.before[0] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(("force", "named"), [(2000.0, True), (80.0, False)])
def test_a_push_above_stiction_is_seen_at_a_stationary_joint(force, named):
    robot = _arm(2)
    model = estimate(robot, [_beside(robot, seed, 0.0) for seed in (1, 2)], EstimationSettings.create(cutoff=20))
    pushed = _beside(robot, 4, 0.0, 0.5)
    inside = (pushed.t > 5.0) & (pushed.t < 6.2)
    jacobian = Dynamics(robot).tcp_jacobian(pushed.position)[:, 0:3]
    sideways = jacobian[:, :, 0] / np.linalg.norm(jacobian[:, :, 0], axis=1, keepdims=True)  # no torque on joint 2
    torque = force * np.einsum("sij,si->sj", jacobian, sideways) * inside[:, None]
    assert bool(np.abs(torque[:, 0]).max() > 2 * COULOMB) is named
    found = diagnose(robot, [replace(pushed, effort=pushed.effort - torque), _beside(robot, 3, 0.0)], model)
    assert (found.document.verdict == "no_gap") is not named


@given(lengths=st.lists(st.integers(60, 400), min_size=1, max_size=3), repeat=st.sampled_from([1.0, 10.0, 25.0]))
@settings(max_examples=20, deadline=None)
def test_a_rest_counts_as_under_one_sample_for_constant_torque_and_fully_for_a_ramp(lengths, repeat):
    stretches, first = [], 50
    for length in lengths:
        stretches.append((first, first + length, length / repeat))
        first += length + 50
    rests = StandstillWhitening((tuple(stretches), ()))
    inside = np.concatenate([np.arange(a, b) for a, b, _ in stretches])
    constant, ramp = np.zeros((first, 1)), np.zeros((first, 1))
    constant[inside] = 1.0
    for a, b, _ in stretches:
        ramp[a:b, 0] = np.linspace(-1, 1, b - a)
    told = np.sum(rests.whitened(0, constant) ** 2) / repeat  # in independent rows
    count = np.array([n for *_, n in stretches])
    assert told == pytest.approx(np.sum(count / (1 + count)))  # 1ᵀ (I + 1 1ᵀ)⁻¹ 1
    assert np.allclose(rests.whitened(0, ramp), ramp)
    assert np.array_equal(rests.whitened(1, constant), constant)
