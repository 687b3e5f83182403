"""Positions that no arm can have reached, and torques that stand out alone."""

from pathlib import Path

import numpy as np
import pytest

from agent.recording import Log, read_log, write_log
from agent.robot import load_robot

ROBOT = load_robot("comau_ns16")


@pytest.fixture
def through_file(tmp_path):
    """`through_file(q, torque=None)`: the log that comes back of positions (S, 6) at 500 Hz; their torque is cos q."""

    def write_and_read(q: np.ndarray, torque: np.ndarray | None = None) -> Log:
        log = Log(
            path=tmp_path / "log.mcap",
            joint_names=ROBOT.joint_names,
            t=np.arange(len(q)) / 500,
            position=q,
            velocity=None,
            effort=np.cos(q) if torque is None else torque,
            reference_position=None,
            planned_position=None,
            sample_rate=500.0,
            stamp=100.0,
            segments=((0, len(q)),),
        )
        write_log(Path(log.path), log)
        return read_log(log.path, ROBOT)

    return write_and_read


@pytest.fixture
def motion():
    t = np.arange(3000)[:, None] / 500
    return 1.2 * np.sin(t * [1.0, 1.1, 0.9, 1.3, 0.8, 1.2])


def test_positions_that_wrap_around_are_made_continuous(through_file, motion):
    turned = 3 * motion[:, 5] + 2.0
    wrapped = np.column_stack([motion[:, :5], (turned + np.pi) % (2 * np.pi) - np.pi])
    log = through_file(wrapped)
    assert np.allclose(log.position[:, 5] - log.position[0, 5], turned - turned[0], atol=1e-12)
    assert np.array_equal(log.position[:, :5], motion[:, :5])
    assert log.segments == ((0, 3000),)
    assert any("joint_6 that wrap around" in str(repair) for repair in log.repairs)


def test_one_impossible_sample_is_dropped(through_file, motion):
    knocked = motion.copy()
    knocked[700, 1] += 0.5
    knocked[900, [2, 3]] -= 0.7
    log = through_file(knocked)
    assert np.array_equal(log.position, np.delete(motion, [700, 900], axis=0))
    assert log.segments == ((0, 2998),)
    assert any(str(repair) == "samples with an impossible position, dropped: 2 at 1.400 s" for repair in log.repairs)


def test_a_lasting_jump_cuts_the_log(through_file, motion):
    lost = motion.copy()
    lost[500, 0] += 1.0
    lost[1500:, 4] += 0.4
    log = through_file(lost)
    assert log.segments == log.bridged(1.0) == ((0, 1499), (1499, 2999))
    assert any("joint_5 jumps by" in repair.kind and repair.time == pytest.approx(3.0) for repair in log.repairs)


def test_a_wrong_unit_is_not_repaired(through_file, motion):
    log = through_file(np.degrees(motion))
    assert np.array_equal(log.position, np.degrees(motion))
    assert not log.repairs


def test_single_torque_outliers_are_dropped(through_file, motion):
    rng = np.random.default_rng(0)
    torque = 5 * np.sign(np.cos(3 * motion)) + np.cos(motion) + 0.1 * rng.normal(size=motion.shape)
    torque[1000:1100, 2] += 30.0  # a contact
    knocked = torque.copy()
    knocked[[400, 401, 2200], [0, 0, 5]] += 80.0
    log = through_file(motion, knocked)
    assert np.array_equal(log.effort, np.delete(torque, [400, 401, 2200], axis=0))
    assert any("torque stands out alone" in repair.kind and repair.count == 3 for repair in log.repairs)
    assert not through_file(motion, torque).repairs
