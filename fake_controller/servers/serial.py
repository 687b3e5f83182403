"""The frame server on a serial line; the wire is in docs/wire-serial.md."""

from __future__ import annotations

import contextlib
import errno
import threading
import time
from collections import deque
from typing import Any

import numpy as np
import serial

from drivers.wire.frames import VERSION, End, Frame, Heartbeat, Hello, Welcome, encode
from drivers.wire.reasons import EndReason, Refusal
from drivers.wire.serial import (
    LONGEST_FRAME,
    MAX_PAYLOAD,
    HuntingDecoder,
    LeanSamples,
    frame_time,
    samples_per_frame,
)
from fake_controller.controller import Controller
from fake_controller.execution import Slice
from fake_controller.programs import RefusedRequest
from fake_controller.servers.frame_client import IDLE_LIMIT, FrameClient
from fake_controller.servers.modbus.registers import LONGEST_WATCHDOG, MEMORY

MAX_REPLIES = 64  # answers that wait for the line
_WRITE_LIMIT = 30.0  # s


class SerialServer(FrameClient):
    """Serves one controller on one serial port. What the line cannot carry yet is kept, and sent after the motion.

    Arguments and errors as of `open_server`, and `memory`: samples kept. The watchdog is never less than three of the
    longest frames.
    """

    def __init__(
        self,
        controller: Controller,
        port: str,
        baud: int,
        watchdog: float = 0.05,
        memory: int = MEMORY,
        waits: bool = False,
    ) -> None:
        super().__init__(controller)
        self.address, self._waits = port, waits
        self._shortest = max(watchdog, 3 * frame_time(baud, LONGEST_FRAME))
        joints = controller.robot.dof
        self._batch = samples_per_frame(joints)
        self._times = np.empty(memory, np.int64)
        self._values = np.empty((memory, 5, joints), np.float32)
        try:
            self._port = serial.serial_for_url(port, baudrate=baud, write_timeout=_WRITE_LIMIT, exclusive=True)
        except serial.SerialException as error:
            raise OSError(error.errno or errno.ENOENT, str(error)) from None
        self._lock, self._closing = threading.Condition(), threading.Event()
        self._replies: deque[bytes] = deque()
        self._produced = self._sent = 0
        self._end: End | None = None
        self._end_sent = self._gone = True  # the second: nothing was heard from the client for its watchdog
        controller.when_restarting.append(self._forget)
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._read, self._write)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Bring the arm to rest, send what is left of its end if the line takes it, and close the port."""
        self._waits = False
        self.controller.shut_down()
        with self._lock:
            self._lock.wait_for(lambda: self._end_sent or not self._greeted, 1.0)
        self._closing.set()
        with contextlib.suppress(OSError):
            self._port.cancel_read()
            self._port.cancel_write()
        self._wake()
        for thread in self._threads:
            thread.join(5.0)
        with contextlib.suppress(OSError):
            self._port.close()

    # Listener: in the motion's thread.

    def on_samples(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Keep samples until the line has carried them."""
        depth, end = len(self._times), first + len(samples)
        with self._lock:
            if self._waits:
                self._lock.wait_for(lambda: end - self._sent <= depth or self._gone or not self._waits)
            at = np.arange(first, end) % depth
            self._times[at] = time_ns
            self._values[at] = np.stack(samples.columns, axis=1)
            # A counter that went back sends what it counts now: the client has to see it.
            self._sent = max(first if first < self._produced else self._sent, end - depth)
            self._produced = end
            self._lock.notify_all()

    def on_end(self, reason: EndReason, samples: int, message: str) -> None:
        """Tell that the arm rests, once all samples are out."""
        with self._lock:
            self._driving = False
            self._end, self._end_sent = End(reason, samples, message), False
            self._lock.notify_all()

    # The line.

    def _read(self) -> None:
        decoder = HuntingDecoder(MAX_PAYLOAD)
        while not self._closing.is_set():
            self._port.timeout = self._watchdog / 4
            began = time.monotonic()
            try:
                data = self._port.read(1)
                data += self._port.read(self._port.in_waiting) if data else b""
            except (serial.SerialException, OSError, TypeError):  # pulled out, or closed by `close`
                self._lost()
                return
            self._take(data, decoder, began)
            if self._silence >= self._watchdog:
                self._gone = True
                self._wake()
            if self._silence >= max(IDLE_LIMIT, self._watchdog):
                self._lost()

    def _answer(self, frame: Frame) -> None:
        self._gone = False
        super()._answer(frame)

    def _lost(self) -> None:
        """Nobody listens."""
        self._forget()
        self.controller.faults.heal()
        if self._driving:
            self.controller.stop(EndReason.WATCHDOG, "the client is gone")

    def _forget(self) -> None:
        with self._lock:
            self._greeted, self._gone = False, True
            self._replies.clear()
            self._lock.notify_all()

    def _write(self) -> None:
        beaten = 0.0
        while not self._closing.is_set():
            with self._lock:
                due = beaten + self._watchdog / 4 - time.monotonic()
                if due > 0:
                    self._lock.wait_for(self._something, due)
                data = self._next()
                self._lock.notify_all()
            heartbeat = not data
            if heartbeat:
                beaten = time.monotonic()
                data = encode(Heartbeat()) if self._greeted else b""
            try:
                if data:
                    self.controller.faults.send(data, self._port.write, self.controller.faults.unplug, heartbeat)
            except ConnectionResetError:
                continue  # a line has nothing more to close
            except (serial.SerialException, OSError, TypeError):
                self._lost()
                if not self._port.is_open or self._closing.is_set():
                    return

    def _something(self) -> bool:
        waiting = self._replies or self._sent < self._produced or not self._end_sent
        return self._closing.is_set() or (self._greeted and bool(waiting))

    def _next(self) -> bytes:
        """What to send now: answers before samples, the end after them."""
        if not self._greeted:
            return b""
        if self._replies:
            return self._replies.popleft()
        if self._sent < self._produced:
            message = self._samples(self._sent, self._batch)
            self._sent = message.first + len(message.time_ns)
            return encode(message)
        if not self._end_sent and self._end is not None:
            self._end_sent = True
            return encode(self._end)
        return b""

    def _samples(self, first: int, count: int) -> LeanSamples:
        depth = len(self._times)
        first = max(first, self._produced - depth)
        at = np.arange(first, min(first + count, self._produced)) % depth
        return LeanSamples(first, self._times[at], *np.moveaxis(self._values[at], 1, 0))

    # Requests: in the reader's thread.

    def _greet(self, hello: Hello, request: int) -> None:
        """A line has one client at a time; who greets again has been started again."""
        with self._lock:
            self._greeted = True
            self._replies.clear()
        self._check_version(hello)
        if self._driving:
            raise RefusedRequest(Refusal.BUSY, "the arm moves for the client before; wait until it rests")
        with self._lock:
            self._watchdog = min(max(hello.watchdog_ms / 1000, self._shortest), LONGEST_WATCHDOG)
            self._upload = None
            self._sent, self._end_sent = self._produced, True
        self.controller.faults.heal()
        self.controller.reach("connect")
        self._reply(Welcome(VERSION, round(self._watchdog * 1000)), request)

    def _begin(self) -> None:
        with self._lock:
            self._produced = self._sent = 0
            self._end, self._end_sent = None, True

    def _fetched(self, first: int, count: int) -> LeanSamples | End:
        with self._lock:
            end = self._end
            if 0 <= first < self._produced and count > 0:
                return self._samples(first, min(count, self._batch))
            if end is not None and self._end_sent:
                return end
        raise RefusedRequest(Refusal.NOT_AVAILABLE, f"there are no samples from {first} on")

    def _reply(self, message: Any, request: int) -> None:
        with self._lock:
            if len(self._replies) < MAX_REPLIES:
                self._replies.append(encode(message, request))
            self._lock.notify_all()

    def _wake(self) -> None:
        with self._lock:
            self._lock.notify_all()
