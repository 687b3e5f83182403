"""Where a joint turns back, dry friction holds it until the torque is large enough: what it is meanwhile is no gap."""

from __future__ import annotations

import numpy as np

from agent.diagnosis import diagnose
from agent.estimation import EstimationSettings, estimate
from agent.model import CATALOGUE
from agent.recording.log import Log
from agent.robot import RobotDescription
from agent.robot.bodies import rigid_bodies
from tests.estimation.conftest import _arm, _log, _multisine

COULOMB = 12.0  # N·m, of 100 nominal
RATE = 250.0  # Hz
HELD = 0.08  # s, at most


def _record(robot: RobotDescription, seed: int, held: float) -> Log:
    """A motion of one joint that is held for up to `held` [s] wherever it turns back."""
    rigid, _, _ = rigid_bodies(robot)
    rng = np.random.default_rng(seed)
    time = np.arange(0, 12, 1 / RATE)
    moves = _multisine(1, time, seed)
    turns = np.flatnonzero(np.diff(np.sign(moves[1][:, 0])))
    pauses = rng.integers(0, int(held * RATE) + 1, len(turns))
    at = np.insert(np.arange(len(time)), np.repeat(turns + 1, pauses), np.repeat(turns, pauses))
    still = np.diff(at, prepend=-1) == 0
    q = moves[0][at]
    qd, qdd = (np.where(still[:, None], 0.0, part[at]) for part in moves[1:])
    slides = np.sign(qd)
    for turn, pause in zip(turns, pauses, strict=True):
        stuck = np.flatnonzero((at == turn) & still)
        slides[stuck, 0] = np.linspace(*rng.uniform(-1, 1, 2), pause)
    bodies = rigid.projection @ np.append(rigid.dynamics.standard_parameters(), 1e-4)
    torque = rigid.torque(q, qd, qdd, bodies) + COULOMB * slides + 4 * qd + 0.1 * rng.normal(size=q.shape)
    return _log(robot, np.arange(len(q)) / RATE, q, torque, f"{seed}.mcap")


def test_dry_friction_that_holds_a_joint_where_it_turns_back_is_no_gap():
    robot = _arm(1)
    model = estimate(robot, [_record(robot, seed, 0.0) for seed in (1, 2)], EstimationSettings.create(cutoff=20))
    found = diagnose(robot, [_record(robot, seed, HELD) for seed in (3, 4)], model, without=list(CATALOGUE))
    assert np.sqrt(np.mean(found.dataset.residual**2)) > 0.01 * robot.nominal_torque[0], "the error is there"
    assert found.answer.verdict == "no_gap"
