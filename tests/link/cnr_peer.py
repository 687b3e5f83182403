"""A client of the fake's link of socket programs, FTP folder and MQTT topics, by the byte, and the fake for it."""

import ftplib
import io
import json
import socket
import struct
import threading
from contextlib import closing, suppress

import numpy as np
from paho.mqtt.client import CallbackAPIVersion, Client

from fake_controller.build import build_controller
from fake_controller.execution import Slice
from fake_controller.servers.cnr.server import CnrServer
from tests.conftest import patience

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
        """The first wanted record after a number of records."""
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
        """The first record after a motion, counted after a number of records."""
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
        rows = self._rows(topic)
        return np.array([row["time"] for row in rows]), np.array([[row["J1"], row["J2"]] for row in rows])

    def until_anew(self, topic):
        """Times of a topic's messages after their restart: the broker may be behind the controller."""
        while True:
            times = self.times(topic)
            if (np.diff(times) < 0).any():
                return times
            threading.Event().wait(0.02)

    def times(self, topic):
        """Of all messages of a topic."""
        return np.array([row["time"] for row in self._rows(topic)])

    def _rows(self, topic):
        return [json.loads(payload[:-1]) for payload in self.messages[topic]]


class Bench:
    """A server and its clients."""

    def __init__(self, robot, broker, undo, clock="fast", faults=(), watchdog=2.0):
        self.undo = undo
        self.controller = build_controller(robot, seed=3, clock=clock, faults=faults)
        self.server = CnrServer(
            self.controller, watchdog=patience(watchdog), broker=broker.address, waits=clock == "fast"
        )
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
