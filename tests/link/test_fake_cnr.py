"""The fake's link of socket programs, FTP folder and MQTT topics, met with bytes written by hand from the layouts."""

import ftplib
import io
import json
import socket
import struct
import threading
from contextlib import ExitStack, closing, suppress

import numpy as np
import pytest
from paho.mqtt.client import CallbackAPIVersion, Client

from drivers.wire.reasons import EndReason
from fake_controller.build import build_controller
from fake_controller.execution import Slice
from fake_controller.faults import Fault
from fake_controller.server_cnr import CnrServer
from fake_controller.servers import NoBrokerError
from tests.conftest import free_port

CLOCK_OFFSET = 1_234_567_890  # µs of the topics' clock before the controller's
TOPICS = (
    "real_joints_positions",
    "real_joints_velocities",
    "target_joints_positions",
    "target_joints_velocities",
    "motor_currents",
)
KEYS = [*(f"J{k}" for k in range(1, 11)), "time"]


def program(body):
    """PDL2 text around statements, for an arm of two joints."""
    return f"PROGRAM p HOLD, PROG_ARM=1\nVAR\n  k : INTEGER\nBEGIN\n{body}\nEND p\n"


SHORT = program("  MOVE JOINT TO {20, -30}")
LONG = program("  FOR k := 1 TO 500 DO\n    MOVE JOINT TO {20, -30}\n    MOVE JOINT TO {-20, 30}\n  ENDFOR")


def trajectory(kind, *fields, comm=2):
    """80 bytes for the trajectory port: arm, queue status, sequence number, tolerance, speed, ten joints, outputs."""
    values = [*fields, *[0] * (16 - len(fields))]
    return struct.pack("<4i 3i 2f 10f i", 76, kind, comm, 0, *values)


def point(number, joints, tolerance=5.0, speed=0.3):
    return trajectory(3001, 1, 0, number, tolerance, speed, *joints, *[0.0] * (10 - len(joints)), 0)


def start(number=0):
    return trajectory(3010, 1, 0, number)


class Socket:
    """One connection, read in whole messages."""

    def __init__(self, port):
        self.socket = socket.create_connection(("127.0.0.1", port), 20)
        self._lock = threading.Lock()

    def close(self):
        with suppress(OSError):
            self.socket.shutdown(socket.SHUT_RDWR)
        self.socket.close()

    def read(self, size=None):
        """`size` bytes; without it a message, its length first. Raises EOFError at the end of the connection."""
        if size is None:
            length = self.read(4)
            return length + self.read(struct.unpack("<i", length)[0])
        data = b""
        while len(data) < size:
            more = self.socket.recv(size - len(data))
            if not more:
                raise EOFError
            data += more
        return data

    def ask(self, request):
        """Header and body of the answer to a request at the trajectory port."""
        self.socket.sendall(request)
        answer = self.read()
        return struct.unpack("<4i", answer[:16]), struct.unpack("<3i 2f 10f i", answer[16:])

    def done(self, request):
        """Whether the answer says success."""
        return self.ask(request)[0][3] == 1


class Records:
    """Answers every record of a lock-step port, and keeps them, until it is closed or muted."""

    def __init__(self, port, layout):
        self.link = Socket(port)
        self.all = []
        self._layout = layout
        self._changed = threading.Condition()
        self._muted = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self):
        self.link.close()
        self._thread.join(20)

    def mute(self):
        self._muted = True

    def until(self, wanted, after=0):
        """The first record that is wanted, among those that come after so many."""
        with self._changed:
            found = []
            assert self._changed.wait_for(lambda: found.extend(filter(wanted, self.all[after:])) or found, 30)
            return found[0]

    def _run(self):
        with suppress(EOFError, OSError):
            while True:
                record = self.link.read()
                with self._changed:
                    self.all.append(struct.unpack(self._layout, record))
                    self._changed.notify_all()
                if not self._muted:
                    self.link.socket.sendall(record[:8] + struct.pack("<2i", 3, 1) + record[16:])


class Feedback(Records):
    """length, type, comm, reply, arm, 18 of frames, 10 joints, 10 currents, 6 Cartesian, last point, time, moving."""

    LAST_POINT, TIME, MOVING = -3, -2, -1

    def __init__(self, port):
        super().__init__(port, "<4i i 44f 3i")

    def until_moving(self):
        return self.until(lambda record: record[self.MOVING])

    def until_rest(self, after=0):
        """The first record after a motion, of those that come after so many."""
        moved = self.all.index(self.until(lambda record: record[self.MOVING], after), after)
        return self.until(lambda record: not record[self.MOVING], moved)


class Samples:
    """Everything that the topics carry."""

    def __init__(self, broker):
        self.messages = {topic: [] for topic in TOPICS}
        ready = threading.Event()
        self._client = Client(CallbackAPIVersion.VERSION2)
        self._client.on_connect = lambda client, *_: client.subscribe("robot/arm1/#")
        self._client.on_subscribe = lambda *_: ready.set()
        self._client.on_message = lambda *call: self.messages[call[2].topic.split("/")[2]].append(call[2].payload)
        self._client.connect(*broker.address)
        self._client.loop_start()
        assert ready.wait(20)

    def close(self):
        self._client.disconnect()
        self._client.loop_stop()

    def first(self, topic):
        """Time of a topic's first message."""
        self.until(topic, 0)
        return json.loads(self.messages[topic][0][:-1])["time"]

    def until(self, topic, time):
        """Times and first two values of a topic's messages, once `time` has come."""
        while not self.messages[topic] or json.loads(self.messages[topic][-1][:-1])["time"] < time:
            threading.Event().wait(0.01)
        rows = [json.loads(payload[:-1]) for payload in self.messages[topic]]
        return np.array([row["time"] for row in rows]), np.array([[row["J1"], row["J2"]] for row in rows])


class Bench:
    """A server and whoever talks to it."""

    def __init__(self, robot, broker, undo, clock="fast", faults=(), watchdog=2.0):
        self.undo = undo
        self.controller = build_controller(robot, seed=3, clock=clock, faults=faults)
        self.server = CnrServer(self.controller, watchdog=watchdog, broker=broker.address, waits=clock == "fast")
        undo.callback(self.server.close)
        self.trajectory_port, self.feedback_port, self.status_port, self.ftp_port = self.server.ports

    def connected(self, thing):
        return self.undo.enter_context(closing(thing))

    def trajectory(self):
        return self.connected(Socket(self.trajectory_port))

    def feedback(self):
        return self.connected(Feedback(self.feedback_port))

    def ftp(self):
        ftp = ftplib.FTP(timeout=20)
        ftp.connect("127.0.0.1", self.ftp_port)
        self.undo.callback(ftp.close)
        ftp.login()
        return ftp

    def store(self, text, name="p"):
        """Upload a program and choose it."""
        ftp = self.ftp()
        ftp.storbinary(f"STOR {name}.pdl", io.BytesIO(text.encode()))
        ftp.storbinary("STOR agent_program.txt", io.BytesIO(f"{name}\n".encode()))
        ftp.quit()

    def recorded(self):
        """All samples of the last motion, as the controller has them."""
        parts = []
        while (first := sum(map(len, parts))) < self.controller.recorded:
            parts.append(self.controller.fetch(first, 100_000)[2])
        return Slice(*(np.concatenate([getattr(part, name) for part in parts]) for name in Slice.__annotations__))

    def trajectory_when_free(self):
        """A connection whose first ping is answered, once the client before has gone."""
        while True:
            link = self.trajectory()
            with suppress(EOFError, OSError):
                assert link.done(trajectory(1))
                return link


@pytest.fixture
def serve(arm, broker):
    with ExitStack() as undo:
        yield lambda robot=arm, **options: Bench(robot, broker, undo, **options)


@pytest.fixture
def bench(serve):
    return serve()


def fetched(ftp, name):
    data = io.BytesIO()
    ftp.retrbinary(f"RETR {name}", data.write)
    return data.getvalue()


def test_a_ping_by_the_byte(bench):
    link = bench.trajectory()
    link.socket.sendall(bytes.fromhex("4c000000 01000000 02000000 00000000") + bytes(64))
    assert link.read() == bytes.fromhex("4c000000 01000000 03000000 01000000 01000000 01000000 00000000") + bytes(52)


def test_the_status_by_the_byte(bench):
    link = bench.connected(Socket(bench.status_port))
    expected = bytes.fromhex(
        "28000000 0d000000 02000000 0000000001000000 00000000 00000000 00000000 00000000 02000000 01000000"
    )
    assert link.read() == expected


def test_a_record_comes_once_the_last_is_answered(bench):
    link = bench.connected(Socket(bench.feedback_port))
    first = link.read()
    assert first[:20] == bytes.fromhex("cc000000 bc0b0000 02000000 00000000 01000000")
    link.socket.settimeout(0.1)
    with pytest.raises(TimeoutError):
        link.read()
    link.socket.settimeout(20)
    link.socket.sendall(first[:8] + bytes.fromhex("03000000 01000000") + first[16:])
    assert struct.unpack_from("<i", link.read(), 200) > struct.unpack_from("<i", first, 200)


@pytest.mark.parametrize(
    ("changes", "fields"),
    [
        ({"drives_on": False}, (0, 0, 0, 0, 0, 2, 0)),
        ({"emergency_stop": True, "drives_on": False}, (0, 1, 0, 0, 0, 2, 0)),
        ({"alarms": ("62513 motor 3 too hot",)}, (1, 0, 62513, 1, 0, 2, 0)),
        ({"alarms": ("drive fault on axis 2",)}, (1, 0, 1, 1, 0, 2, 0)),
        ({"mode": "teach"}, (1, 0, 0, 0, 0, 1, 0)),
        ({"cell_closed": False}, (1, 0, 0, 0, 0, 2, 0)),
    ],
)
def test_a_state_that_forbids_motion_shows_and_does(bench, changes, fields):
    for name, value in changes.items():
        setattr(bench.controller.state, name, value)
    bench.store(SHORT)
    assert not bench.trajectory().done(start(1))
    status = bench.connected(Records(bench.status_port, "<4i 7i"))
    status.until(lambda record: record[4:] == fields)
    assert bench.controller.motions_started == 0


def test_the_folder_says_whose_controller_it_is(bench):
    identity = json.loads(fetched(bench.ftp(), "agent_identity.json"))
    assert (identity["robot"], identity["serial"], identity["period"]) == ("small_arm", "FAKE-0003", 0.002)
    assert (identity["joint_names"], identity["emulator"]) == (["shoulder", "elbow"], True)


def test_a_stored_program_runs_to_its_end_and_every_sample_is_published(bench, broker):
    samples = bench.connected(Samples(broker))
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(4711))
    end = feedback.until_rest()
    assert end[feedback.LAST_POINT] == 4711
    np.testing.assert_allclose(end[23:25], [20, -30], atol=0.2)
    assert bench.controller.ends == [EndReason.DONE]

    until = 1000 * end[feedback.TIME] + CLOCK_OFFSET
    times, targets = samples.until("target_joints_positions", until)
    np.testing.assert_allclose(np.diff(times), 2000, atol=1)
    recorded = bench.recorded()
    begin = int(np.argmax((targets != targets[0]).any(axis=1)))
    moving = slice(begin, begin + len(recorded))
    stamps = times[moving]
    for topic, values, late in (
        ("target_joints_positions", np.degrees(recorded.reference_position), 0),
        ("target_joints_velocities", np.degrees(recorded.reference_velocity), 0),
        ("real_joints_positions", np.degrees(recorded.position), 0),
        ("real_joints_velocities", np.degrees(recorded.velocity), 0),
        ("motor_currents", recorded.torque / [50, -32], 200),  # gear ratio times torque constant
    ):
        times, published = samples.until(topic, until)
        np.testing.assert_array_equal(times[np.isin(times, stamps + late)], stamps + late)
        np.testing.assert_allclose(published[np.isin(times, stamps + late)], values, rtol=1e-12)
    payload = samples.messages["motor_currents"][0]
    assert payload.endswith(b"}\0")
    assert list(json.loads(payload[:-1])) == KEYS


def test_both_clocks_show_the_same_motion(bench, broker):
    samples = bench.connected(Samples(broker))
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(1))
    end = feedback.until_rest()
    times, positions = samples.until("real_joints_positions", 1000 * end[feedback.TIME] + CLOCK_OFFSET)
    told = [
        record for record in feedback.all if record[feedback.MOVING] and record[feedback.TIME] <= end[feedback.TIME]
    ]
    assert len(told) > 10
    for record in told:
        k = np.argmin(np.abs(times - CLOCK_OFFSET - 1000 * record[feedback.TIME]))
        np.testing.assert_allclose(record[23:25], positions[k], atol=1e-5)


def test_the_same_start_acts_once(bench):
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(7))
    feedback.until_rest()
    assert not link.done(start(7))
    assert bench.controller.motions_started == 1


def test_nothing_starts_that_nobody_chose(bench):
    link = bench.trajectory()
    bench.ftp().storbinary("STOR p.pdl", io.BytesIO(SHORT.encode()))
    assert not link.done(start(1))
    bench.ftp().storbinary("STOR agent_program.txt", io.BytesIO(b"q\n"))
    assert not link.done(start(2))
    assert bench.controller.motions_started == 0


def test_a_program_that_is_none_leaves_line_column_and_reason(bench):
    ftp = bench.ftp()
    ftp.storbinary("STOR p.pdl", io.BytesIO(program("  FLIP TO {20, -30}").encode()))
    line, column, reason = fetched(ftp, "p.err").decode().split(maxsplit=2)
    assert (line, int(column) > 0) == ("5", True)
    assert "FLIP" in reason
    ftp.delete("p.pdl")
    assert ftp.nlst() == ["agent_identity.json"]


def test_what_is_stored_can_be_read_back(bench):
    ftp = bench.ftp()
    text = (SHORT + "-- äöü\n").encode()
    ftp.storbinary("STOR p.pdl", io.BytesIO(text))
    assert fetched(ftp, "p.pdl") == text
    with pytest.raises(ftplib.error_perm, match="550"):
        fetched(ftp, "p.err")


@pytest.mark.parametrize(
    ("name", "size", "code"),
    [
        ("agent_identity.json", 10, "553"),
        ("p.txt", 10, "553"),
        ("../p.pdl", 2_000_000, "552"),  # there is nothing above: it is p.pdl
        ("folder/p.pdl", 10, "553"),
        ("1p.pdl", 10, "553"),
        ("p.pdl", 2_000_000, "552"),
    ],
)
def test_what_the_folder_does_not_take(bench, name, size, code):
    ftp = bench.ftp()
    with pytest.raises((ftplib.error_perm, OSError), match=f"{code}|reset|pipe"):
        ftp.storbinary(f"STOR {name}", io.BytesIO(b"x" * size))
    assert bench.ftp().nlst() == ["agent_identity.json"]


def test_nothing_outside_the_folder_can_be_read(bench):
    for name in ("/etc/passwd", "../../../../etc/passwd"):
        with pytest.raises(ftplib.error_perm, match="550"):
            fetched(bench.ftp(), name)


def test_full_memory(serve):
    bench = serve(faults=[Fault("full_memory", "upload")])
    with pytest.raises(ftplib.error_perm, match="552 the program memory is full"):
        bench.store(SHORT)


def test_no_program_is_stored_while_the_arm_moves(bench):
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(LONG)
    assert link.done(start(1))
    with pytest.raises(ftplib.error_temp, match="450"):
        bench.store(SHORT, "q")
    assert not link.done(start(2))
    assert link.done(trajectory(3012))
    feedback.until_rest()


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
def test_a_stop_holds_the_points_and_a_cancel_drops_them(serve, kind, goes_on):
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
def test_a_client_that_leaves_stops_the_arm(bench, which):
    links = {"feedback": bench.feedback(), "trajectory": bench.trajectory()}
    bench.store(LONG)
    assert links["trajectory"].done(start(1))
    links["feedback"].until_moving()
    links[which].close()
    assert bench.controller.wait(30)
    assert bench.controller.ends == [EndReason.WATCHDOG]


def test_one_client_at_a_time(bench):
    first = bench.trajectory()
    assert first.done(trajectory(1))
    with pytest.raises((EOFError, ConnectionResetError, BrokenPipeError)):
        bench.trajectory().ask(trajectory(1))
    first.close()
    bench.trajectory_when_free()


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


def test_an_arm_that_rests_is_held(bench, broker):
    """Before anything has moved as afterwards: currents at rest carry gravity."""
    samples = bench.connected(Samples(broker))
    samples.first("motor_currents")
    _, currents = samples.until("motor_currents", 0)
    np.testing.assert_allclose(currents[0] * [50, -32], bench.controller.torque, rtol=1e-12)
    assert np.abs(currents[0] * [50, -32]).max() > 10


def test_a_topic_in_real_time(serve, broker):
    bench = serve(clock="real")
    samples = bench.connected(Samples(broker))
    times, _ = samples.until("motor_currents", samples.first("motor_currents") + 200_000)
    np.testing.assert_allclose(np.diff(times), 2000, atol=1)


@pytest.mark.parametrize(("fault", "silent"), [("broker_gone", TOPICS), ("topic_missing", ["motor_currents"])])
def test_topics_that_fall_silent(serve, broker, fault, silent):
    bench = serve(faults=[Fault(fault, "connect")])
    bench.trajectory_when_free()
    samples = bench.connected(Samples(broker))
    for topic in set(TOPICS) - set(silent):
        samples.first(topic)
    feedback = bench.feedback()
    feedback.until(lambda record: record[feedback.TIME] > feedback.all[0][feedback.TIME] + 100)
    assert not any(samples.messages[topic] for topic in silent)


@pytest.mark.parametrize(("fault", "status"), [("queue_full", 2), ("sequence_error", 3)])
def test_a_queue_that_takes_nothing(serve, fault, status):
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


def test_counters_that_begin_anew(serve, broker):
    bench = serve(faults=[Fault("reset_counters", "streaming", 0.5)])
    samples = bench.connected(Samples(broker))
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(1))
    feedback.until_rest()
    times = np.array([record[feedback.TIME] for record in feedback.all])
    assert (np.diff(times) < 0).sum() == 1
    stamps, _ = samples.until("motor_currents", CLOCK_OFFSET)
    assert (np.diff(stamps) < 0).sum() == 1


def test_without_a_broker_nothing_is_served(arm):
    nobody = ("127.0.0.1", free_port())
    with pytest.raises(NoBrokerError, match=f"no MQTT broker at 127.0.0.1:{nobody[1]}"):
        CnrServer(build_controller(arm, 3, "fast"), broker=nobody)
