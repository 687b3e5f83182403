"""The driver for CNR's programs against a controller that does exactly what a script says; its parts by their laws."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.cnr_address import CnrAddress, parse_address
from drivers.cnr_clock import ClockMatch
from drivers.cnr_motion import Arm, CnrMotion, stop_reason
from drivers.cnr_points import _Feeder, trajectories
from drivers.cnr_samples import Joiner
from drivers.cnr_sockets import Sockets
from drivers.errors import ConfigurationError, DriverError, MotionStopped, ProtocolError, RefusedError
from drivers.protocol import Driver, MeasuresCurrents, NeedsAPerson, TakesPoints, TellsFacts, ViaPoint
from drivers.registry import create
from drivers.wire import cnr
from drivers.wire.cnr import Message, MessageType, Point, QueueStatus

# --- the address


def test_a_real_controller_is_its_address():
    assert parse_address("192.168.254.245") == CnrAddress(
        "192.168.254.245", 1212, 1213, 1214, 21, "anonymous", "", "", ("192.168.254.245", 1883), "robot/arm1"
    )


def test_every_option_has_its_place():
    text = (
        "c5g, trajectory=1, feedback=2, status=3, ftp=4, user=u, password=p, folder=UD:/usr/agent, mqtt=lpc:5, "
        "topic=robot/arm3/, start=hand, mode=program"
    )
    assert parse_address(text) == CnrAddress(
        "c5g", 1, 2, 3, 4, "u", "p", "UD:/usr/agent", ("lpc", 5), "robot/arm3", points=False, by_hand=True
    )
    assert parse_address("c5g,mqtt=none,mode=points").broker is None
    assert parse_address("c5g,mqtt=lpc").broker == ("lpc", 1883)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "comes first"),
        ("ftp=21", "comes first"),
        ("c5g,port=9", "none of the options trajectory"),
        ("c5g,ftp", "none of the options"),
        ("c5g,ftp=0", "'0' is no port"),
        ("c5g,ftp=x", "'x' is no port"),
        ("c5g,mqtt=lpc:x", "host:port nor none"),
        ("c5g,mode=fast", "none of program, points"),
        ("c5g,topic=", "a text is expected"),
        ("c5g,mode=points,start=hand", "leave start=hand out"),
    ],
)
def test_other_addresses_say_what_is_allowed(text, said):
    with pytest.raises(ConfigurationError, match=said):
        create("cnr_comau", text)


def test_what_the_driver_offers_goes_by_its_address():
    programs, points = create("cnr_comau", "c5g"), create("cnr_comau", "c5g,mode=points")
    for driver in (programs, points):
        assert isinstance(driver, Driver)
        assert isinstance(driver, MeasuresCurrents)
        assert isinstance(driver, NeedsAPerson)
        assert isinstance(driver, TellsFacts)
    assert isinstance(points, TakesPoints)
    assert not isinstance(programs, TakesPoints)


# --- joining the topics

CHANNELS = ("a", "b", "c")
PERIOD = 2000.0


def messages(count, jitter=0, late=0):
    """(channel, time, values) of so many samples; the last channel is stamped `late` µs later."""
    rng = np.random.default_rng(count + jitter)
    made = []
    for k in range(count):
        stamp = 1_000_000 + 2000 * k + int(rng.integers(-jitter, jitter + 1))
        made += [(c, stamp + (late if c == 2 else 0), (float(k),) * 10) for c in range(3)]
    return made


def joined(joiner, given):
    for message in given:
        joiner.add(*message)
    return joiner.take()


@settings(deadline=None, max_examples=50)
@given(
    count=st.integers(2, 40),
    jitter=st.integers(0, 200),
    late=st.integers(-600, 600),
    seed=st.integers(0, 1000),
    reach=st.integers(1, 20),
)
def test_whatever_the_order_every_sample_is_joined_once(count, jitter, late, seed, reach):
    given = messages(count, jitter, late)
    rng = np.random.default_rng(seed)
    order = np.argsort(np.arange(len(given)) + rng.uniform(0, reach, len(given)), kind="stable")
    joiner = Joiner(CHANNELS, PERIOD)
    first = [m for m in given[:3]]  # nothing is known of the time before the first whole sample
    rest = [given[k] for k in order if k >= 3]
    times, values = joined(joiner, [*first, *rest])
    expected = [stamp for channel, stamp, _ in given if channel == 0]
    assert times.tolist() == expected
    assert (values[:, :, 0] == np.arange(count)[:, None]).all()
    assert (joiner.counts.late, joiner.counts.duplicate, joiner.counts.missing) == (0, 0, {})


@settings(deadline=None, max_examples=20)
@given(count=st.integers(300, 400), lost=st.sets(st.integers(3, 500), max_size=20))
def test_a_message_that_never_comes_costs_its_sample_and_no_other(count, lost):
    given = messages(count)
    joiner = Joiner(CHANNELS, PERIOD)
    times, _ = joined(joiner, [message for k, message in enumerate(given) if k not in lost])
    broken = {k // 3 for k in lost}
    expected = [1_000_000 + 2000 * k for k in range(count) if k not in broken]
    # The last samples may still wait for what comes in the next quarter of a second.
    assert times.tolist() == expected[: len(times)]
    assert len(times) >= len(expected) - 130
    known = {k for k in lost if 1_000_000 + 2000 * (k // 3) < times[-1]}
    absent = {k // 3 for k in known if {3 * (k // 3) + c for c in range(3)} <= lost}
    missing = sum(joiner.counts.missing.values())
    assert missing == len([k for k in known if k // 3 not in absent])


def test_what_comes_twice_or_late_is_counted():
    joiner = Joiner(CHANNELS, PERIOD)
    given = messages(4)
    joined(joiner, [given[0], given[0], *given[1:6], given[1]])
    assert (joiner.counts.duplicate, joiner.counts.late) == (1, 1)
    joiner.forget_counts()
    assert (joiner.counts.duplicate, joiner.counts.late) == (0, 0)


def test_memory_is_bounded_where_a_topic_is_dead():
    joiner = Joiner(CHANNELS, PERIOD)
    for k in range(30_000):
        joiner.add(0, 2000 * k, (0.0,) * 10)
    assert len(joiner._waiting) <= 20_001
    assert joiner.silent_channels() == ["b", "c"]
    assert Joiner(CHANNELS, PERIOD).silent_channels() == list(CHANNELS)


def test_a_clock_that_is_set_back_begins_anew():
    joiner = Joiner(CHANNELS, PERIOD)
    joined(joiner, messages(1000))
    times, _ = joined(joiner, messages(10))
    assert joiner.restarts == 1
    assert len(times) == 10


# --- the clocks


def moving(time):
    """(K, 2) positions of an arm that begins to move at 1 s."""
    way = np.maximum(0.0, np.asarray(time)[:, None] - 1.0)
    return 0.3 * (1 - np.cos(way * [1.3, 2.1]))


@settings(deadline=None, max_examples=12)
@given(
    offset=st.floats(-1e6, 1e6),
    drift=st.floats(-50e-6, 50e-6),
    phase=st.floats(0.0, 0.02),
    behind=st.integers(0, 150),
)
def test_the_clocks_are_aligned_by_what_both_saw(offset, drift, phase, behind):
    """Feedbacks every 20 ms in whole milliseconds; samples on a clock of their own, so many feedbacks behind them."""
    match, length = ClockMatch(), 5.0
    feedback, sample = np.arange(phase, length, 0.02), np.arange(0.0, length, 0.002)
    stamps, positions = sample + offset + drift * sample, moving(sample)
    for k in range(len(feedback) + behind):
        if k < len(feedback):
            match.feedback(np.floor(1000 * feedback[k]) / 1000, moving(feedback[k : k + 1])[0])
        part = slice(10 * (k - behind), 10 * (k - behind) + 10)
        if k >= behind and len(stamps[part]):
            match.samples(stamps[part], positions[part])
    alignment = match.alignment()
    # Whole milliseconds leave the middle of one unknown: half a millisecond either way.
    assert abs(alignment.offset - (offset + drift * alignment.middle)) < 0.6e-3
    assert 0.28e-3 < alignment.offset_deviation < 0.6e-3
    assert abs(alignment.drift - drift) < 5 * max(alignment.drift_deviation, 10e-6)
    assert alignment.sample_time(3.0) == pytest.approx(3.0 + offset + 3.0 * drift, abs=1e-3)
    assert alignment.count > 100


def test_an_arm_that_rests_tells_no_clock():
    match = ClockMatch()
    for k in range(5000):
        match.feedback(0.02 * k, np.zeros(2))
        match.samples(np.array([0.02 * k]), np.zeros((1, 2)))
    assert match.alignment() is None
    assert len(match._pending) <= 500


# --- one motion

ARM = Arm(2, 0.002, np.array([[2.0, 0.0], [0.5, -1.0]]))
READY = cnr.Status(1, 0, 0, 0, 0, 2, 1)
TEN = (0.0,) * 10


def motion(is_over=lambda feedback: feedback.last_point_processed == 7, broker=True):
    made = CnrMotion(ARM, 10**9, is_over, 1.0, (lambda: "nothing on x") if broker else None)
    made.started = True
    return made


def feedback(time, joints=(0.0, 0.0), moves=1, last=0, currents=(0.0, 0.0)):
    six = (0.0,) * 6
    return cnr.Feedback(1, six, six, six, (*joints, *TEN[2:]), (*currents, *TEN[2:]), six, last, time, moves)


def topics(times, joints, currents=(1.0, 2.0)):
    """Values (K, 5, 10) of an arm whose set-points are where it is, in degrees."""
    values = np.zeros((len(times), 5, 10))
    values[:, 0, :2] = values[:, 2, :2] = joints
    values[:, 4, :2] = currents
    return (np.asarray(times) * 1e6).astype(np.int64), values


def ramp(times):
    return np.maximum(0.0, np.asarray(times)[:, None] - 1.0) ** 2 * [10.0, 5.0]


def test_torque_is_current_times_constant_and_the_motion_has_little_rest_around_it():
    run = motion()
    times = np.arange(0.0, 3.0, 0.002)
    way = ramp(np.minimum(times, 2.0))
    for k in range(0, len(times), 10):
        now = times[k]
        run.samples(*topics(times[k : k + 10], way[k : k + 10]))
        run.feedbacks([feedback(int(1000 * now), way[k], moves=int(now < 2.0), last=7 if now >= 2.0 else 0)], READY)
        run.turn()
    blocks = list(run.motion.blocks())
    time = np.concatenate([block.time for block in blocks])
    assert time[0] == pytest.approx(0.9, abs=0.01)
    assert time[-1] == pytest.approx(2.1, abs=0.01)
    np.testing.assert_array_equal(np.concatenate([b.sequence for b in blocks]), np.arange(len(time)))
    np.testing.assert_allclose(blocks[0].torque[0], [2.0 * 1.0, 0.5 * 1.0 - 2.0])
    np.testing.assert_allclose(blocks[0].current[0], [1.0, 2.0])
    np.testing.assert_allclose(np.concatenate([b.position for b in blocks]), np.radians(ramp(np.minimum(time, 2.0))))


def test_missing_samples_are_gaps_by_their_times():
    run = motion()
    times = np.concatenate([np.arange(0.9, 1.5, 0.002), np.arange(1.52, 1.8, 0.002)])
    run.samples(*topics(times, ramp(times)))
    gaps = run.motion.sequencer.gaps
    assert [gap.count for gap in gaps] == [10]
    first = next(run.motion.blocks())
    assert run.motion.sequencer.expected == round((times[-1] - first.time[0]) / 0.002) + 1


def test_samples_that_end_before_the_motion_are_an_error():
    """Whatever the controller says of the end: a recording without it is none."""
    for heard in (0.0, 1.6):  # s of samples
        run = motion()
        run._patience = 0.0
        times = np.arange(0.0, 3.0, 0.002)
        way = ramp(np.minimum(times, 2.0))
        for k in range(0, len(times), 10):
            if times[k] < heard:
                run.samples(*topics(times[k : k + 10], way[k : k + 10]))
            moves = times[k] < 2.0
            run.feedbacks([feedback(int(1000 * times[k]), way[k], moves=int(moves), last=0 if moves else 7)], READY)
        run._silence = 60.0
        fault = run.turn()
        assert f"end {0.4 if heard else 1.0:.1f} s before the motion did: nothing on x" in str(fault)
        assert not run.motion.over


def test_a_clock_that_goes_back_in_motion_ends_it():
    run = motion()
    run.feedbacks([feedback(5000), feedback(5020)], READY)
    assert run.turn() is None
    run.feedbacks([feedback(10)], READY)
    assert "clock" in str(run.turn())


def received(run):
    """Times of the samples that are handed out before the motion ends with an error about a clock."""
    times = []
    with pytest.raises(DriverError, match="clock"):
        times.extend(block.time for block in run.motion.blocks())
    return np.concatenate(times) if times else np.empty(0)


def test_samples_that_a_busy_broker_still_has_are_waited_for_when_the_motion_fails():
    """The sockets know of the fault while not one sample of the motion has come through."""
    run = motion()
    times = np.arange(0.0, 2.0, 0.002)
    way = ramp(times)
    for k in range(0, len(times), 10):
        run.feedbacks([feedback(int(1000 * times[k]), way[k])], READY)
    run.feedbacks([feedback(10)], READY)
    run.fail(run.turn())
    for k in range(0, len(times), 10):
        assert not run.motion.over
        run.feedbacks([feedback(30)], READY)
        run.samples(*topics(times[k : k + 10], way[k : k + 10]))
        assert run.turn() is None
    assert run.motion.over
    assert received(run)[-1] == pytest.approx(1.98, abs=0.03)


@settings(deadline=None, max_examples=20)
@given(size=st.integers(20, 2000))
def test_samples_of_a_clock_that_went_back_are_none_of_the_motion(size):
    """However many arrive at once, before and after in one go among them."""
    run = motion()
    times = np.concatenate([np.arange(10.0, 12.0, 0.002), np.arange(0.0, 2.0, 0.002)])
    way = ramp(times - np.where(times >= 10.0, 10.0, -1.0))
    for k in range(0, len(times), size):
        run.samples(*topics(times[k : k + size], way[k : k + size]))
        if not run.failing and (fault := run.turn()) is not None:
            run.fail(fault)
    run.turn()
    assert run.motion.over
    handed_out = received(run)
    assert (handed_out[0], handed_out[-1]) == pytest.approx((10.9, 11.998), abs=0.01)
    np.testing.assert_allclose(np.diff(handed_out), 0.002)


def test_a_motion_that_fails_does_not_wait_for_a_broker_that_is_gone():
    run = motion()
    run.feedbacks([feedback(int(20 * k), ramp([0.02 * k])[0]) for k in range(100)], READY)
    run.fail(DriverError("a clock, or whatever it is"))
    run.turn()
    assert not run.motion.over
    run._silence = 60.0
    run.turn()
    assert run.motion.over
    assert len(received(run)) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"e_stopped": 1}, "emergency stop"),
        ({"in_error": 1, "error_code": 62513}, "62513"),
        ({"drives_powered": 0}, "drives"),
        ({"mode": 1}, "selector"),
        ({"motion_possible": 0}, "cell"),
        ({}, "by hand"),
    ],
)
def test_a_stop_by_the_controller_has_its_reason(change, said):
    state = cnr.Status(**{**READY.__dict__, **change})
    run = motion(broker=False)
    run.feedbacks([feedback(20), feedback(40)], READY)
    for k in range(20):
        run.feedbacks([feedback(60 + 20 * k, moves=0)], state)
        run.turn()
    with pytest.raises(MotionStopped, match=said):
        list(run.motion.blocks())
    assert (stop_reason(state) is None) == (not change)


def test_a_short_rest_on_the_way_is_no_stop():
    run = motion(broker=False)
    run.feedbacks([feedback(20)], READY)
    for k in range(5):
        run.feedbacks([feedback(40 + 20 * k, moves=0)], READY)
        run.turn()
    assert not run.motion.over
    run.feedbacks([feedback(200), feedback(220, moves=0, last=7)], READY)
    run.turn()
    assert run.motion.over
    assert len(list(run.motion.blocks())) == 8


def test_a_program_started_by_hand_is_over_when_the_arm_has_rested():
    run = motion(is_over=None, broker=False)
    for k in range(150):
        now = 20 * k
        run.feedbacks([feedback(now, (min(now, 400) * 0.01, 0.0), moves=0)], READY)
        run.turn()
    assert run.motion.over
    blocks = list(run.motion.blocks())
    assert blocks[-1].time[-1] == pytest.approx(0.4 + 2.0, abs=0.1)
    assert blocks[0].velocity is None
    assert blocks[0].reference_position is None


# --- the sockets


class Script:
    """A controller: feedback and status in lock step, and an answer to every command by `reply(message)`."""

    def __init__(self, reply: Callable[[Message], Message | None], order: str = cnr.LITTLE) -> None:
        self.heard: list[Message] = []
        self.reply = reply
        self.order = order
        self.state = READY
        self.feedback = feedback(1000, moves=0)
        self.answered = threading.Semaphore(0)
        self.listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
        ports = [listener.getsockname()[1] for listener in self.listeners]
        self.address = CnrAddress("127.0.0.1", *ports)
        for listener, serve in zip(self.listeners, (self._commands, self._feedbacks, self._states), strict=True):
            threading.Thread(target=self._accept, args=(listener, serve), daemon=True).start()

    def _accept(self, listener: socket.socket, serve: Callable[[socket.socket], None]) -> None:
        with contextlib.suppress(OSError):
            connection, _ = listener.accept()
            with connection:
                serve(connection)

    def _commands(self, connection: socket.socket) -> None:
        decoder = cnr.Decoder(self.order)
        while data := connection.recv(65536):
            for message in decoder.feed(data):
                self.heard.append(message)
                answer = self.reply(message)
                if answer is not None:
                    connection.sendall(cnr.encode(answer, self.order))

    def _feedbacks(self, connection: socket.socket) -> None:
        self._lock_step(connection, MessageType.FEEDBACK, lambda: self.feedback)

    def _states(self, connection: socket.socket) -> None:
        self._lock_step(connection, MessageType.STATUS, lambda: self.state)

    def _lock_step(self, connection: socket.socket, kind: MessageType, record: Callable[[], object]) -> None:
        decoder = cnr.Decoder(self.order)
        while True:
            sent = Message(kind, 2, 0, record())
            connection.sendall(cnr.encode(sent, self.order))
            answers: list[Message] = []
            while not answers:
                data = connection.recv(65536)
                if not data:
                    return
                answers += decoder.feed(data)
            assert answers == [Message(kind, 3, 1, sent.record)]
            self.answered.release()
            connection.settimeout(5)

    def close(self) -> None:
        for listener in self.listeners:
            listener.close()


def success(message: Message, queue=QueueStatus.READY, done=True) -> Message:
    number = message.record.sequence_number
    return Message(message.type, 3, 1 if done else 2, Point(queue_status=queue, sequence_number=number))


@pytest.fixture
def linked():
    """`linked(reply)` → (script, sockets that are open); `failures` are what ended them."""
    with contextlib.ExitStack() as undo:

        def build(reply=success, timeout=5.0, order=cnr.LITTLE):
            script = Script(reply, order)
            undo.callback(script.close)
            failures: list[DriverError] = []
            sockets = Sockets(script.address, timeout, lambda _: None, failures.append, MessageType.STOP)
            undo.callback(sockets.close)
            sockets.failures = failures
            return script, sockets

        yield build


@pytest.mark.parametrize("order", [cnr.LITTLE, cnr.BIG])
def test_feedback_and_status_come_back_as_they_came(linked, order):
    script, sockets = linked(order=order)
    for _ in range(10):
        assert script.answered.acquire(timeout=10)
    assert sockets.feedback() == script.feedback
    script.state = cnr.Status(0, 1, 7, 1, 0, 1, 0)
    assert sockets.fresh_status() == script.state  # made after the question, not before
    assert [message.type for message in script.heard] == [MessageType.PING]


def test_a_command_that_is_not_answered_is_not_sent_again(linked):
    script, sockets = linked(lambda m: success(m) if m.type == MessageType.PING else None, timeout=0.3)
    assert sockets.command(MessageType.START, Point(sequence_number=5)) is None
    assert [m.type for m in script.heard].count(MessageType.START) == 1


@pytest.mark.parametrize(("moves", "kind"), [(0, RefusedError), (1, DriverError)])
def test_a_start_that_is_refused_because_the_arm_moves_is_no_refusal(linked, moves, kind):
    """Programs that still have the permission of the trajectory before begin with the first points that come."""
    script, sockets = linked(lambda message: success(message, done=message.type != MessageType.START))
    script.feedback = feedback(10, moves=moves)
    assert sockets.wait_feedback(lambda: sockets.feedback().is_moving == moves, 20)
    with pytest.raises(DriverError) as refused:
        create("cnr_comau", "127.0.0.1,mode=points")._command_start(sockets, "the start", Point())
    assert type(refused.value) is kind


def test_a_late_answer_is_not_taken_for_that_of_the_next_command(linked):
    kept = []

    def reply(message):
        if message.type == MessageType.START:
            kept.append(success(message, done=False))
            return None
        if kept:
            with contextlib.suppress(IndexError):
                return kept.pop()
        return success(message)

    _, sockets = linked(reply, timeout=0.3)
    assert sockets.command(MessageType.START) is None
    assert sockets.command(MessageType.STOP) is None  # what came was of the start
    assert sockets.command(MessageType.STOP).success


def test_programs_that_do_not_answer_a_ping_are_refused(linked):
    with pytest.raises(DriverError, match="does not answer a ping"):
        linked(lambda _: None, timeout=0.3)


def test_a_client_that_is_one_too_many_is_told(linked):
    script = Script(success)
    script._feedbacks = lambda connection: None
    for listener in script.listeners:
        listener.close()
    script.listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
    for listener in script.listeners:
        threading.Thread(target=script._accept, args=(listener, lambda _: None), daemon=True).start()
    ports = [listener.getsockname()[1] for listener in script.listeners]
    with pytest.raises(RefusedError, match="another client"):
        Sockets(CnrAddress("127.0.0.1", *ports), 5.0, lambda _: None, lambda _: None, MessageType.STOP)
    script.close()


def test_a_turn_that_fails_ends_the_link_with_a_message(linked):
    script = Script(success)
    failures = []

    def fail(feedbacks):
        if feedbacks:
            raise ValueError("as told")

    with pytest.raises(ProtocolError, match="as told"):
        Sockets(script.address, 5.0, fail, failures.append, MessageType.STOP)
    assert len(failures) == 1
    script.close()


# --- the queue of points


def via(count, stops=()):
    """So many points, stops at these and at the last."""
    return [
        ViaPoint(np.array([0.1 * k, -0.1]), 0.0 if k in stops or k == count - 1 else 0.02, 0.5) for k in range(count)
    ]


def test_points_are_what_the_program_says_in_the_units_of_the_wire():
    (first, second), (third,) = trajectories(via(3, stops=(1,)), 2)
    assert (first.sequence_number, second.sequence_number, third.sequence_number) == (1, 2, 1)
    assert (first.fly_tolerance, second.fly_tolerance, first.linear_vel) == (20.0, 0.0, 0.5)
    assert second.joints == pytest.approx((np.degrees(0.1), np.degrees(-0.1), *[0.0] * 8))


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([], "end with a stop"),
        (via(2)[:1], "end with a stop"),
        ([ViaPoint(np.zeros(3), 0.0, 0.5)], "2 joint positions"),
        ([ViaPoint(np.array([np.nan, 0]), 0.0, 0.5)], "point 1"),
        ([ViaPoint(np.zeros(2), 0.0, 0.0)], "speed 0"),
        ([ViaPoint(np.zeros(2), -1.0, 0.5), *via(1)], "fly_tolerance -1"),
    ],
)
def test_points_that_say_nothing_are_refused(points, said):
    with pytest.raises(RefusedError, match=said):
        trajectories(points, 2)


def sent(script):
    return [(message.type, message.record.sequence_number) for message in script.heard if message.type != 1]


def test_points_go_in_order_and_the_last_is_followed_by_the_end(linked):
    script, sockets = linked()
    _Feeder(sockets, trajectories(via(4), 2)).fill(motion())
    assert sent(script) == [(3001, 1), (3001, 2), (3001, 3), (3001, 4), (3002, 0)]


def test_a_full_queue_waits_until_it_has_room_and_no_taken_point_is_sent_again(linked):
    """The queue takes the second point and is full, refuses nothing; two pings later there is room."""
    pings = []

    def reply(message):
        if message.type == MessageType.PING:
            pings.append(message)
            return success(message, QueueStatus.BUSY if len(pings) in (2, 3) else QueueStatus.READY)
        full = message.type == MessageType.POINT and message.record.sequence_number == 2
        return success(message, QueueStatus.BUSY if full else QueueStatus.READY)

    script, sockets = linked(reply)
    feeder, run = _Feeder(sockets, trajectories(via(4), 2)), motion()
    feeder.fill(run)
    assert sent(script) == [(3001, 1), (3001, 2)]
    feeder.started()
    script.feedback = feedback(1000, moves=1)
    assert sockets.wait_feedback(lambda: sockets.feedback().is_moving == 1, 10)
    feeder.is_over(sockets.feedback())
    script.feedback = feedback(2000, moves=0, last=4)
    assert not feeder.go_on(run)
    assert sent(script) == [(3001, 1), (3001, 2), (3001, 3), (3001, 4), (3002, 0)]
    assert len(pings) == 4


def test_a_point_that_a_full_queue_did_not_take_is_sent_when_there_is_room(linked):
    seen = []

    def reply(message):
        if message.type == MessageType.POINT and message.record.sequence_number == 2 and not seen:
            seen.append(message)
            return success(message, QueueStatus.BUSY, done=False)
        return success(message)

    script, sockets = linked(reply)
    feeder, run = _Feeder(sockets, trajectories(via(2), 2)), motion()
    feeder.fill(run)
    feeder.fill(run)
    assert sent(script) == [(3001, 1), (3001, 2), (3001, 2), (3002, 0)]


def test_a_sequence_error_refuses_the_motion(linked):
    script, sockets = linked(
        lambda m: success(m, QueueStatus.ERROR, done=False) if m.type == MessageType.POINT else success(m)
    )
    with pytest.raises(RefusedError, match="expects another number"):
        _Feeder(sockets, trajectories(via(2), 2)).fill(motion())
    assert sent(script) == [(3001, 1)]


def test_an_answer_that_comes_late_is_found_behind_a_ping(linked):
    kept = []

    def reply(message):
        if message.type == MessageType.POINT and message.record.sequence_number == 1 and not kept:
            kept.append(success(message))
            return None
        if message.type == MessageType.PING and kept:
            return kept[0]
        return success(message)

    script, sockets = linked(reply, timeout=0.3)
    _Feeder(sockets, trajectories(via(2), 2)).fill(motion())
    assert sent(script) == [(3001, 1), (3001, 2), (3002, 0)]


def test_a_point_that_nobody_answers_for_is_not_sent_again(linked):
    script, sockets = linked(lambda m: None if m.type == MessageType.POINT else success(m), timeout=0.3)
    with pytest.raises(DriverError, match="not sent again"):
        _Feeder(sockets, trajectories(via(2), 2)).fill(motion())
    assert sent(script) == [(3001, 1)]


def test_the_end_of_a_trajectory_before_is_not_that_of_the_next(linked):
    script, sockets = linked()
    feeder = _Feeder(sockets, trajectories(via(4, stops=(1,)), 2))  # both have two points
    feeder.fill(motion())
    feeder.started()
    assert not feeder.is_over(feedback(0, moves=0, last=2))  # of a motion before
    assert not feeder.is_over(feedback(20, moves=1, last=2))
    script.feedback = feedback(2000, moves=0, last=2)
    assert feeder.go_on(motion())
    feeder.started()
    assert not feeder.is_over(feedback(2020, moves=0, last=2))  # of the first
    assert not feeder.is_over(feedback(2040, moves=0, last=1))
    assert feeder.is_over(feedback(2060, moves=0, last=2))
