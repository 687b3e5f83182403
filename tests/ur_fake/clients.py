"""Clients of an emulated UR, written after the published layout and nothing else."""

import socket
import struct
import time
from contextlib import contextmanager

import numpy as np

PATIENCE = 20.0  # s
FORMATS = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i",
}  # fmt: skip


class Wire:
    """Bytes over TCP."""

    def __init__(self, address, port):
        self.socket = socket.socket()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)  # never far behind
        self.socket.settimeout(PATIENCE)
        self.socket.connect((address, port))
        self._rest = b""

    def send(self, data):
        self.socket.sendall(data)

    def take(self, count):
        while len(self._rest) < count:
            data = self.socket.recv(1 << 16)
            if not data:
                raise EOFError
            self._rest += data
        taken, self._rest = self._rest[:count], self._rest[count:]
        return taken

    def close(self):
        self.socket.close()


class Rtde(Wire):
    def __init__(self, address, *names, frequency=0.0):
        super().__init__(address, 30004)
        if names:
            self.ask("V", struct.pack(">H", 2))
            answer = self.ask("O", struct.pack(">d", frequency) + ",".join(names).encode())
            types = answer[1:].decode().split(",")
            self.names = names
            self._format = ">B" + "".join(FORMATS[kind] for kind in types)
            self._widths = [int(FORMATS[kind][:-1] or 1) for kind in types]
            assert self.ask("S") == b"\1"

    def package(self, kind, payload=b""):
        self.send(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def receive(self):
        size, kind = struct.unpack(">HB", self.take(3))
        return chr(kind), self.take(size - 3)

    def ask(self, kind, payload=b""):
        """The answer to a package; data may come before it."""
        self.package(kind, payload)
        while True:
            answered, content = self.receive()
            if answered == kind:
                return content
            assert answered == "U", (answered, content)

    def sample(self):
        """The next sample by name."""
        kind, payload = self.receive()
        assert kind == "U", (kind, payload)
        values = list(struct.unpack(self._format, payload)[1:])
        sample = {}
        for name, width in zip(self.names, self._widths, strict=True):
            part, values = values[:width], values[width:]
            sample[name] = part[0] if width == 1 else np.array(part)
        return sample

    def until(self, met):
        """Samples up to the first for which `met` holds."""
        samples = [self.sample()]
        while not met(samples[-1]):
            samples.append(self.sample())
        return samples

    def run(self):
        """Samples of the program that is about to start, to its end."""
        self.until(lambda sample: sample["runtime_state"] == 2)
        return self.until(lambda sample: sample["runtime_state"] not in (0, 2))


class Primary(Wire):
    def __init__(self, address, port=30001):
        super().__init__(address, port)
        self.version = self.message()

    def receive(self):
        size, kind = struct.unpack(">iB", self.take(5))
        return kind, self.take(size - 5)

    def message(self):
        """The next message that is no state: its type and content. States come for ever, so they are no sign of it."""
        until = time.monotonic() + 3 * PATIENCE
        while time.monotonic() < until:
            kind, data = self.receive()
            if kind == 20:
                assert data[8:9] == b"\xfe"
                return data[9], data[10:]
        raise TimeoutError("no message came")

    def state(self):
        """The sub-packages of the next state by type."""
        while True:
            kind, data = self.receive()
            if kind != 16:
                continue
            parts = {}
            while data:
                size, part = struct.unpack_from(">iB", data)
                parts[part], data = data[5:size], data[size:]
            return parts

    def until_closed(self):
        """Raises EOFError once the other end closes."""
        while True:
            self.receive()

    def ended(self):
        """Everything said up to the end of the program that is about to run."""
        said = []
        while not said or b"PROGRAM_XXX_STOPPED" not in said[-1][1]:
            said.append(self.message())
        return said


class Dashboard(Wire):
    def __init__(self, address):
        super().__init__(address, 29999)
        self.greeting = self.line()

    def line(self):
        text = b""
        while not text.endswith(b"\n"):
            text += self.take(1)
        return text.decode().rstrip("\n")

    def ask(self, command):
        self.send(command.encode() + b"\n")
        return self.line()


@contextmanager
def clients(*opened):
    try:
        yield opened if len(opened) > 1 else opened[0]
    finally:
        for client in opened:
            client.close()


def three(ur, *fields):
    """A client of the primary, of the dashboard, and of these fields of RTDE."""
    return clients(Primary(ur.address), Dashboard(ur.address), Rtde(ur.address, *fields))


def program(*lines, name="job"):
    """A script with this body."""
    return f"def {name}():\n" + "".join(f"  {line}\n" for line in lines) + "end\n"


def turn(ur, speed):
    """A move of the first joint by 1 rad [rad/s]."""
    return f"movej({(ur.cell.reference + [1.0, 0, 0, 0, 0, 0]).tolist()}, a=1, v={speed})"


def texts(said):
    """What textmsg said, of messages."""
    return [content.decode() for kind, content in said if kind == 0]


def errors(said):
    """Line, column and text of the exceptions among messages."""
    return [(*struct.unpack_from(">II", content), content[8:].decode()) for kind, content in said if kind == 10]


def warnings(said):
    """Codes and texts of the errors among messages."""
    return [(struct.unpack_from(">i", content)[0], content[20:].decode()) for kind, content in said if kind == 6]
