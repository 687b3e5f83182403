"""The watch on a link; and links that cannot tell the override, take points, or have too few samples."""

from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import ControllerError, InputError, SafetyError
from agent.safety.preconditions import is_loopback
from drivers.protocol import ViaPoint
from drivers.transports.tcp.driver import TcpDriver
from tests.safety.following import HOME, at


class WithoutOverride(TcpDriver):
    """The real driver, on a wire that has no override."""

    def status(self):
        return replace(super().status(), override_known=False)


class WatchOnly(TcpDriver):
    """The real driver, on a wire whose samples are too few."""

    def identify(self):
        return replace(super().identify(), period=0.02, watch_only="too few samples to identify from")


class Points(TcpDriver):
    """The real driver, on a wire that takes points; the text goes with them, so that the peer has something to run."""

    text = ""

    def load(self, name, checksum, points):
        self.loaded = name, checksum, points
        super().upload(name, self.text)

    def upload(self, name, text):
        raise AssertionError("this link takes points")

    @property
    def facts(self):
        return {"said": "so"}


def test_stops_motion_that_leaves_the_plan(bench, program):
    chosen = slowly(program(), 10)
    bench.controller.blocks = 60
    bench.controller.moves = lambda times: at(chosen.chains[0], times / 2)
    guard, received = bench.open(), []
    guard.send(chosen)
    with pytest.raises(SafetyError, match="override is not at 100 %"), guard.motion(chosen) as samples:
        received += samples
    assert bench.controller.stops > 0
    assert len(received) < 30  # it was stopped when it was seen, not at the end
    guard.close()
    bench.controller = replace(bench.controller, moves=lambda times: at(chosen.chains[0], times))
    assert bench.run(chosen) == 6000


def test_checks_the_last_sample(bench, program):
    class Jumping(TcpDriver):
        def samples(self):
            for block in super().samples():
                yield block
            last = block.part(-1)
            yield replace(
                last,
                sequence=last.sequence + 1,
                time=last.time + 0.002,
                position=last.position + 0.3,
                reference_position=None,
            )

    bench.driver = Jumping
    with pytest.raises(SafetyError, match="off the planned path"):
        bench.run(program())


def test_a_stop_for_another_reason_is_not_reported_as_slow(bench, program):
    chosen = slowly(program(), 10)
    bench.controller = replace(bench.controller, blocks=60, pushes_later=True, later={"mode": "teach"})
    bench.controller.moves = lambda times: at(chosen.chains[0], times / 2)
    with pytest.raises(SafetyError, match="the mode was changed"):
        bench.run(chosen)


def slowly(chosen, factor):
    (chain,) = chosen.chains
    return replace(chosen, chains=(replace(chain, t=chain.t * factor, qd=chain.qd / factor),))


def test_without_set_points_the_measured_motion_is_checked(bench, program):
    class Nothing(TcpDriver):
        def samples(self):
            return (replace(block, reference_position=None) for block in super().samples())

    bench.driver = Nothing
    assert bench.run(program()) == 1000
    bench.controller = replace(bench.controller, moves=lambda times: np.tile(HOME - 0.3, (len(times), 1)))
    with pytest.raises(SafetyError, match="the position of"):
        bench.run(program())


def test_asks_the_operator_for_an_unreadable_override(bench):
    bench.driver = WithoutOverride
    with pytest.raises(InputError):
        bench.open(yes=False)
    bench.driver = TcpDriver
    with pytest.raises(InputError):
        bench.open(yes=False)
    unread, read = bench.asked
    assert "cannot read the override" in unread
    assert "override" not in read


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("127.0.0.1,trajectory=9100,mqtt=10.0.0.1:1883", True),
        ("127.0.0.1", True),
        ("localhost,start=hand", True),
        ("[::1]:9100", True),
        ("10.0.0.1,mqtt=127.0.0.1:1883", False),
        ("10.0.0.1", False),
        ("robot,mqtt=localhost:1883", False),
    ],
)
def test_a_local_address_with_options_counts_as_local(address, local):
    assert is_loopback(address) is local


def test_a_low_sample_rate_is_refused_unless_watch_only(bench):
    bench.driver = WatchOnly
    with pytest.raises(ControllerError, match="too few samples to identify from"):
        bench.open()
    assert bench.warned == []
    bench.open(watching=True)
    assert "too few samples to identify from" in bench.warned[0]


def test_watching_also_checks_the_sample_rate(bench):
    with pytest.raises(ControllerError, match="every 2 ms"):
        bench.open(watching=True, rate=250.0)


def test_a_via_point_link_gets_points_instead_of_a_program(bench, program):
    point = ViaPoint(np.zeros(6), 0.0, 0.1)
    chosen = replace(program(), points=(point,))
    bench.driver = type("Told", (Points,), {"text": chosen.text})
    guard = bench.open()
    assert guard.takes_points
    assert bench.run(chosen, guard) == 1000
    assert guard.facts == {"said": "so"}
