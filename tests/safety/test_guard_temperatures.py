"""Temperatures of the motors: requested rarely, alongside the watch, if the controller has them."""

from __future__ import annotations

import numpy as np
import pytest

from agent.core.errors import ControllerError
from agent.safety.watch import TEMPERATURE_INTERVAL
from drivers.errors import DriverError
from drivers.transports.tcp.driver import TcpDriver

CELSIUS = (31.0, 32.0, 33.0, 34.0, 35.0, 36.0)


class WithoutTemperatures(TcpDriver):
    """The real driver, on a wire that has no such question."""

    temperatures = None


class Broken(TcpDriver):
    """The real driver; the question for temperatures brings the link to its end."""

    def temperatures(self):
        raise DriverError("as told")


class BrokenAtLast(TcpDriver):
    """The same, once the arm rests."""

    def temperatures(self):
        if self._motion.over:
            raise DriverError("as told")
        return super().temperatures()


def test_temperatures_are_polled_periodically_and_at_the_end(bench, program):
    bench.controller.blocks, bench.controller.celsius = 50, CELSIUS
    guard = bench.open()
    bench.run(program(), guard)
    times = np.array([time for time, _ in guard.temperatures])
    assert len(times) == bench.controller.asked.count("AskTemperatures") == 4
    assert times[0] < 0.5
    assert times[-1] == pytest.approx(12.5, abs=0.01)
    assert (np.diff(times)[:-1] > TEMPERATURE_INTERVAL).all()
    assert (np.diff(times)[:-1] < TEMPERATURE_INTERVAL + 0.6).all()
    for _, values in guard.temperatures:
        np.testing.assert_array_equal(values, CELSIUS)


def test_a_short_motion_has_temperatures_at_start_and_end(bench, program):
    bench.controller.celsius = CELSIUS
    guard = bench.open()
    bench.run(program(), guard)
    assert len(guard.temperatures) == 2


@pytest.mark.parametrize("driver", [TcpDriver, WithoutTemperatures])
def test_a_machine_without_temperatures_is_watched(bench, program, driver):
    bench.driver = driver
    guard = bench.open()
    assert bench.run(program(), guard) == 1000
    assert guard.temperatures == []


def test_a_failed_temperature_request_in_motion_stops_the_arm(bench, program):
    bench.controller.blocks, bench.driver = 50, Broken
    with pytest.raises(ControllerError, match="cannot be read any more"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_a_failed_temperature_request_after_motion_is_ignored(bench, program):
    bench.controller.celsius, bench.driver = CELSIUS, BrokenAtLast
    guard = bench.open()
    assert bench.run(program(), guard) == 1000
    assert len(guard.temperatures) == 1
