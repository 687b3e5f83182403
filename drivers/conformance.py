"""What every driver must do, as tests against the real wire; docs/how-to-driver.md says how to run them on a new one.

Subclass `DriverConformance` in a test module and give it a fixture `bench` that returns a `Bench`. Nothing else of it
is to be changed: a driver that needs another suite is another protocol.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
import time
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol

import numpy as np

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.protocol import Driver, Identity, ListensFirst, MeasuresThroughput, SampleBlock

_PATIENCE = 60.0  # s for something that must come
_NAME = "p"


class Bench(Protocol):
    """A controller that may be treated badly, and drivers for it. Everything is undone after each test."""

    joint_names: tuple[str, ...]
    short: str  # a program of the name `p`: a motion of a second or so, rest to rest
    long: str  # the same, but a motion of minutes
    comment: str  # how a comment begins in its programs
    set_points: bool  # whether its wire has them

    def driver(self) -> Driver:
        """One for the controller, not connected; each call another."""

    def nobody(self) -> Driver:
        """One for an address where there is nothing."""

    def mute(self) -> Driver:
        """One for somebody who accepts the link and never says anything. It gives up in seconds."""

    def stranger(self) -> Driver:
        """One for somebody who answers in another protocol. It gives up in seconds."""

    def motions_started(self) -> int:
        """How many motions the controller has begun, as it counts itself."""

    def moving(self) -> bool:
        """Whether the arm moves, as the controller knows itself."""

    def cut(self) -> None:
        """Pull the cable out."""

    def silence(self) -> None:
        """Nothing that the controller says arrives any more; the link stays open."""

    def replay(self) -> None:
        """Send the controller once more, byte by byte, what it was sent since the link was opened."""


class DriverConformance:
    """The suite. Every test is one sentence of the protocol."""

    def test_says_who_is_there(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            identity = driver.identify()
            assert isinstance(identity, Identity)
            assert identity.joint_names == bench.joint_names
            assert identity.robot
            assert identity.serial
            assert 0 < identity.period < 1

    def test_tells_the_state(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            status = driver.status()
            assert status.mode in ("auto", "teach")
            assert status.position.shape == (len(bench.joint_names),)
            assert not status.moving
            assert (status.program, status.checksum) == ("", "")
            assert 0 <= status.override <= 2

    def test_returns_the_checksum_of_what_is_stored(self, bench: Bench) -> None:
        text = bench.short + f"{bench.comment} äöü " + "x" * 3000 + "\n"
        with _connected(bench) as driver:
            assert driver.upload(_NAME, text) == _sha256(text)
            status = driver.status()
            assert (status.program, status.checksum) == (_NAME, _sha256(text))

    def test_a_program_that_is_none_is_refused(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            with _raises(RefusedError):
                driver.upload(_NAME, "this is no program\n")
            assert driver.status().program == ""

    def test_starts_once_and_gives_every_sample_in_order(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            blocks = _run(driver, bench.short)
            _check_samples(driver, blocks, bench)
            assert bench.motions_started() == 1
            assert not driver.status().moving
            assert not bench.moving()

    def test_each_motion_counts_from_the_start(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            first, second = _run(driver, bench.short), _run(driver, bench.short)
            _check_samples(driver, second, bench)
            assert second[0].time[0] > first[-1].time[-1]
            assert bench.motions_started() == 2

    def test_starts_nothing_but_the_program_that_is_meant(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            driver.upload(_NAME, bench.short)
            with _raises(RefusedError):
                driver.start(_NAME, _sha256(bench.long))
            with _raises(RefusedError):
                driver.start("q", _sha256(bench.short))
            assert bench.motions_started() == 0
            assert _run(driver, bench.short)

    def test_no_samples_without_a_motion(self, bench: Bench) -> None:
        with _connected(bench) as driver, _raises(DriverError):
            list(driver.samples())

    def test_answers_while_samples_stream(self, bench: Bench) -> None:
        with _moving(bench) as (driver, received):
            assert driver.status().moving
            assert driver.identify().joint_names == bench.joint_names
            with _raises(DriverError):
                driver.start(_NAME, _sha256(bench.long))
            with _raises(RefusedError):
                driver.upload("q", bench.short)
            driver.stop()
            list(received)
            assert bench.motions_started() == 1

    def test_stops_in_motion_and_gives_the_samples_of_the_stop(self, bench: Bench) -> None:
        with _moving(bench) as (driver, received):
            blocks = [next(received)]
            driver.stop()
            assert not bench.moving()
            driver.stop()
            blocks += received
            if bench.set_points:
                set_points = blocks[-1].reference_velocity
                assert set_points is not None
                assert np.abs(set_points[-1]).max() < 1e-6
            assert not driver.gaps
            assert not driver.status().moving
            assert _run(driver, bench.short)

    def test_two_stops_at_once_stop_the_arm(self, bench: Bench) -> None:
        """Whoever sees no braking sends a second one while the first is still waited for."""
        with _moving(bench) as (driver, received):
            next(received)
            with ThreadPoolExecutor(2) as two:
                for stopped in [two.submit(driver.stop) for _ in range(2)]:
                    stopped.result(_PATIENCE)
            list(received)
            assert not bench.moving()
            assert bench.motions_started() == 1

    def test_who_was_interrupted_goes_on_with_the_next_sample(self, bench: Bench) -> None:
        """The samples of a stop follow what was handed out before, and none is left out."""
        with _moving(bench) as (driver, received):
            blocks = [next(received)]
            received.close()
            driver.stop()
            blocks += driver.samples()
            sequence = np.unique(np.concatenate([block.sequence for block in blocks]))
            np.testing.assert_array_equal(sequence, np.arange(len(sequence)))
            assert len(sequence) > len(blocks[0])

    def test_hands_out_samples_while_it_starts(self, bench: Bench) -> None:
        """They can be judged from before anything is sent."""
        with _connected(bench) as driver:
            assert isinstance(driver, ListensFirst)
            heard: list[SampleBlock] = []
            motions_started: list[int] = []
            threads: list[threading.Thread] = []

            def listen() -> None:
                motions_started.append(bench.motions_started())
                source = driver.samples()
                threads.append(threading.Thread(target=lambda: heard.extend(source), daemon=True))
                threads[0].start()

            driver.listening = listen
            driver.start(_NAME, driver.upload(_NAME, bench.short))
            threads[0].join(_PATIENCE)
            assert motions_started == [0]
            _check_samples(driver, heard, bench)

    def test_a_stop_while_it_starts_is_obeyed(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            assert isinstance(driver, ListensFirst)
            with ThreadPoolExecutor(1) as stopping:

                def stop_at_once(source: Iterator[SampleBlock]) -> None:
                    next(source)
                    driver.stop()

                def listen() -> None:
                    stopping.submit(stop_at_once, driver.samples())

                driver.listening = listen
                with contextlib.suppress(DriverError):
                    driver.start(_NAME, driver.upload(_NAME, bench.long))
            assert not bench.moving()
            assert bench.motions_started() <= 1

    def test_says_how_long_it_may_be_silent_and_what_it_carries(self, bench: Bench) -> None:
        """The age that samples may have follows from the one, the rate from the other."""
        with _connected(bench) as driver:
            assert 0 < driver.watchdog <= 60
            if isinstance(driver, MeasuresThroughput):
                assert driver.throughput() > 0
            assert _run(driver, bench.short), "measuring the link is no harm"

    def test_a_stop_of_a_stationary_arm_is_harmless(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            driver.stop()
            assert _run(driver, bench.short)
            driver.stop()

    def test_a_dropped_link_is_an_error_and_the_arm_rests(self, bench: Bench) -> None:
        with _moving(bench) as (_, received):
            next(received)
            bench.cut()
            with _raises(DriverError):
                list(received)
            _until_it_rests(bench)
            assert bench.motions_started() == 1

    def test_a_silent_controller_is_an_error_and_the_arm_rests(self, bench: Bench) -> None:
        with _moving(bench) as (_, received):
            next(received)
            bench.silence()
            with _raises(DriverError):
                list(received)
            _until_it_rests(bench)
            assert bench.motions_started() == 1

    def test_closing_in_motion_brings_the_arm_to_rest(self, bench: Bench) -> None:
        with _moving(bench) as (driver, received):
            next(received)
            driver.close()
            with _raises(DriverError):
                list(received)
            _until_it_rests(bench)

    def test_a_motion_command_that_arrives_twice_acts_once(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            _run(driver, bench.short)
            bench.replay()
        _until_it_rests(bench)
        assert bench.motions_started() == 1

    def test_a_second_client_is_refused_until_the_first_has_left(self, bench: Bench) -> None:
        with _connected(bench) as driver:
            other = bench.driver()
            with _raises(DriverError):
                other.connect()
            other.close()
            assert driver.identify().joint_names == bench.joint_names
            driver.close()
            with _connected(bench) as next_one:
                assert next_one.identify().joint_names == bench.joint_names

    def test_nobody_there(self, bench: Bench) -> None:
        with contextlib.closing(bench.nobody()) as driver, _raises(DriverError):
            driver.connect()

    def test_somebody_who_says_nothing(self, bench: Bench) -> None:
        with contextlib.closing(bench.mute()) as driver, _raises(DriverError):
            driver.connect()

    def test_somebody_who_speaks_another_protocol(self, bench: Bench) -> None:
        with contextlib.closing(bench.stranger()) as driver, _raises(ProtocolError):
            driver.connect()

    def test_closing_is_idempotent_and_a_driver_can_connect_again(self, bench: Bench) -> None:
        driver = bench.driver()
        driver.close()
        with _raises(DriverError):
            driver.identify()
        _connect_when_free(driver)
        driver.close()
        driver.close()
        driver.stop()
        with _raises(DriverError):
            driver.status()
        _connect_when_free(driver)
        assert driver.identify().joint_names == bench.joint_names
        driver.close()


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@contextlib.contextmanager
def _raises(kind: type[DriverError]) -> Iterator[None]:
    try:
        yield
    except kind as error:
        if str(error):
            return
        raise AssertionError(f"{kind.__name__} has no message for the user") from error
    raise AssertionError(f"{kind.__name__} is expected, and nothing was raised")


@contextlib.contextmanager
def _connected(bench: Bench) -> Iterator[Driver]:
    driver = bench.driver()
    try:
        _connect_when_free(driver)
        yield driver
    finally:
        driver.close()


@contextlib.contextmanager
def _moving(bench: Bench) -> Iterator[tuple[Driver, Generator[SampleBlock, None, None]]]:
    with _connected(bench) as driver:
        driver.start(_NAME, driver.upload(_NAME, bench.long))
        yield driver, (block for block in driver.samples())


def _connect_when_free(driver: Driver) -> None:
    """The controller may need a moment to notice that the client before has left."""
    until = time.monotonic() + _PATIENCE
    while True:
        try:
            driver.connect()
            return
        except RefusedError:
            if time.monotonic() > until:
                raise


def _run(driver: Driver, text: str) -> list[SampleBlock]:
    driver.start(_NAME, driver.upload(_NAME, text))
    return list(driver.samples())


def _until_it_rests(bench: Bench) -> None:
    until = time.monotonic() + _PATIENCE
    while bench.moving():
        assert time.monotonic() < until, "the arm still moves"
        time.sleep(0.01)


def _check_samples(driver: Driver, blocks: list[SampleBlock], bench: Bench) -> None:
    sequence = np.concatenate([block.sequence for block in blocks])
    np.testing.assert_array_equal(sequence, np.arange(len(sequence)))
    assert driver.gaps == ()
    times = np.concatenate([block.time for block in blocks])
    np.testing.assert_allclose(np.diff(times), driver.identify().period, rtol=1e-3)
    names = ("position", "velocity", "torque", "reference_position", "reference_velocity")
    for name in names if bench.set_points else names[:3]:
        values = np.concatenate([getattr(block, name) for block in blocks])
        assert values.shape == (len(sequence), len(bench.joint_names)), name
        assert np.all(np.isfinite(values)), name
        assert np.any(values != 0), name
    assert all(block.received > 0 for block in blocks)
