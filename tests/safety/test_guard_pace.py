"""A link that cannot tell the override, takes points, or has too few samples: what the guard makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.errors import ControllerError, InputError, SafetyError
from agent.safety.pace import ALLOWANCE, SHARE, PaceCheck
from agent.safety.preconditions import is_loopback
from drivers.protocol import ViaPoint
from drivers.tcp import TcpDriver

PERIOD = 0.002


class WithoutOverride(TcpDriver):
    """The real driver, on a wire that has no override; its set-points follow a plan, `scale` times as slowly."""

    plan = None
    scale = 1.0

    def status(self):
        return replace(super().status(), override_known=False)

    def samples(self):
        for block in super().samples():
            yield replace(block, reference_position=reference(self.plan, block.time, self.scale))


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


def reference(chain, times, scale):
    """(K, n) of a chain that takes `scale` times as long as planned."""
    return np.column_stack([np.interp(times, scale * chain.t, column) for column in chain.q.T])


@pytest.fixture(scope="module")
def swing(trajectory_through):
    """`swing(seconds, turn, start)`: from rest to rest."""

    def build(seconds=8.0, turn=1.0, start=0.0):
        knots = np.full((5, 3), start)
        knots[:, 0] += turn * np.array([0.0, 0.4, 0.3, 0.8, 1.0])
        return trajectory_through(knots, seconds)

    return build


def follow(check, *pieces, chunk=10):
    """Reason and time [s] at which a check says stop; None where it never does. Pieces are (K, n) set-points."""
    everything = np.concatenate(pieces)
    times = PERIOD * np.arange(len(everything))
    for start in range(0, len(times), chunk):
        part = slice(start, start + chunk)
        reason = check.take(times[part], everything[part])
        if reason is not None:
            return reason, float(times[part][-1])
    return None


def paced(chain, scale):
    return reference(chain, np.arange(0.0, scale * chain.t[-1] + PERIOD, PERIOD), scale)


@settings(deadline=None, max_examples=30)
@given(scale=st.floats(0.85, 1.18))
def test_an_interpolator_that_is_not_ours_is_no_reason(swing, scale):
    chain = swing()
    assert follow(PaceCheck([chain]), paced(chain, scale)) is None


@settings(deadline=None, max_examples=30)
@given(scale=st.one_of(st.floats(1.5, 20.0), st.floats(0.1, 0.6)))
def test_another_override_is(swing, scale):
    chain = swing()
    reason, _ = follow(PaceCheck([chain]), paced(chain, scale))
    assert "override is not at 100 %" in reason


def test_half_the_speed_is_seen_within_three_seconds(swing):
    chain = swing()
    _, when = follow(PaceCheck([chain]), paced(chain, 2.0))
    # Behind by half of the time, where a share of the planned half is allowed.
    assert when == pytest.approx(ALLOWANCE / (0.5 - 0.5 * SHARE), abs=0.3)


@pytest.mark.parametrize("chunk", [1, 7, 100, 1000])
def test_however_the_samples_are_cut(swing, chunk):
    chain = swing()
    _, when = follow(PaceCheck([chain]), paced(chain, 2.0), chunk=chunk)
    _, exact = follow(PaceCheck([chain]), paced(chain, 2.0), chunk=1)
    assert exact <= when < exact + chunk * PERIOD
    assert follow(PaceCheck([chain]), paced(chain, 1.0), chunk=chunk) is None


def test_an_override_turned_down_on_the_way_is_seen(swing):
    chain = swing()
    first = paced(chain, 1.0)[:1500]
    times = np.arange(3.0, 11.0, PERIOD)
    rest = np.column_stack([np.interp(3.0 + (times - 3.0) / 4, chain.t, column) for column in chain.q.T])
    assert follow(PaceCheck([chain]), first, rest) is not None


def test_rests_between_stretches_take_as_long_as_they_take(swing):
    there, back = swing(), swing(turn=-1.0, start=1.0)
    back = replace(back, q=back.q + (there.q[-1] - back.q[0]))
    for rest in (0.02, 5.0):
        pause = np.repeat(there.q[-1:], round(rest / PERIOD), axis=0)
        assert follow(PaceCheck([there, back]), paced(there, 1.0), pause, paced(back, 1.0)) is None
        assert follow(PaceCheck([there, back]), paced(there, 1.0), pause, paced(back, 2.0)) is not None


def test_set_points_that_hold_for_a_moment_end_no_stretch(swing):
    chain = swing()
    moving = paced(chain, 2.0)
    held = np.concatenate([moving[:500], np.repeat(moving[500:501], 2, axis=0), moving[500:]])
    assert follow(PaceCheck([chain]), held) is not None


def test_an_approach_that_was_there_already_has_no_stretch(swing):
    here = swing(turn=1e-4)
    chain = swing()
    assert follow(PaceCheck([here, chain]), paced(chain, 1.0)) is None
    assert follow(PaceCheck([here, chain]), paced(chain, 2.0)) is not None


def test_what_was_not_planned_is_not_compared(swing):
    chain, other = swing(), swing(start=0.5)
    assert follow(PaceCheck([chain]), paced(other, 3.0)) is None
    assert follow(PaceCheck([]), paced(chain, 3.0)) is None
    assert follow(PaceCheck([chain]), paced(chain, 1.0), np.repeat(chain.q[-1:], 10, axis=0), paced(other, 3.0)) is None


def test_the_guard_stops_a_slow_run_where_it_cannot_read_the_override(bench, program):
    chosen = program()
    chosen = replace(chosen, chains=(slowly(chosen.chains[0], 10),))
    bench.controller = replace(bench.controller, blocks=60)
    bench.driver = type("Slow", (WithoutOverride,), {"plan": chosen.chains[0], "scale": 2.0})
    guard, received = bench.open(), []
    guard.send(chosen)
    with pytest.raises(SafetyError, match="override is not at 100 %"), guard.motion(chosen) as samples:
        received += samples
    assert bench.controller.stops > 0
    assert len(received) < 30  # it was stopped when it was seen, not at the end
    guard.close()
    bench.driver = type("Planned", (WithoutOverride,), {"plan": chosen.chains[0], "scale": 1.0})
    assert bench.run(chosen) == 6000


def test_an_arm_that_is_stopped_for_another_reason_is_not_called_slow(bench, program):
    chosen = program()
    chosen = replace(chosen, chains=(slowly(chosen.chains[0], 10),))
    bench.controller = replace(bench.controller, blocks=60, pushes=True, later={"mode": "teach"})
    bench.driver = type("Slow", (WithoutOverride,), {"plan": chosen.chains[0], "scale": 2.0})
    with pytest.raises(SafetyError, match="the mode was changed"):
        bench.run(chosen)


def slowly(chain, factor):
    return replace(chain, t=chain.t * factor, qd=chain.qd / factor)


def test_where_the_override_is_known_nothing_is_compared(bench, program):
    chosen = program()
    chosen = replace(chosen, chains=(slowly(chosen.chains[0], 10),))
    bench.controller = replace(bench.controller, blocks=60, pushes=True)
    follows = {"plan": chosen.chains[0], "scale": 2.0, "status": TcpDriver.status}
    bench.driver = type("Slow", (WithoutOverride,), follows)
    assert bench.run(chosen) == 6000


def test_set_points_that_the_wire_does_not_have_are_not_compared(bench, program):
    class Nothing(WithoutOverride):
        def samples(self):
            return (replace(block, reference_position=None) for block in TcpDriver.samples(self))

    bench.driver = Nothing
    assert bench.run(program()) == 1000


def test_a_person_is_asked_for_the_override_where_it_cannot_be_read(bench):
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
def test_an_address_with_options_is_on_this_machine_if_its_host_is(address, local):
    assert is_loopback(address) is local


def test_too_few_samples_are_refused_and_may_be_watched(bench):
    bench.driver = WatchOnly
    with pytest.raises(ControllerError, match="too few samples to identify from"):
        bench.open()
    assert bench.warned == []
    bench.open(watching=True)
    assert "too few samples to identify from" in bench.warned[0]


def test_watching_a_link_with_enough_samples_still_checks_their_rate(bench):
    with pytest.raises(ControllerError, match="every 2 ms"):
        bench.open(watching=True, rate=250.0)


def test_a_link_that_takes_points_gets_them_and_no_program(bench, program):
    point = ViaPoint(np.zeros(6), 0.0, 0.1)
    chosen = replace(program(), points=(point,))
    bench.driver = type("Told", (Points,), {"text": chosen.text})
    guard = bench.open()
    assert guard.takes_points
    assert bench.run(chosen, guard) == 1000
    assert guard.facts == {"said": "so"}


def test_other_links_take_programs_and_know_no_more(bench, program):
    guard = bench.open()
    assert not guard.takes_points
    assert guard.facts == {}
