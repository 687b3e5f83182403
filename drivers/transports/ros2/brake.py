"""A process of its own that brakes the arm when the agent is gone, however it went.

The agent holds its standard input. Each line is an order: `arm STRENGTH…` (deceleration of each joint [rad/s²]),
`disarm`, or a blank one as a sign of life. Where the input ends or is silent while armed, the arm is braked by one
point, and whatever runs is cancelled once it rests. Run as `python -m drivers.transports.ros2.brake`.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, TextIO

import numpy as np

from drivers.errors import DriverError, ProtocolError
from drivers.transports.ros2.following import CANCEL_AFTER, Believed
from drivers.wire.ros2 import JOINT_STATES, JointStateReader, RosAddress

#: Silence [s] of an agent that is armed after which it is taken for gone: a busy computer keeps a process waiting for
#: half a second.
SILENCE = 1.0
_TURN = 0.02  # s
_OLD = 0.3  # s: a sample that still says where the arm is
_READY = "ready"
_PAGE = 4096  # bytes, the least that a pipe holds
#: A sign of life: at one each 8 ms the pipe of a process that takes none is full after 1.6 s.
_ALIVE = " " * 19


class BrakeProcess:
    """The agent's end of it.

    Args:
        address: of the controller, as the recipe has it.
        joints: of the arm, in their order.
    """

    def __init__(self, address: str, joints: Sequence[str], name: str) -> None:
        self._lock = threading.Lock()
        self._armed = self._deaf = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "drivers.transports.ros2.brake", address, name, *joints],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C at the terminal is for the agent alone
            bufsize=0,
        )
        orders, words = self._process.stdin, self._process.stdout
        assert orders is not None
        assert words is not None
        self._orders, self._words = orders, words
        os.set_blocking(orders.fileno(), False)  # one that is stopped must not stop the guard
        fcntl.fcntl(orders.fileno(), fcntl.F_SETPIPE_SZ, _PAGE)  # and is noticed once that is full
        self._ready = False

    def wait_ready(self, timeout: float) -> None:
        """Wait until it would brake.

        Raises:
            DriverError: it has ended, or does not see the arm in time.
        """
        until = time.monotonic() + timeout
        while not self._ready:
            readable, _, _ = select.select([self._words], [], [], max(0.0, until - time.monotonic()))
            line = self._words.readline().decode().strip() if readable else ""
            if line != _READY:
                late, ended = f"did not see the arm within {timeout:g} s", f"has ended: {line or 'no word'}"
                raise DriverError(
                    f"the second process, which brakes the arm when the agent is gone, {ended if readable else late}; "
                    "nothing moved. Run the command again"
                )
            self._ready = True

    @property
    def alive(self) -> bool:
        """Whether it would brake: it runs, and has taken what was said to it."""
        return self._ready and not self._deaf and self._process.poll() is None

    def arm(self, strength: np.ndarray) -> None:
        """From now on it brakes where nothing is heard."""
        self._say("arm " + " ".join(f"{value:.6g}" for value in strength))
        self._armed = True

    def disarm(self) -> None:
        """The arm rests: from now on it does nothing."""
        self._armed = False
        self._say("disarm")

    def beat(self) -> None:
        """A sign of life; never waits."""
        if self._armed:
            self._say(_ALIVE)

    def close(self) -> None:
        """End it without braking; never raises."""
        with contextlib.suppress(OSError):
            self._say("disarm")
        for stream in (self._orders, self._words):
            with contextlib.suppress(OSError):
                stream.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(2.0)
            return
        self._process.kill()
        self._process.wait()

    def _say(self, line: str) -> None:
        with self._lock, contextlib.suppress(OSError, ValueError):  # one that has ended is seen by `alive`
            if self._orders.write(line.encode() + b"\n") is None:
                self._deaf = True


class Orders:
    """What has come from the agent."""

    def __init__(self, now: float) -> None:
        self.strength: np.ndarray | None = None  # while armed
        self.heard, self.ended = now, False
        self._buffer = b""

    def take(self, data: bytes, now: float) -> None:
        """Bytes of its lines; none where its end is closed."""
        self.heard, self.ended = now, not data
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            word, *values = line.split()[:65] or [b""]
            if word == b"arm":
                self.strength = np.array([float(value) for value in values])
            elif word == b"disarm":
                self.strength = None

    def gone(self, now: float) -> bool:
        """Whether the arm has to be braked."""
        return self.strength is not None and (self.ended or now - self.heard > SILENCE)


def main(arguments: Sequence[str], agent: TextIO) -> int:
    """Watch over the agent, which reads `agent`; returns the exit code."""
    address, name, *joints = arguments
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it ends when the agent does
    from drivers.transports.ros2.ros import Ros, send_brake

    target = RosAddress.of(address)
    ros = Ros(target.domain, name)
    publisher = ros.commands(target)
    reader, believed = JointStateReader(joints), Believed()

    def take(data: bytes) -> None:
        with contextlib.suppress(ProtocolError):
            sample = reader.read(data)
            if sample is not None and np.isfinite(sample.position).all():
                believed.take(sample, time.monotonic())

    ros.raw("sensor_msgs.msg", "JointState", target.name(JOINT_STATES), take, depth=2)
    orders, announced, cancel_at = Orders(time.monotonic()), False, math.inf
    while True:
        time.sleep(_TURN if orders.strength is not None else 5 * _TURN)
        ros.take_messages()  # nothing is asked, so no answers have to be looked for
        if not announced and believed.sample is not None and publisher.get_subscription_count() > 0:
            announced = True
            print(_READY, file=agent)
        if select.select([0], [], [], 0.0)[0]:
            orders.take(os.read(0, 65536), time.monotonic())
        if cancel_at == math.inf and orders.gone(time.monotonic()) and believed.sample is not None:
            assert orders.strength is not None
            cancel_at, old = time.monotonic(), time.monotonic() - believed.at
            if old <= _OLD:  # or the arm would be thrown back to where it was
                position = believed.sample.position + believed.velocity * old
                cancel_at += send_brake(publisher, joints, orders.strength, position, believed.velocity) + CANCEL_AFTER
        if time.monotonic() >= cancel_at:
            ros.cancel_all(target)
            ros.spin_for(0.5)
            return 0
        if orders.ended and orders.strength is None:
            return 0


def _run(arguments: Sequence[str]) -> Any:
    code, agent = 1, os.fdopen(os.dup(1), "w", buffering=1, encoding="utf-8")
    os.dup2(2, 1)  # the middleware writes there, as where it finds no shared memory
    try:
        code = main(arguments, agent)
    except Exception as error:  # the agent reads it
        print(f"{type(error).__name__}: {error}", file=agent)
    os._exit(code)  # rclpy may hang at the end


if __name__ == "__main__":
    _run(sys.argv[1:])
