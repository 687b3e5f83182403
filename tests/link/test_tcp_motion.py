"""A motion over the TCP driver, with a peer that is lossy, late or rude."""

import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from drivers.errors import DriverError, MotionStopped, ProtocolError, RefusedError
from drivers.transports.tcp.driver import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import EndReason, Refusal
from tests.conftest import patience


def samples(first: int, count: int) -> tcp.Samples:
    """Samples whose every value tells its sequence number."""
    sequence = np.arange(first, first + count)
    values = np.repeat(sequence[:, None].astype(float), 2, axis=1)
    return tcp.Samples(first, sequence * 2_000_000, *(values + k / 10 for k in range(5)))


def collect(driver: TcpDriver) -> np.ndarray:
    """Sequence numbers of all samples, each checked against what it carries."""
    seen = []
    for block in driver.samples():
        np.testing.assert_array_equal(block.position[:, 0], block.sequence)
        np.testing.assert_allclose(block.time, block.sequence * 0.002)
        assert block.reference_velocity.shape == (len(block), 2)
        seen.append(block.sequence)
    return np.concatenate(seen) if seen else np.array([], int)


@contextmanager
def moving(peer, script, **options) -> Iterator[TcpDriver]:
    """A driver that has started program p on a peer with this script."""
    with closing(TcpDriver(peer(script), **options)) as driver:
        driver.connect()
        driver.start("p", "00")
        yield driver


def played(*messages, watchdog_ms: int = 2000):
    """A script: a motion, these messages, and nothing more."""

    def play(p):
        p.begin_motion(watchdog_ms)
        for message in messages:
            p.send(message)
        p.until_left()

    return play


def done(count: int) -> tcp.End:
    return tcp.End(EndReason.DONE, count, "")


@given(data=st.data())
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_delivers_every_sample_once_despite_wire_faults(peer, data):
    """Blocks lost, repeated, swapped: all come back as long as the ring has them, else they are counted."""
    blocks = [samples(first, 10) for first in range(0, 200, 10)]
    order = data.draw(st.permutations(range(len(blocks))))
    order = [k for k in order if data.draw(st.booleans())] + data.draw(st.lists(st.sampled_from(range(len(blocks)))))
    forgotten = data.draw(st.integers(0, 200))  # what the ring does not have any more

    def play(p):
        p.begin_motion()
        for k in order:
            p.send(blocks[k])
        p.send(tcp.End(EndReason.DONE, 200, ""))
        while True:
            fetch, request = p.expect(tcp.Fetch)
            first = max(fetch.first, forgotten)
            if first >= 200:
                p.send(tcp.Refused(Refusal.NOT_AVAILABLE, 0, 0, "gone"), request)
            else:
                p.send(samples(first, min(fetch.count, 200 - first)), request)

    with moving(peer, play) as driver:
        sequence = collect(driver)
    assert np.all(np.diff(sequence) > 0)
    missing = {k for gap in driver.gaps for k in range(gap.first, gap.first + gap.count)}
    assert set(sequence.tolist()) | missing == set(range(200))
    assert not set(sequence.tolist()) & missing
    assert all(k < forgotten for k in missing)


@pytest.mark.parametrize("damage", ["mid-frame", "corrupt", "closed"])
def test_everything_received_comes_before_the_error(peer, damage):
    def play(p):
        p.begin_motion()
        frame = bytearray(tcp.encode(samples(10, 10)))
        frame[50] ^= damage == "corrupt"
        p.socket.sendall(
            tcp.encode(samples(0, 10)) + {"mid-frame": frame[:60], "corrupt": frame, "closed": b""}[damage]
        )
        p.socket.shutdown(socket.SHUT_WR)
        p.until_left()

    with moving(peer, play) as driver:
        received = driver.samples()
        assert len(next(received)) == 10
        with pytest.raises(DriverError, match=r"closed the connection|damaged"):
            next(received)
        with pytest.raises(DriverError):
            driver.status()
        driver.stop()


def test_silence_in_motion_ends_the_link(peer):
    with (
        moving(peer, played(samples(0, 10), watchdog_ms=50)) as driver,
        pytest.raises(DriverError, match="fell silent: nothing for 50 ms"),
    ):
        collect(driver)


def test_heartbeats_alone_keep_the_link_alive(peer):
    def play(p):
        p.begin_motion(watchdog_ms=80)
        for _ in range(12):  # one for each of the driver's, four to a watchdog
            p.heartbeat()
            p.send(tcp.Heartbeat())
        p.send(samples(0, 10))
        p.send(done(10))
        p.until_left()

    with moving(peer, play) as driver:
        assert len(collect(driver)) == 10


def test_a_start_that_is_not_answered_is_not_sent_again_and_the_link_is_closed(peer):
    seen = []
    left = threading.Event()

    def play(p):
        p.welcome()
        with suppress(EOFError):
            while True:
                seen.append(type(p.receive()[0]))
        left.set()

    driver = TcpDriver(peer(play), start_timeout=patience(0.1))
    driver.connect()
    with pytest.raises(DriverError, match="did not answer start of p"):
        driver.start("p", "00")
    with pytest.raises(DriverError, match="connect first"):
        driver.start("p", "00")
    assert left.wait(20)
    assert seen == [tcp.Start, tcp.Stop], "and a stop, for who knows whether it arrived"


def test_motion_ids_are_unique(peer):
    ids = []

    def play(p):
        p.welcome()
        for _ in range(3):
            start, request = p.expect(tcp.Start)
            ids.append(start.motion_id)
            p.send(tcp.Started(start.motion_id), request)
            p.send(tcp.End(EndReason.DONE, 0, ""))
        p.until_left()

    with closing(TcpDriver(peer(play))) as driver:
        driver.connect()
        for _ in range(3):
            driver.start("p", "00")
            assert len(collect(driver)) == 0
    assert len(set(ids)) == 3


@pytest.mark.parametrize(
    ("reason", "error", "exit_code"),
    [
        (EndReason.EMERGENCY_STOP, MotionStopped, 5),
        (EndReason.DRIVE_FAULT, MotionStopped, 5),
        (EndReason.PROTECTIVE_STOP, MotionStopped, 5),
        (EndReason.OVERRIDE_CHANGED, MotionStopped, 5),
        (EndReason.ALARM, MotionStopped, 5),
        (EndReason.STOPPED, MotionStopped, 5),
        (EndReason.PROGRAM_ERROR, RefusedError, 4),
        (EndReason.WATCHDOG, DriverError, 4),
        (EndReason.SHUTDOWN, DriverError, 4),
        (99, ProtocolError, 4),
    ],
)
def test_reports_how_a_motion_ended(peer, reason, error, exit_code):
    with moving(peer, played(samples(0, 10), tcp.End(reason, 10, "because"))) as driver:
        received = driver.samples()
        assert len(next(received)) == 10
        with pytest.raises(error, match="because") as caught:
            next(received)
        assert type(caught.value) is error
        assert caught.value.exit_code == exit_code


def test_stop_waits_for_rest_and_the_samples_end_by_themselves(peer):
    def play(p):
        p.begin_motion()
        p.send(samples(0, 10))
        _, request = p.expect(tcp.Stop)
        p.send(tcp.Done(), request)
        p.send(samples(10, 10))
        p.send(tcp.End(EndReason.STOPPED, 20, "stopped on command"))
        _, request = p.expect(tcp.Stop)
        p.send(tcp.Done(), request)
        p.until_left()

    with moving(peer, play) as driver:
        received = driver.samples()
        assert len(next(received)) == 10
        driver.stop()
        driver.stop()
        assert sum(len(block) for block in received) == 10


def test_a_consumer_that_never_reads_does_not_stall_the_link(peer):
    """All of a motion is taken off the wire, and requests are answered, while nobody reads samples."""

    def play(p):
        p.begin_motion()
        for first in range(0, 50_000, 500):
            p.send(samples(first, 500))
        p.send(tcp.End(EndReason.DONE, 50_000, ""))
        _, request = p.expect(tcp.AskStatus)
        p.send(tcp.StatusReply(True, "auto", False, (), 1.0, True, False, "", "", (0.0,), True), request)
        p.until_left()

    with moving(peer, play) as driver:
        assert driver.status().emulator
        assert len(collect(driver)) == 50_000


def test_too_many_unread_samples_stop_the_motion(peer):
    stopped = threading.Event()

    def play(p):
        p.begin_motion()
        p.send(samples(0, 500))
        p.expect(tcp.Stop)
        stopped.set()
        p.until_left()

    with moving(peer, play, buffer_limit=10_000) as driver:
        assert stopped.wait(20)
        received = driver.samples()
        assert len(next(received)) == 500
        with pytest.raises(DriverError, match="wait to be read"):
            next(received)
