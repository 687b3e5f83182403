"""Temperatures of the motors: requested rarely, alongside the watch, if the controller has them."""

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


@pytest.mark.parametrize(
    ("driver", "celsius", "count"),
    [(TcpDriver, CELSIUS, 2), (BrokenAtLast, CELSIUS, 1), (TcpDriver, (), 0), (WithoutTemperatures, (), 0)],
)
def test_a_short_motion_has_temperatures_at_start_and_end_if_they_can_be_read(bench, program, driver, celsius, count):
    bench.driver, bench.controller.celsius = driver, celsius
    guard = bench.open()
    assert bench.run(program(), guard) == 1000
    assert len(guard.temperatures) == count


def test_a_failed_temperature_request_in_motion_stops_the_arm(bench, program):
    bench.controller.blocks, bench.driver = 50, Broken
    with pytest.raises(ControllerError, match="cannot be read any more"):
        bench.run(program())
    assert bench.controller.stops >= 1
