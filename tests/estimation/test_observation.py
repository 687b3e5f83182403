"""Rows of an observation are the torque of its parameters; a partition holds out whole stretches of a motion."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import InputError
from agent.estimation.partition import partition
from agent.estimation.signals.filtering import FilterSettings
from agent.estimation.signals.observation import check_log, observe
from agent.model import FrictionTerm, Reversal
from agent.robot.bodies import rigid_bodies
from tests.estimation.conftest import _arm, _links, _log, _multisine

TERMS = (FrictionTerm(0, "viscous"), FrictionTerm(1, "viscous"), FrictionTerm(1, "load", Reversal()))


@pytest.fixture
def robot():
    return _arm(2, coupling=np.array([[1.0, 0.0], [0.5, 1.0]]))


@pytest.fixture
def observed(robot):
    """Two logs, at 500 and at 50 Hz, of viscous friction: 3 N·m·s/rad on the first axle, 2 on the second."""
    logs = []
    for seed, rate in ((1, 500), (2, 50)):
        t = np.arange(8 * rate) / rate
        q, qd, qdd = _multisine(2, t, seed)
        axles = qd @ robot.coupling.T * [3.0, 2.0]
        torque = _links(robot, q, qd, qdd) + axles @ robot.coupling
        logs.append(_log(robot, t, q, torque, f"{seed}.mcap", reference_position=q + 1))
    return observe(rigid_bodies(robot), logs, FilterSettings())


def test_all_logs_have_the_cut_off_of_the_slowest(observed):
    assert [(one.log_index, one.motion.cutoff) for one in observed.segments] == [(0, 15.0), (1, 15.0)]
    assert (len(observed.segments), observed.segments[1].log_index, observed.noisy) == (2, 1, None)
    for segment in observed.segments:
        assert 6 < segment.time[-1] - segment.time[0] < 8
        assert segment.time[0] == pytest.approx(8 - segment.time[-1], abs=0.02)
        assert segment.motion.torque is None
        np.testing.assert_allclose(segment.motion.set_points - segment.motion.q, 1, atol=0.05)
        exact = _multisine(2, segment.time, 1 + segment.log_index)[1]
        np.testing.assert_allclose(segment.speed[20:-20], exact[20:-20], atol=0.05)


def test_columns_times_parameters_are_the_torque(robot, observed):
    rigid = observed.rigid
    base = rigid.projection @ np.append(rigid.dynamics.standard_parameters(), np.full(2, 1e-4))
    values = np.append(base, [3.0, 2.0, 0.0])
    for segment in observed.segments:
        columns = observed.joint_columns(segment, TERMS, base)
        assert [index[-3:].tolist() for index, _ in columns] == [
            [rigid.count, rigid.count + 1, rigid.count + 2],
            [*columns[1][0][-3:-2], rigid.count + 1, rigid.count + 2],
        ]
        assert rigid.count not in columns[1][0], "friction of the first axle does not act on the second joint"
        for joint, (index, block) in enumerate(columns):
            friction = {rigid.count + k for k, share in enumerate(robot.coupling[[0, 1, 1], joint]) if share}
            assert {*index} == {*rigid.support[joint], *friction}
            assert block.shape == (len(segment.time), len(index))
            error = (block @ values[index] - segment.torque[:, joint])[20:-20]
            assert np.abs(error).max() < 0.01 * np.abs(segment.torque).max()
        sizes = observed.friction(segment, TERMS, base)
        load = rigid.torque(segment.motion.q, segment.motion.qd, segment.motion.qdd, base)[segment.motion.kept, 1]
        assert np.corrcoef(np.abs(sizes[:, 2]), np.abs(load))[0, 1] > 0.9
        assert observed.friction(segment, ()).shape == (len(segment.time), 0)
        assert [block.shape[1] for _, block in observed.joint_columns(segment, ())] == [*map(len, rigid.support)]


def cells(*segments):
    """Per segment cluster, fold and guarded fold of its rows."""
    cut = partition(segments)
    assert cut.folds == cut.fold.max() + 1
    for fold in range(cut.folds):
        assert np.array_equal(cut.training(fold), (cut.fold != fold) & (cut.guards != fold))
    return [(cut.cluster[label], cut.fold[label], cut.guards[label]) for label in cut.labels]


def stretch(first, last, log=0, cycles=(), speeds=(1.0, 1.0)):
    """Ten rows a second, and both ends; the period of the cut-off is 0.1 s. Joints slide at constant speeds."""
    time = np.concatenate([[first], np.arange(first + 0.05, last, 0.1), [last]])
    motion, speed = SimpleNamespace(cutoff=10.0, cycle_starts=cycles), np.tile(speeds, (len(time), 1))
    return SimpleNamespace(log_index=log, time=time, motion=motion, speed=speed)


@pytest.mark.parametrize(("seconds", "clusters"), [(60.0, 40), (15.0, 25), (7.0, 10), (2.0, 5)])
def test_one_log_is_cut_in_five_parts_and_clusters_of_six_periods_or_more(seconds, clusters):
    one = stretch(3.0, 3.0 + seconds)
    ((cluster, fold, guards),) = cells(one)
    assert partition([one]).clusters == clusters
    part, since = seconds / 5, one.time - 3.0
    assert np.array_equal(fold, np.minimum(since // part, 4))
    assert np.array_equal(cluster, np.minimum(since // (seconds / clusters), clusters - 1))
    expected = np.full(len(fold), -1)
    for edge in range(1, 5):
        away = since - edge * part
        expected[(away >= 0) & (away < 0.2)] = edge - 1
        expected[(away < 0) & (away > -0.2)] = edge
    assert np.array_equal(guards, expected)


def test_cycles_of_a_motion_are_cut_alike_and_gaps_are_part_of_it():
    """Cycles of 10 s from 1 s on; the last is cut short, and the log has a gap."""
    segments = [stretch(0.0, 13.0, cycles=(1.0, 11.0, 21.0)), stretch(18.0, 27.0, cycles=(1.0, 11.0, 21.0))]
    for segment, (cluster, fold, _) in zip(segments, cells(*segments), strict=True):
        phase = (segment.time - 1.0) % 10
        assert np.array_equal(fold, phase // 2)
        assert np.array_equal(cluster, phase // (10 / 15))
    ((_, fold, _),) = cells(stretch(0.0, 9.0, cycles=(1.0, 11.0)))
    assert np.bincount(fold).tolist() == [16, 16, 16, 16, 28]


def test_two_logs_are_cut_in_three_parts_each_and_more_are_folds_of_their_own():
    first, second = cells(stretch(0.0, 30.0, 4), stretch(0.0, 60.0, 9))
    assert [np.unique(one[1]).tolist() for one in (first, second)] == [[0, 1, 2], [3, 4, 5]]
    assert [np.unique(one[0]).tolist() for one in (first, second)] == [[*range(12)], [*range(12, 36)]]
    assert {*first[2], *second[2]} == {-1, 0, 1, 2, 3, 4, 5}
    many = cells(*(stretch(0.0, 6.0, log) for log in range(8)))
    assert [np.unique(fold).tolist() for _, fold, _ in many] == [[0], [1], [2], [3], [4], [5], [0], [1]]
    assert [np.unique(cluster).tolist() for cluster, *_ in many[:2]] == [[*range(5)], [*range(5, 10)]]
    assert {guard for *_, guards in many for guard in guards} == {-1}


def test_a_log_with_all_that_a_joint_slides_is_not_held_out_as_a_whole():
    alone = [(1.0, 0.01), (1.0, 0.0), (0.0, 1.0)]
    cut = cells(*(stretch(0.0, 30.0, log, speeds=speeds) for log, speeds in enumerate(alone)))
    assert [np.unique(fold).tolist() for _, fold, _ in cut] == [[0, 1, 2], [3, 4, 5], [0, 1, 2]]
    assert not partition([stretch(0.0, 30.0, log, speeds=speeds) for log, speeds in enumerate(alone)]).whole_motions
    shared = [stretch(0.0, 30.0, log, speeds=speeds) for log, speeds in enumerate([*alone, (0.0, -0.3)])]
    assert partition(shared).whole_motions


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"joint_names": ("a", "b")}, "its joints are a, b; those of arm are joint_1, joint_2"),
        ({"effort": None}, r"no torque \(effort\) was recorded"),
        ({"effort": np.zeros((10, 2))}, "the torque is zero throughout"),
    ],
)
def test_logs_without_the_torque_of_the_robot_are_refused(robot, change, said):
    log = _log(robot, np.arange(10) / 10, np.zeros((10, 2)), np.ones((10, 2)))
    check_log(robot, log)
    with pytest.raises(InputError, match=said):
        check_log(robot, replace(log, **change))
