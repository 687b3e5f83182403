"""A UR controller as small as the driver's tests allow, on real sockets, whose time runs ten times as fast.

It knows joint moves and loops of them. Frames are written by hand from the published layouts.
"""

import contextlib
import re
import socket
import struct
import threading
import time

import numpy as np

JOINTS = 6
TYPES = {"timestamp": "DOUBLE", "target_speed_fraction": "DOUBLE", "payload": "DOUBLE", "payload_cog": "VECTOR3D"}
TYPES |= {name: "INT32" for name in ("robot_mode", "safety_mode", "output_int_register_24", "output_int_register_25")}
TYPES |= {"runtime_state": "UINT32", "actual_current_as_torque": "VECTOR6D"}
FORMAT = {"DOUBLE": "d", "INT32": "i", "UINT32": "I", "VECTOR3D": "3d", "VECTOR6D": "6d"}


class UrPeer:
    """Attributes are the controller's state; tests change them."""

    host = "127.0.0.1"

    def __init__(self, faster=10.0):
        self.model, self.serial, self.version = "UR5", "20195500000", "5.12.6.1102099"
        self.remote, self.real, self.obeys = "true", False, True
        self.permits = True  # programs go on once they are allowed to
        self.greeting = b"Connected: Universal Robots Dashboard Server\n"
        self.missing, self.in_use = (), False
        self.refusal = None  # (line, column, text) of a runtime exception for the next program
        self.drop, self.every = 0, 1  # samples to leave out from now on; which of them are sent
        self.stamp = lambda now: now  # what is told of the time
        self.motions_started = 0
        self.scripts, self.secondary = [], []
        self.faster = faster
        self.state = {
            "timestamp": 100.0,
            "actual_q": np.array([0.1, -1.5, 1.5, -1.5, -1.5, 0.0]),
            "actual_qd": np.zeros(JOINTS),
            "target_q": np.array([0.1, -1.5, 1.5, -1.5, -1.5, 0.0]),
            "target_qd": np.zeros(JOINTS),
            "actual_current": np.full(JOINTS, 0.5),
            "joint_temperatures": np.full(JOINTS, 30.0),
            "robot_mode": 7,
            "safety_mode": 1,
            "runtime_state": 1,
            "target_speed_fraction": 1.0,
            "tcp_offset": np.zeros(JOINTS),
            "payload": 0.0,
            "payload_cog": np.zeros(3),
            "payload_inertia": np.array([0.01, 0.02, 0.03, 0.0, 0.0, 0.001]),
            "output_int_register_24": 0,
            "output_int_register_25": 0,
        }
        self.inputs = [0, 0]
        self.answers = threading.Event()  # the dashboard
        self.answers.set()
        self.owner = None
        self._beaten = 0.0
        self._program = None  # (name, number, moves left)
        self._move = None  # (from, to, seconds, begun at)
        self._clients, self._primaries = [], []
        self._lock = threading.RLock()
        self._over = threading.Event()
        self._listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
        for listener, serve in zip(self._listeners, (self._dashboard, self._primary, self._rtde), strict=True):
            threading.Thread(target=self._accept, args=(listener, serve), daemon=True).start()
        threading.Thread(target=self._tick, daemon=True).start()

    @property
    def ports(self):
        return [listener.getsockname()[1] for listener in self._listeners]

    @property
    def moving(self):
        return self._move is not None

    def hang_up(self):
        """The primary interface closes."""
        for client in self._primaries:
            client.shutdown(socket.SHUT_RDWR)

    def close(self):
        self._over.set()
        self.answers.set()
        for listener in self._listeners:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()

    def _accept(self, listener, serve):
        with contextlib.suppress(OSError):
            while True:
                client, _ = listener.accept()
                threading.Thread(target=self._guarded, args=(serve, client), daemon=True).start()

    def _guarded(self, serve, client):
        with client, contextlib.suppress(OSError):
            serve(client)
        with self._lock:
            self.owner = None if self.owner is client else self.owner
            self._clients = [one for one in self._clients if one[0] is not client]
            self._primaries = [one for one in self._primaries if one is not client]

    def _dashboard(self, client):
        client.sendall(self.greeting)
        rest = b""
        while data := client.recv(4096):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self.answers.wait()
                client.sendall(self._answer(line.decode()).encode() + b"\n")

    def _answer(self, command):
        if command == "stop" and self.obeys:
            self.end()
        return {
            "PolyscopeVersion": f"URSoftware {self.version} (Nov 18 2021)",
            "get serial number": self.serial,
            "get robot model": self.model,
            "is in remote control": self.remote,
            "stop": "Stopped" if self.obeys else "Failed to execute: stop",
        }[command]

    def _primary(self, client):
        with self._lock:
            self._primaries.append(client)
        self._say(16, struct.pack(">iBQ?", 4 + 1 + 9, 0, 0, self.real))
        text, stop = b"", b"stop program\n"
        while data := client.recv(65536):
            text += data
            while text.startswith(stop):  # what is sent next may come with it
                self._answer("stop")
                text = text.removeprefix(stop)
            if b"\nend\n" in text:
                script, text = text.decode(), b""
                if script.startswith("sec "):
                    self.secondary.append(script)
                else:
                    self._run(script)

    def _say(self, kind, content):
        for client in self._primaries:
            with contextlib.suppress(OSError):
                client.sendall(struct.pack(">iB", 5 + len(content), kind) + content)

    def _key(self, title, text):
        head = struct.pack(">QbBiiB", 0, 0, 7, 0, 0, len(title))
        self._say(20, head + title.encode() + text.encode())

    def _run(self, text):
        with self._lock:
            self.scripts.append(text)
            if self.refusal is not None:
                line, column, message = self.refusal
                self._say(20, struct.pack(">QbBII", 0, 0, 10, line, column) + message.encode())
                return
            name = re.search(r"def (\w+)", text)[1]
            number = int(re.search(r"register\(25, (\d+)\)", text)[1])
            times = re.search(r"while i < (\d+)", text)
            goals = [np.fromstring(one, sep=",") for one in re.findall(r"movej\(\[([^\]]*)\]", text)]
            self._let_go = self._counted = False
            self._program = [name, number, goals * (int(times[1]) if times else 1)]
            self._beaten = self.state["timestamp"]
            self.state |= {"runtime_state": 2, "output_int_register_25": number}
            self._key("PROGRAM_XXX_STARTED", name)

    def end(self, state=1):
        """The program is over, or paused (4)."""
        with self._lock:
            if self._program is not None:
                self._key("PROGRAM_XXX_STOPPED", self._program[0])
            self._program = self._move = None
            self.state |= {"runtime_state": state, "target_qd": np.zeros(JOINTS), "actual_qd": np.zeros(JOINTS)}

    def _rtde(self, client):
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        names, rest = [], b""

        def answer(kind, content):
            with self._lock:
                client.sendall(struct.pack(">HB", 3 + len(content), kind) + content)

        while data := client.recv(65536):
            rest += data
            while len(rest) >= 3:
                size, kind = struct.unpack_from(">HB", rest)
                if len(rest) < size:
                    break
                content, rest = rest[3:size], rest[size:]
                if kind == ord("V"):
                    answer(kind, b"\1")
                elif kind == ord("O"):
                    names = content[8:].decode().split(",")
                    kinds = ["NOT_FOUND" if n in self.missing else TYPES.get(n, "VECTOR6D") for n in names]
                    answer(kind, b"\1" + ",".join(kinds).encode())
                elif kind == ord("I"):
                    free = self.owner is None and not self.in_use
                    self.owner = client if free else self.owner
                    answer(kind, b"\1" + b",".join([b"INT32" if free else b"IN_USE"] * 2))
                elif kind == ord("S"):
                    with self._lock:
                        self._clients.append((client, names))
                    answer(kind, b"\1")
                elif kind == ord("U"):
                    self.inputs = struct.unpack(">B2i", content)[1:]
                    self._beaten = self.state["timestamp"]

    def _tick(self):
        told = time.monotonic()
        while not self._over.wait(0.004):
            cycles = min(int((time.monotonic() - told) * self.faster / 0.002), 100)
            told += cycles * 0.002 / self.faster
            with self._lock:
                data = {id(names): b"" for _, names in self._clients}
                for number in range(cycles):
                    self._cycle()
                    if number % self.every:
                        continue
                    if self.drop > 0:
                        self.drop -= 1
                        continue
                    for _, names in self._clients:
                        data[id(names)] += self._sample(names)
                for client, names in list(self._clients):
                    with contextlib.suppress(OSError):
                        client.sendall(data[id(names)])
            told = max(told, time.monotonic() - 0.1)

    def _sample(self, names):
        content = b"\1"
        for name in names:
            value = self.stamp(self.state[name]) if name == "timestamp" else self.state[name]
            values = value if isinstance(value, np.ndarray) else (value,)
            content += struct.pack(">" + FORMAT[TYPES.get(name, "VECTOR6D")], *values)
        return struct.pack(">HB", 3 + len(content), ord("U")) + content

    def _cycle(self):
        state = self.state
        state["timestamp"] = now = round(state["timestamp"] + 0.002, 6)
        if self._program is None or state["runtime_state"] != 2:
            return
        if now - self._beaten > 0.5 * self.faster:
            self.end()
            return
        _, number, goals = self._program
        if self.inputs[1] == number and self.permits:
            self._let_go, state["output_int_register_25"] = True, 0
        if self._move is None:
            if not self._let_go:
                return
            if not goals:
                self.end()
                return
            self.motions_started += not self._counted
            self._counted = True
            there = state["target_q"].copy()
            goal = goals.pop(0)
            self._move = there, goal, max(1.5 * np.abs(goal - there).max() / 0.5, 0.01), now
        begin, goal, seconds, begun = self._move
        part = min((now - begun) / seconds, 1.0)
        state["target_q"] = begin + (goal - begin) * part * part * (3.0 - 2.0 * part)
        state["target_qd"] = (goal - begin) * 6.0 * part * (1.0 - part) / seconds
        state["actual_q"], state["actual_qd"] = state["target_q"] + 1e-4, state["target_qd"]
        state["actual_current"] = 0.5 + state["target_qd"]
        if part >= 1.0:
            self._move = None
