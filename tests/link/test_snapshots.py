"""Samples of a C5G Open node that reads the controller's snapshots in its own loop, like the published node."""

from contextlib import closing

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.transports.cnr.joiner import Joiner
from drivers.transports.cnr.snapshot_clock import Rows, SnapshotClock
from drivers.wire import cnr
from fake_controller.build import build_controller
from fake_controller.servers.cnr.node import JointPublisher
from fake_controller.servers.cnr.server import CnrServer
from tests.conftest import patience
from tests.link.cnr_peer import SHORT
from tests.link.test_cnr_link import connected

PERIOD = 2000.0  # µs, of the controller


def way(number):
    """(K, 3) degrees of an arm that begins to move with snapshot 600."""
    w = np.clip(0.002 * np.asarray(number, dtype=float) - 1.2, 0.0, None)
    return np.degrees(np.column_stack([0.6 * (1 - np.cos(1.9 * w)), 0.4 * np.sin(1.1 * w) ** 2, np.sin(0.4 * w) ** 2]))


def rows_of(loop, seed, seconds=4.0):
    """Rows of a node with a given loop time [µs]; currents are the positions of their own snapshot."""
    rng = np.random.default_rng(seed)
    at = 7e6 + np.cumsum(loop + rng.normal(0, 30, int(seconds * 1e6 / loop)))
    late = rng.uniform(50, 350, len(at))
    phase = 7e6 + rng.uniform(0, PERIOD)
    sample, current = (np.floor((moment - phase) / PERIOD) for moment in (at, at + late))
    values = np.zeros((len(at), 5, 10))
    values[:, 0, :3] = values[:, 2, :3] = way(sample)
    values[:, 4, :3] = way(current)
    return Rows(np.round(at).astype(np.int64), np.round(late).astype(np.int64), values)


def through(clock, rows, begin=198):
    """Resulting times and values if rows come by nines, and a motion is announced after a number of them."""
    given = []
    for k in range(0, len(rows.times), 9):
        if k == begin:
            clock.begin()
        given.append(clock.add(rows.part(slice(k, k + 9))))
    return (np.concatenate(parts) for parts in zip(*given, strict=True))


@settings(deadline=None, max_examples=4)
@given(loop=st.floats(2000.0, 3000.0), seed=st.integers(0, 10_000))
def test_assigns_set_point_times_and_accounts_for_every_row(loop, seed):
    clock, rows = SnapshotClock(PERIOD), rows_of(loop, seed)
    times, values = through(clock, rows)
    facts = clock.facts
    assert facts.rows == len(times) - 198 + facts.repeated
    assert facts.rows == len(rows.times) - 198 - 80, "80 rows wait for those after them"
    assert facts.period == pytest.approx(1e-6 * loop, rel=0.01)
    assert facts.derived == (cnr.VELOCITIES, cnr.TARGET_VELOCITIES)
    moving = values[:, 2, 0] > 0
    times, values = times[moving], values[moving]
    number = np.round((times - times[0]) / PERIOD)
    np.testing.assert_allclose(times - times[0], PERIOD * number, atol=1)
    assert np.all(np.diff(number) > 0)
    first = 600 + int(np.argmin(np.abs(way(np.arange(600, 800)) - values[0, 2, :3]).sum(axis=1)))
    apart = [np.abs(way(number + first + k) - values[:, 2, :3]).max(axis=1) for k in range(-2, 3)]
    shift = np.argmin(apart, axis=0)
    assert np.count_nonzero(np.diff(shift)) <= 3, "where the arm is slow the phase may go over to the next period"
    steps = np.abs(np.diff(way(np.arange(3000)), axis=0)).max()
    beaten = loop > 2010  # before stamps and snapshots have met, nothing tells of which snapshot currents are
    assert np.sqrt(np.mean((values[:, 4, :3] - values[:, 2, :3]) ** 2)) < (0.1 if beaten else 1.0) * steps
    speed = np.gradient(values[:, 2, :3], times * 1e-6, axis=0)
    assert np.median(np.abs(values[:, 3, :3] - speed)[5:-5]) < 0.01 * np.abs(speed).max()


def test_even_rows_pass_unchanged():
    clock, rows = SnapshotClock(PERIOD), rows_of(PERIOD, 1)
    rows.times = 7_000_000 + 2000 * np.arange(len(rows.times))
    times, values = through(clock, rows)
    np.testing.assert_array_equal(times, rows.times)
    np.testing.assert_array_equal(values, rows.values)
    assert clock.facts.facts == {}


def test_as_soon_as_there_are_enough_rows_a_motion_has_even_times():
    clock, rows = SnapshotClock(PERIOD), rows_of(2300.0, 1)
    for k in range(len(rows.times)):
        clock.add(rows.part(slice(k, k + 1)))
        if clock.has_enough:
            break
    clock.begin()
    assert clock.has_enough
    assert clock.active


def test_occasional_late_stamps_pass_unchanged():
    rng = np.random.default_rng(2)
    rows = rows_of(PERIOD, 1)
    rows.times = 7_000_000 + np.maximum.accumulate(
        2000 * np.arange(len(rows.times)) + rng.integers(0, 3000, len(rows.times))
    )
    times, _ = through(SnapshotClock(PERIOD), rows)
    np.testing.assert_array_equal(times, rows.times)


def test_releases_waiting_rows_on_silence_and_passes_on_a_clock_set_back():
    clock, rows = SnapshotClock(PERIOD), rows_of(2200.0, 1)
    times, _ = through(clock, rows)
    clock._came -= 10.0
    rest, _ = clock.add(rows.part(slice(0)))
    assert rest[-1] - times[-1] > 80 * 2150
    assert clock.add(rows.part(slice(9)))[0].tolist() == rows.times[:9].tolist()


def test_samples_are_complete_without_excluded_topics():
    joiner = Joiner(("a", "b", "c"), PERIOD)
    joiner.add(0, 1_000_000, (1.0,) * 10)
    joiner.leave_out({1})
    joiner.add(2, 1_000_150, (3.0,) * 10)
    rows = joiner.take()
    assert (rows.times.tolist(), rows.late.tolist()) == ([1_000_000], [150])
    assert rows.values[0, :, 0].tolist() == [1.0, 0.0, 3.0]


@pytest.mark.parametrize("silent", [False, True])
def test_records_a_motion_through_the_published_node(arm, broker, monkeypatch, caplog, silent):
    """With velocities of zero, or without a message of them."""
    if silent:
        published = (cnr.POSITIONS, cnr.TARGET_POSITIONS, cnr.CURRENTS)
        monkeypatch.setattr(JointPublisher, "_channels", lambda _: published)
    controller = build_controller(arm, seed=3, clock="fast")
    at = {"broker": broker.address, "waits": True, "node_period": 2.3e-3}
    server = CnrServer(controller, watchdog=patience(2.0), **at)
    with closing(server), connected(server.address, arm) as driver:
        driver.start("p", driver.upload("p", SHORT))
        blocks = list(driver.samples())
        facts, gaps = driver.facts, driver.gaps
    time, position, velocity, target = (
        np.concatenate([getattr(block, name) for block in blocks])
        for name in ("time", "position", "velocity", "reference_position")
    )
    sequence = np.concatenate([block.sequence for block in blocks])
    np.testing.assert_allclose(time - time[0], 0.002 * (sequence - sequence[0]), atol=1e-6)
    assert len(time) + sum(gap.count for gap in gaps) == sequence[-1] + 1
    moving = np.flatnonzero(np.abs(np.diff(target, axis=0)).max(axis=1) > 1e-4)  # repeated rows of a stationary arm
    assert 0.8 < len(moving) / (sequence[moving[-1]] - sequence[moving[0]] + 1) < 0.95
    assert float(facts["node_rate_hz"]) == pytest.approx(1 / 2.3e-3, rel=0.02)
    assert facts["node_derived"] == f"{cnr.VELOCITIES} {cnr.TARGET_VELOCITIES}"
    speed = np.gradient(target, time, axis=0)
    assert np.abs(speed).max() > 0.3
    assert np.sqrt(np.mean((velocity - np.gradient(position, time, axis=0)) ** 2)) < 0.05 * np.abs(speed).max()
    assert silent or "times come from the set-points" in caplog.text
