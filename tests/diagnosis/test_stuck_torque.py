"""A torque that stands still while the arm moves on is the sensor's: no cause on the arm is named for it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis import Diagnosis, diagnose
from agent.diagnosis.gap.stuck_torque import stuck_torque
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.rows.fit import Fit
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.recording import read_log
from agent.recording.log import Log
from agent.robot import RobotDescription, load_robot
from tests.estimation.conftest import _arm, _links, _log, _multisine

RATE = 250.0  # Hz
NOISE = 0.4  # N·m
MOVES = (11, 12, 13)


def _torque(
    robot: RobotDescription, seed: int, more: np.ndarray | float = 0.0, slower: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (S, 2) [rad] and joint torque (S, 2) [N·m] without noise; `more` is added to viscous friction."""
    q, qd, qdd = _multisine(2, np.arange(0, 16, 1 / (slower * RATE)), seed)
    qd, qdd = qd / slower, qdd / slower**2
    return q, _links(robot, q, qd, qdd) + 5 * np.sign(qd) + (4 + more) * qd


def _recorded(robot: RobotDescription, seed: int, q: np.ndarray, torque: np.ndarray) -> Log:
    noise = NOISE * np.random.default_rng(seed).normal(size=torque.shape)
    return _log(robot, np.arange(len(q)) / RATE, q, torque + noise, f"{seed}.mcap")


def _holding(torque: np.ndarray, seed: int) -> np.ndarray:
    """The first joint's torque holds its value now and then, for 0.1 to 0.5 s."""
    rng, held = np.random.default_rng(seed), torque.copy()
    for start in range(200, len(held) - 200, 400):
        held[start : start + rng.integers(25, 125), 0] = held[start, 0]
    return held


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return _arm(2)


@pytest.fixture(scope="module")
def model(robot) -> IdentifiedModel:
    logs = [_recorded(robot, seed, *_torque(robot, seed)) for seed in (1, 2)]
    return estimate(robot, logs, EstimationSettings.create(cutoff=15))


def _said(found: Diagnosis) -> list[str]:
    return [warning for warning in found.document.warnings if "stands still" in warning]


def _level(warning: str) -> float:
    return float(warning.split("stands still at ")[1].split(" N·m")[0])


def _logs(robot: RobotDescription, change: Callable[[np.ndarray, int], np.ndarray]) -> list[Log]:
    """Of all moves, each with its torque without noise changed, by the seed of the move."""
    motions = {seed: _torque(robot, seed) for seed in MOVES}
    return [_recorded(robot, seed, q, change(torque, seed)) for seed, (q, torque) in motions.items()]


def test_reports_a_held_torque_sensor_and_names_no_cause(robot, model):
    found = diagnose(robot, _logs(robot, _holding), model)
    assert found.document.verdict == "unknown"
    (warning,) = _said(found)
    assert warning.startswith(f"the torque of {robot.joint_names[0]} stands still")
    assert "holds its value" in warning
    following = found.result["next_experiment"]
    assert f"you repair the torque measurement of {robot.joint_names[0]}" in following["motion"]
    assert following["kind"] == "repeat"


@pytest.mark.parametrize(
    "level",
    [pytest.param(8.0, marks=pytest.mark.verify, id="nearly always"), pytest.param(None, id="a fifth of the time")],
)
def test_reports_clipped_torque_with_its_level(robot, model, level):
    level = level or float(np.quantile(np.abs(_torque(robot, MOVES[0])[1][:, 1]), 0.8))
    cut = [np.inf, level]
    found = diagnose(robot, _logs(robot, lambda torque, _: np.clip(torque, np.negative(cut), cut)), model)
    assert found.document.verdict == "unknown"
    (warning,) = _said(found)
    assert _level(warning) == pytest.approx(level, rel=0.02)
    assert f"{robot.joint_names[1]} stands still at" in warning


@pytest.mark.parametrize(("more", "verdicts"), [(2.0, ("explained", "ambiguous")), (0.0, ("no_gap",))])
def test_friction_is_not_reported_as_a_held_sensor(robot, model, more, verdicts):
    """More friction, and torque held only where it hardly changes, which nothing tells from one that follows."""
    logs = [_recorded(robot, seed, *_torque(robot, seed, np.array([more, 0.0]))) for seed in MOVES]
    found = diagnose(robot, logs, model)
    assert found.document.verdict in verdicts
    assert not _said(found)


def test_nearly_constant_torque_is_not_reported_as_a_held_sensor(robot, model):
    """By the model it goes up and down with the friction; without any, on an upright axis, nothing is left of it."""
    logs = []
    for seed in MOVES:
        q, torque = _torque(robot, seed, np.array([-4.0, 0.0]), slower=3.0)
        torque[:, 0] -= 4.8 * np.sign(np.gradient(q[:, 0]))
        logs.append(_recorded(robot, seed, q, torque))
    found = diagnose(robot, logs, model)
    assert [(cause.effect, cause.joints) for cause in found.document.causes] == [("friction_change", ("joint_1",))]
    assert not _said(found)


@pytest.mark.parametrize("joint", [1, pytest.param(5, marks=pytest.mark.verify)])
def test_reports_a_held_torque_on_a_real_arm(shared_data, joint):
    """KR300, free motion: the torque of one joint is held for 0.2 to 0.8 s now and then; as recorded it is not."""
    folder = shared_data / "real-dev/kr300"
    arm = load_robot(folder / "robot_real.yaml")
    given = estimate(
        arm, [read_log(folder / f"{name}.mcap", arm) for name in "AB"], EstimationSettings.create(cutoff=10)
    )
    log = read_log(folder / "C.mcap", arm)
    assert not _said(diagnose(arm, [log], given))
    rng, moment, effort = np.random.default_rng(joint), 0.0, log.effort.copy()
    while (moment := moment + rng.exponential(2.0)) < log.t[-1]:
        first, last = np.searchsorted(log.t, [moment, moment + rng.uniform(0.2, 0.8)])
        effort[first:last, joint] = effort[first, joint]
    found = diagnose(arm, [replace(log, effort=effort)], given)
    assert found.document.verdict == "unknown"
    assert _said(found)[0].startswith(f"the torque of {arm.joint_names[joint]} stands still")


def test_a_constant_torque_is_tolerated_if_no_joint_has_a_gap(robot, model):
    """Some rows have energy over the noise model, but no joint has any as a whole."""
    dataset = assemble(robot, model, _logs(robot, _holding), None)
    assert stuck_torque(dataset, dataset.fit) is not None
    wide = Fit(
        replace(dataset.fit.data, sigma=5 * dataset.fit.sigma)
    )  # of a model that errs by 1 % of nominal everywhere
    some = np.where(np.abs(dataset.residual) > 10 * dataset.fit.sigma, 2.5, 0.0) * wide.sigma
    assert stuck_torque(replace(dataset, fit=wide, residual=some), wide) is None
