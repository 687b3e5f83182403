"""The two connections of a motion: RTDE (samples, registers) and the primary interface (programs, messages).

One thread reads both. It answers samples with heartbeats, and waits for nobody: a program that feels no heartbeat stops
the arm (`rtde_set_watchdog`), so heartbeats say that samples come and that somebody is there to look at them.
"""

from __future__ import annotations

import contextlib
import itertools
import socket
import struct
import threading
from collections.abc import Callable

import numpy as np

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.transports.base.link import WATCHDOG, LinkThread, dropped
from drivers.transports.base.ports import open_socket
from drivers.wire import ur_primary as messages, ur_rtde as rtde
from drivers.wire.stream import PackageDecoder
from drivers.wire.ur_primary import Presence, ProgramChange, ProgramFault

_RECEIVE = 256 * 1024
#: Heartbeats to a watchdog, by the controller's clock.
_BEATS = 8
#: The controller's clock goes back by more [s] only where it has been restarted; in a motion it goes ahead by no more
#: than the watchdog.
_BACK = 0.1
#: Time over which the rate of samples is measured [s].
_PACE = 0.25


class UrLink(LinkThread):
    """RTDE and primary interface of one controller, and their thread.

    Args:
        primary, data: host:port of the primary interface and of RTDE.
        fields: of RTDE, that are asked for.
        period: of the controller [s].
        timeout: how long [s] to wait for an answer.
        on_samples: is given samples (K,) of `rtde.FIELDS`, in the thread.
        on_message: is given what the controller says of programs, in the thread.
        on_failure: comes once, as the last call.

    Raises:
        DriverError: no answer, silence, or another protocol.
        RefusedError: another client drives this robot, or the controller lacks a field.
    """

    def __init__(
        self,
        primary: str,
        data: str,
        fields: tuple[str, ...],
        period: float,
        timeout: float,
        on_samples: Callable[[np.ndarray], None],
        on_message: Callable[[ProgramChange | ProgramFault], None],
        on_failure: Callable[[DriverError], None],
    ) -> None:
        super().__init__(data, on_failure)
        self.beating = False  # where it does not, a program stops the arm
        self.real: bool | None = None  # whether a robot is there, once that was said
        self._fields, self._period = fields, period
        self._timeout = timeout
        self._on_samples, self._on_message = on_samples, on_message
        self._permit = 0
        self._beats = itertools.count(1)
        self._beaten = -np.inf  # controller time [s] of the last heartbeat
        self._packages = PackageDecoder(rtde.HEAD, 0xFFFF, "RTDE")
        self._messages = PackageDecoder(messages.HEAD, messages.LONGEST, "the primary interface")
        self._early: list[bytes] = []  # samples may come before the answer to the start
        self._sending = threading.Lock()
        self._last: np.void | None = None
        self.count = 0  # of samples that came
        self._handles: list[socket.socket] = []
        try:
            self._rtde = self._opened(data)
            self._outputs, self._inputs = self._agree()
            self._primary = self._opened(primary)
        except BaseException:
            self.close()
            raise
        self._thread.start()

    @property
    def latest(self) -> np.void:
        """The sample that came last; `fresh` has given one before."""
        assert self._last is not None
        return self._last

    def fresh(self, since: int | None = None) -> np.void:
        """A sample that came after this call, or after the first `since` samples; `fresh(0)` is the latest.

        Raises:
            DriverError: none came.
        """
        with self._changed:
            count = self.count if since is None else since
            self.wait(lambda: self.count > count, self._timeout)
            self.check()
            if self._last is None or self.count == count:
                raise DriverError(f"{self.peer}: RTDE is silent: no sample within {self._timeout:g} s")
            return self._last

    def simulated(self) -> bool:
        """Whether a simulator of the controller answers, without a robot.

        Raises:
            DriverError: the primary interface does not say.
        """
        if not self.wait(lambda: self.real is not None, self._timeout):
            self.check()
            raise DriverError(f"{self.peer}: the primary interface is silent; is it switched on there?")
        return not self.real

    def pace(self) -> float:
        """Samples a second by the controller's clock, now."""
        first, count = float(self.fresh()["timestamp"]), self.count
        self.wait(lambda: self._last is not None and self._last["timestamp"] >= first + _PACE, self._timeout)
        self.check()
        assert self._last is not None
        if not (passed := float(self._last["timestamp"]) - first) > 0.0:
            raise DriverError(f"{self.peer}: the clock of the controller stands still; restart the controller")
        return (self.count - count) / passed

    def send_program(self, text: str) -> None:
        """Send a program, once.

        Raises:
            DriverError: the link is down, or takes no data any more.
        """
        self.transmit(self._primary, text.encode("utf-8"), self.peer)

    def allow(self, number: int) -> None:
        """Let the program of this number move; 0 none.

        Raises:
            DriverError: the link is down.
        """
        self.check()
        self._permit = number
        self._beat()

    def _opened(self, endpoint: str) -> socket.socket:
        handle = open_socket(endpoint, self._timeout)
        self._handles.append(handle)
        return handle

    def _agree(self) -> tuple[rtde.OutputRecipe, int]:
        """Set the messages that are sent and received from now on."""
        if self._ask(rtde.package(rtde.VERSION, struct.pack(">H", 2))) != b"\1":
            raise ProtocolError(f"{self.peer}: the controller does not speak version 2 of RTDE")
        answer = self._ask(rtde.output_request(self._fields, 1.0 / self._period))
        outputs = rtde.OutputRecipe.of(self._fields, answer)
        names = (rtde.HEARTBEAT, rtde.PERMIT)
        inputs = rtde.input_recipe(names, self._ask(rtde.package(rtde.INPUTS, ",".join(names).encode())))
        if self._ask(rtde.package(rtde.START)) != b"\1":
            raise RefusedError(f"{self.peer}: the controller does not start RTDE")
        return outputs, inputs

    def _ask(self, request: bytes) -> bytes:
        """The answer to a request, before the thread runs."""
        kind = request[2]
        try:
            self._rtde.sendall(request)
            while True:
                data = self._rtde.recv(_RECEIVE)
                if not data:
                    raise DriverError(f"{self.peer}: the controller closed RTDE; is it switched on there?")
                answers = list(self._packages.feed(data))
                self._early += [content for got, content in answers if got == rtde.DATA]
                for got, content in answers:
                    if got == kind and content:
                        return content
        except TimeoutError:
            raise DriverError(
                f"{self.peer}: RTDE is silent: no answer within {self._timeout:g} s; is it switched on there?"
            ) from None
        except OSError as error:
            raise dropped(self.peer, error) from None

    def _beat(self) -> None:
        values = (next(self._beats) % 2**31, self._permit)
        with self._sending, contextlib.suppress(OSError):  # a link that is down is noticed by its reader
            self._rtde.sendall(rtde.input_package(self._inputs, *values))

    def _work(self) -> None:
        self._take_samples(self._early)
        for ready in self._each_turn(self._handles):
            if self._rtde in ready:
                self._take_samples([c for k, c in self._packages.feed(self._read(self._rtde)) if k == rtde.DATA])
            if self._primary in ready:
                self._take_messages(self._read(self._primary))

    def _fell_silent(self) -> DriverError:
        return DriverError(
            f"the controller at {self.peer} fell silent: no new sample for {self.watchdog:g} s, and the arm may move; "
            "its program stops it, as it feels no heartbeat: go and look at it"
        )

    def _read(self, handle: socket.socket) -> bytes:
        data = handle.recv(_RECEIVE)
        if not data:
            what = "RTDE" if handle is self._rtde else "the primary interface; was the robot switched to local mode?"
            raise DriverError(f"the controller at {self.peer} closed {what}")
        return data

    def _take_samples(self, contents: list[bytes]) -> None:
        samples = self._outputs.samples(contents)
        if len(samples) == 0:
            return
        last = samples["timestamp"][0] if self._last is None else self._last["timestamp"]
        now = float(samples["timestamp"][-1])
        with np.errstate(invalid="ignore"):
            passed = np.diff(samples["timestamp"], prepend=last)
        if not np.all((passed >= -_BACK) & (passed <= (self.watchdog if self.guarded else np.inf))):
            raise DriverError(
                f"the clock of the controller at {self.peer} jumped, from {last:.6g} s to {now:.6g} s: it was "
                "restarted, or what it sends cannot be trusted; look at it"
            )
        self._heard = now > last  # where its clock stands, the controller is silent
        with self._changed:
            self._last, self.count = samples[-1], self.count + len(samples)
            self._changed.notify_all()
        if self.beating and now - self._beaten >= WATCHDOG / _BEATS:
            self._beaten = now
            self._beat()
        self._on_samples(samples)

    def _take_messages(self, data: bytes) -> None:
        for package in self._messages.feed(data):
            for message in messages.meaning(*package):
                if isinstance(message, Presence):
                    self.real = message.real
                else:
                    self._on_message(message)
        with self._changed:
            self._changed.notify_all()
