"""What the link itself carries."""

import time

import numpy as np
import pytest

from drivers.transports.tcp.driver import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import EndReason


@pytest.mark.verify
@pytest.mark.parametrize("batch", [10, 100, 500])
def test_samples_per_second(peer, measured, batch):
    """Six joints over loopback, both ends in this process; frames of `batch` samples."""
    total = 200_000

    def play(p):
        p.begin_motion()
        values = np.random.default_rng(1).normal(size=(batch, 6))
        for first in range(0, total, batch):
            p.send(tcp.Samples(first, 2_000_000 * np.arange(first, first + batch), *[values] * 5))
        p.send(tcp.End(EndReason.DONE, total, ""))
        p.until_left()

    driver = TcpDriver(peer(play))
    driver.connect()
    driver.start("p", "00")
    began = time.process_time()
    received = sum(len(block) for block in driver.samples())
    rate = received / (time.process_time() - began)
    driver.close()
    ok = rate >= 20_000
    measured(f"TCP link, frames of {batch} samples", rate, "samples/s of CPU, both ends", "at least 20 000", ok)
    assert received == total
    assert driver.gaps == ()
    assert ok
