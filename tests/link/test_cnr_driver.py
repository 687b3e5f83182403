"""The driver for CNR's programs against a controller that does exactly what a script says."""

import contextlib
import socket
import threading

import numpy as np
import pytest

from drivers.errors import ConfigurationError, DriverError, ProtocolError, RefusedError
from drivers.protocol import AcceptsViaPoints, Driver, MeasuresCurrents, ReportsDiagnostics, RequiresOperator, ViaPoint
from drivers.registry import create
from drivers.transports.cnr.address import CnrAddress, parse_address
from drivers.transports.cnr.feeder import Feeder, trajectories
from drivers.transports.cnr.sockets import Sockets
from drivers.wire import cnr
from drivers.wire.cnr import MessageType, Point, QueueStatus
from tests.conftest import patience
from tests.link.cnr_script import Script, feedback, motion, success

# --- the address


def test_a_plain_address_has_the_default_ports():
    assert parse_address("192.168.254.245") == CnrAddress(
        "192.168.254.245", 1212, 1213, 1214, 21, "anonymous", "", "", ("192.168.254.245", 1883), "robot/arm1"
    )


def test_every_option_is_read():
    text = (
        "c5g, trajectory=1, feedback=2, status=3, ftp=4, user=u, password_from=env:FTP, folder=UD:/usr/agent, "
        "mqtt=lpc:5, mqtt_user=m, mqtt_password_from=file:/a/b, topic=robot/arm3/, start=hand, mode=program"
    )
    assert parse_address(text) == CnrAddress(
        "c5g", 1, 2, 3, 4, "u", "env:FTP", "UD:/usr/agent", ("lpc", 5), "robot/arm3", False, True, "m", "file:/a/b"
    )
    assert parse_address("c5g,mqtt=none,mode=points").broker is None
    assert parse_address("c5g,mqtt=lpc").broker == ("lpc", 1883)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "comes first"),
        ("ftp=21", "comes first"),
        ("c5g,port=9", "none of trajectory"),
        ("c5g,ftp", "none of trajectory"),
        ("c5g,ftp=0", "a port is expected"),
        ("c5g,ftp=x", "a port is expected"),
        ("c5g,mqtt=lpc:x", "host:port or none"),
        ("c5g,mode=fast", "program or points"),
        ("c5g,topic=", "a text is expected"),
        ("c5g,mode=points,start=hand", "leave start=hand out"),
    ],
)
def test_other_addresses_say_what_is_allowed(text, said):
    with pytest.raises(ConfigurationError, match=said):
        create("cnr_comau", text)


def test_the_address_selects_what_the_driver_offers():
    programs, points = create("cnr_comau", "c5g"), create("cnr_comau", "c5g,mode=points")
    for driver in (programs, points):
        assert isinstance(driver, Driver)
        assert isinstance(driver, MeasuresCurrents)
        assert isinstance(driver, RequiresOperator)
        assert isinstance(driver, ReportsDiagnostics)
    assert isinstance(points, AcceptsViaPoints)
    assert not isinstance(programs, AcceptsViaPoints)


# --- the sockets


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
def test_feedback_and_status_are_passed_on_unchanged(linked, order):
    script, sockets = linked(order=order)
    for _ in range(10):
        assert script.answered.acquire(timeout=10)
    assert sockets.feedback() == script.feedback
    script.state = cnr.StatusMessage(0, 1, 7, 1, 0, 1, 0)
    assert sockets.fresh_status() == script.state  # made after the question, not before
    assert [message.type for message in script.heard] == [MessageType.PING]


def test_a_command_that_is_not_answered_is_not_sent_again(linked):
    script, sockets = linked(lambda m: success(m) if m.type == MessageType.PING else None, timeout=patience(0.3))
    assert sockets.command(MessageType.START, Point(sequence_number=5)) is None
    assert [m.type for m in script.heard].count(MessageType.START) == 1


def test_watches_a_start_that_acts_before_its_answer(linked):
    class Moves:
        """As the motion that the driver follows: stationary before the start, in motion once it was heard."""

        @property
        def begun(self):
            return any(m.type == MessageType.START for m in script.heard)

    script, sockets = linked(lambda m: success(m) if m.type == MessageType.PING else None)
    run = Moves()
    create("cnr_comau", "c5g", start_timeout=600.0)._command_start(sockets, run, "the start", 5)
    assert run.started
    assert [m.type for m in script.heard].count(MessageType.START) == 1
    hasty = create("cnr_comau", "c5g", start_timeout=patience(0.3))
    with pytest.raises(DriverError, match="did not answer the start"):  # it moves already, which proves nothing
        hasty._command_start(sockets, Moves(), "the start", 5)


@pytest.mark.parametrize(("moves", "kind"), [(0, RefusedError), (1, DriverError)])
def test_a_start_refused_while_the_arm_moves_counts_as_started(linked, moves, kind):
    """Programs that still have the permission of the trajectory before begin with the first points that come."""
    script, sockets = linked(lambda message: success(message, done=message.type != MessageType.START))
    script.feedback = feedback(10, moves=moves)
    assert sockets.wait(lambda: sockets.feedback().is_moving == moves, 20)
    with pytest.raises(DriverError) as refused:
        create("cnr_comau", "127.0.0.1,mode=points")._command_start(sockets, motion(), "the start")
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

    _, sockets = linked(reply, timeout=patience(0.3))
    assert sockets.command(MessageType.START) is None
    assert sockets.command(MessageType.STOP) is None  # what came was of the start
    assert sockets.command(MessageType.STOP).success


def test_programs_that_do_not_answer_a_ping_are_refused(linked):
    with pytest.raises(DriverError, match="does not answer a ping"):
        linked(lambda _: None, timeout=patience(0.3))


def test_reports_one_client_too_many(linked):
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


def test_an_error_in_the_link_loop_ends_the_link_with_a_message(linked):
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


def test_via_points_match_the_program_in_wire_units():
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
def test_refuses_invalid_via_points(points, said):
    with pytest.raises(RefusedError, match=said):
        trajectories(points, 2)


def sent(script):
    return [(message.type, message.record.sequence_number) for message in script.heard if message.type != 1]


def test_sends_points_in_order_and_then_the_end(linked):
    script, sockets = linked()
    Feeder(sockets, trajectories(via(4), 2)).fill(motion())
    assert sent(script) == [(3001, 1), (3001, 2), (3001, 3), (3001, 4), (3002, 0)]


def test_a_full_queue_waits_and_accepted_points_are_not_resent(linked):
    """The queue takes the second point and is full, but refuses nothing; two pings later it has space again."""
    pings = []

    def reply(message):
        if message.type == MessageType.PING:
            pings.append(message)
            return success(message, QueueStatus.BUSY if len(pings) in (2, 3) else QueueStatus.READY)
        full = message.type == MessageType.POINT and message.record.sequence_number == 2
        return success(message, QueueStatus.BUSY if full else QueueStatus.READY)

    script, sockets = linked(reply)
    feeder, run = Feeder(sockets, trajectories(via(4), 2)), motion()
    feeder.fill(run)
    assert sent(script) == [(3001, 1), (3001, 2)]
    feeder.started()
    script.feedback = feedback(1000, moves=1)
    assert sockets.wait(lambda: sockets.feedback().is_moving == 1, 10)
    feeder.is_over(sockets.feedback())
    script.feedback = feedback(2000, moves=0, last=4)
    assert not feeder.go_on(run)
    assert sent(script) == [(3001, 1), (3001, 2), (3001, 3), (3001, 4), (3002, 0)]
    assert len(pings) == 4


def test_a_point_rejected_by_a_full_queue_is_sent_again_later(linked):
    seen = []

    def reply(message):
        if message.type == MessageType.POINT and message.record.sequence_number == 2 and not seen:
            seen.append(message)
            return success(message, QueueStatus.BUSY, done=False)
        return success(message)

    script, sockets = linked(reply)
    feeder, run = Feeder(sockets, trajectories(via(2), 2)), motion()
    feeder.fill(run)
    feeder.fill(run)
    assert sent(script) == [(3001, 1), (3001, 2), (3001, 2), (3002, 0)]


def test_a_sequence_error_refuses_the_motion(linked):
    script, sockets = linked(
        lambda m: success(m, QueueStatus.ERROR, done=False) if m.type == MessageType.POINT else success(m)
    )
    with pytest.raises(RefusedError, match="expects another number"):
        Feeder(sockets, trajectories(via(2), 2)).fill(motion())
    assert sent(script) == [(3001, 1)]


def test_a_ping_flushes_a_late_answer(linked):
    kept = []

    def reply(message):
        if message.type == MessageType.POINT and message.record.sequence_number == 1 and not kept:
            kept.append(success(message))
            return None
        if message.type == MessageType.PING and kept:
            return kept[0]
        return success(message)

    script, sockets = linked(reply, timeout=patience(0.3))
    Feeder(sockets, trajectories(via(2), 2)).fill(motion())
    assert sent(script) == [(3001, 1), (3001, 2), (3002, 0)]


def test_an_unanswered_point_is_not_resent(linked):
    script, sockets = linked(lambda m: None if m.type == MessageType.POINT else success(m), timeout=patience(0.3))
    with pytest.raises(DriverError, match="not sent again"):
        Feeder(sockets, trajectories(via(2), 2)).fill(motion())
    assert sent(script) == [(3001, 1)]


def test_the_end_of_an_earlier_trajectory_does_not_end_the_next(linked):
    script, sockets = linked()
    feeder = Feeder(sockets, trajectories(via(4, stops=(1,)), 2))  # both have two points
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
