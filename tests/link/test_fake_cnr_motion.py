"""The fake's link of socket programs in bytes from the layouts: queued points, stops, clients that leave, faults."""

import struct

import numpy as np
import pytest

from drivers.wire.reasons import EndReason
from fake_controller.build import build_controller
from fake_controller.faults import Fault
from fake_controller.servers import NoBrokerError
from fake_controller.servers.cnr.server import CnrServer
from tests.conftest import free_port
from tests.link.cnr_peer import CLOCK_OFFSET, LONG, SHORT, TOPICS, Records, Samples, point, program, start, trajectory


def test_queued_points_move_as_the_same_fly_program_does(serve):
    """Speed and tolerance of a point are those of the FLY statement; the last ends with a FINE stop."""
    joints = [(10, 0, -90, 0, 20, 0), (15, 10, -100, 0, 25, 0), (0, 10, -95, 10, 30, 0)]
    fly = (
        "$FLY_TYPE = FLY_CART, $SPD_OPT = SPD_LIN, $FLY_TRAJ = FLY_TOL, $STRESS_PER = 50, $FLY_DIST = 5, $LIN_SPD = 0.3"
    )
    *through, last = [f"LINEAR TO {{{', '.join(map(str, place))}}}" for place in joints]
    body = [f"  MOVEFLY {to} ADVANCE,\n    WITH {fly}, $TERM_TYPE = COARSE,\n  ENDMOVE" for to in through]
    body.append(f"  MOVE {last},\n    WITH {fly}, $TERM_TYPE = FINE,\n  ENDMOVE")

    motions = []
    for kind in ("program", "points"):
        bench = serve(robot="comau_ns16")
        feedback, link = bench.feedback(), bench.trajectory()
        bench.store(program("  MOVE JOINT TO {0, 0, -90, 0, 20, 0}"))
        assert link.done(start(1))
        feedback.until_rest()
        told = len(feedback.all)
        if kind == "program":
            bench.store(program("\n".join(body)))
            assert link.done(start(2))
        else:
            for k, place in enumerate(joints):
                assert link.done(point(k + 1, place))
            assert link.done(trajectory(3002))
            assert link.done(start())
        feedback.until_rest(told)
        motions.append(bench.recorded().reference_position)
    np.testing.assert_allclose(motions[1], motions[0], atol=1e-6)
    np.testing.assert_allclose(motions[1][-1], np.radians(joints[-1]), atol=1e-6)


def test_the_queue_takes_consecutive_numbers_only(bench):
    link = bench.trajectory()
    assert not link.done(point(2, (20, -30)))
    assert link.done(point(1, (20, -30)))
    header, body = link.ask(point(3, (20, -30)))
    assert (header[3], body[1]) == (2, 3)
    assert link.done(point(2, (20, -30)))
    assert link.done(trajectory(3002))
    assert not link.done(point(3, (20, -30))), "it would come after the end"
    assert link.done(point(1, (20, -30))), "a new trajectory"


def test_a_full_queue_is_busy_until_the_arm_reads_it(bench):
    link = bench.trajectory()
    answers = [link.ask(point(k, (0.1 * k, -0.1 * k)))[1] for k in range(1, 199)]
    assert [answer[1] for answer in answers] == [1] * 197 + [2]
    header, body = link.ask(point(199, (0, 0)))
    assert (header[3], body[1]) == (2, 2)
    assert link.ask(trajectory(1))[1][1] == 2
    assert link.done(start())
    assert link.ask(trajectory(1))[1][1] == 1
    assert link.done(point(199, (0, 0)))
    assert not bench.controller.moving, "the rest of the trajectory is still to come"
    assert link.done(trajectory(3012)), "what was to move does not any more"
    assert link.done(trajectory(3002))
    assert link.done(point(1, (0, 0)))
    assert bench.controller.motions_started == 0


def test_points_that_cannot_be_run_are_refused_and_say_so(bench):
    link = bench.trajectory()
    assert link.done(point(1, (500.0, 0.0)))
    assert link.done(trajectory(3002))
    assert not link.done(start())
    status = bench.connected(Records(bench.status_port, "<4i 7i"))
    status.until(lambda record: record[4:] == (1, 0, 2, 1, 0, 2, 0))


@pytest.mark.parametrize("kind", [3011, 3012])
def test_a_stop_brings_the_arm_to_rest_on_its_path(bench, kind):
    feedback, link = bench.feedback(), bench.trajectory()
    assert not link.done(trajectory(kind)), "nothing moves"
    bench.store(LONG)
    assert link.done(start(1))
    feedback.until_moving()
    assert link.done(trajectory(kind))
    assert feedback.until_rest()[feedback.LAST_POINT] == 0
    reference = bench.recorded().reference_position
    np.testing.assert_allclose(reference[:, 1], -1.5 * reference[:, 0], atol=1e-6)
    assert bench.controller.ends == [EndReason.STOPPED]


@pytest.mark.parametrize(("kind", "goes_on"), [(3011, True), (3012, False)])
def test_a_stop_keeps_the_points_and_a_cancel_drops_them(serve, kind, goes_on):
    bench = serve(robot="comau_ns16")
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(program("  MOVE JOINT TO {0, 0, -90, 0, 20, 0}"))
    assert link.done(start(1))
    feedback.until_rest()
    assert link.done(point(1, (10, 0, -90, 0, 20, 0), speed=0.1))
    assert link.done(trajectory(3002))
    assert link.done(start())
    before = len(feedback.all)
    feedback.until(lambda record: record[feedback.MOVING], before)
    assert link.done(trajectory(kind))
    feedback.until_rest(before)
    assert not link.done(trajectory(3012)), "nothing moves"
    before = len(feedback.all)
    assert link.done(start()) is goes_on
    if goes_on:
        feedback.until_rest(before)
    assert bench.controller.motions_started == 2 + goes_on


def test_feedback_goes_on_while_the_arm_waits_for_its_next_moves(serve):
    bench = serve(clock="real", faults=[Fault("slow", "streaming", 0.1, 6.0)])
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(program("  MOVE JOINT TO {1, -1}"))
    assert link.done(start(1))
    feedback.until_rest()
    times = [record[feedback.TIME] for record in feedback.all if record[feedback.MOVING]]
    assert (np.diff(times) >= 0).all()
    assert (np.diff(times) == 0).any()


def test_feedback_that_nobody_answers_stops_the_arm(serve):
    bench = serve(watchdog=0.3)
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(LONG)
    assert link.done(start(1))
    feedback.until_moving()
    feedback.mute()
    assert bench.controller.wait(30)
    assert bench.controller.ends == [EndReason.WATCHDOG]


@pytest.mark.parametrize("which", ["trajectory", "feedback"])
def test_a_client_that_leaves_stops_the_arm(serve, which):
    bench = serve(watchdog=0.3)
    links = {"feedback": bench.feedback(), "trajectory": bench.trajectory()}
    bench.store(LONG)
    assert links["trajectory"].done(start(1))
    links["feedback"].until_moving()
    links[which].close()
    assert bench.controller.wait(30)
    assert bench.controller.ends == [EndReason.WATCHDOG]


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        struct.pack("<i", -1),
        struct.pack("<4i", 12, 1, 2, 0),
        struct.pack("<4i", 76, 13, 2, 0),
    ],
)
def test_what_makes_no_sense_ends_the_connection(bench, garbage):
    link = bench.trajectory()
    link.socket.sendall(garbage)
    with pytest.raises((EOFError, ConnectionResetError)):
        link.read()
    bench.trajectory_when_free()


def test_unknown_commands_and_answers_are_refused(bench):
    link = bench.trajectory()
    assert not link.done(trajectory(3999))
    assert not link.done(trajectory(1, comm=3))


def test_switching_off_the_programs_ends_the_connection(bench):
    link = bench.trajectory()
    assert link.done(trajectory(3020))
    with pytest.raises((EOFError, ConnectionResetError)):
        link.read()


def test_currents_of_a_stationary_arm_carry_gravity(bench, broker):
    """Before and after a motion: the currents of a stationary arm carry gravity."""
    samples = bench.connected(Samples(broker))
    samples.first("motor_currents")
    _, currents = samples.until("motor_currents", 0)
    np.testing.assert_allclose(currents[0] * [50, -32], bench.controller.torque, rtol=1e-12)
    assert np.abs(currents[0] * [50, -32]).max() > 10


def test_publishes_a_topic_in_real_time(serve, broker):
    bench = serve(clock="real")
    samples = bench.connected(Samples(broker))
    times, _ = samples.until("motor_currents", samples.first("motor_currents") + 200_000)
    np.testing.assert_allclose(np.diff(times), 2000, atol=1)


@pytest.mark.parametrize(("fault", "silent"), [("broker_gone", TOPICS), ("topic_missing", ["motor_currents"])])
def test_topics_that_fall_silent(serve, broker, fault, silent):
    bench = serve(faults=[Fault(fault, "connect")])
    bench.trajectory_when_free()
    samples = bench.connected(Samples(broker))
    feedback = bench.feedback()
    began = feedback.until(lambda record: True)[feedback.TIME]
    after = CLOCK_OFFSET + 1000 * (began + 2)  # the broker may still have what was published before
    for topic in set(TOPICS) - set(silent):
        samples.until(topic, after)
    feedback.until(lambda record: record[feedback.TIME] > began + 100)
    assert not any((samples.times(topic) > after).any() for topic in silent)


@pytest.mark.parametrize(("fault", "status"), [("queue_full", 2), ("sequence_error", 3)])
def test_a_stuck_queue_accepts_no_points(serve, fault, status):
    link = serve(faults=[Fault(fault, "upload")]).trajectory()
    header, body = link.ask(point(1, (20, -30)))
    assert (header[3], body[1]) == (2, status)


def test_a_restart_forgets_programs_and_clients(serve):
    bench = serve(faults=[Fault("restart", "start")])
    link = bench.trajectory()
    bench.store(SHORT)
    with pytest.raises((EOFError, ConnectionResetError)):
        link.ask(start(1))
    bench.trajectory_when_free()
    assert bench.ftp().nlst() == ["agent_identity.json"]


def test_counters_restart_at_zero(serve, broker):
    bench = serve(faults=[Fault("reset_counters", "streaming", 0.5)])
    samples = bench.connected(Samples(broker))
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    samples.first("motor_currents")
    feedback.until(lambda record: True)  # a client that has not been let in yet sees no reset
    assert link.done(start(1))
    feedback.until_rest()
    times = np.array([record[feedback.TIME] for record in feedback.all])
    assert (np.diff(times) < 0).sum() == 1
    stamps = samples.until_anew("motor_currents")
    assert (np.diff(stamps) < 0).sum() == 1


def test_without_a_broker_nothing_is_served(arm):
    nobody = ("127.0.0.1", free_port())
    with pytest.raises(NoBrokerError, match=f"no MQTT broker at 127.0.0.1:{nobody[1]}"):
        CnrServer(build_controller(arm, 3, "fast"), broker=nobody)
