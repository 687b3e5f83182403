"""The Modbus/TCP driver; the registers are in docs/wire-modbus.md."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import secrets
import threading
import time
import uuid
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.protocol import Identity, Status
from drivers.transports.base.link import WATCHDOG, LinkDriver
from drivers.transports.base.ports import parse_address
from drivers.transports.base.poses import poses_of_frames
from drivers.transports.modbus.link import ModbusLink, SilentError
from drivers.transports.modbus.ring import RingMotion
from drivers.wire import modbus as wire
from drivers.wire.reasons import refusal_error

_POLL = 0.02  # s between two looks for new samples
_ANSWER_POLL = 0.005
_MEASURED = 9  # reads that measure the link; the quickest counts, as the others waited for something else
_OTHERS = 20  # exchanges a second for the state and the progress of a motion
_STOPS = 3  # at most, where nothing answers: a second one does no harm
_GOODBYE = 1.0  # s for the answer to the last message


class ModbusDriver(LinkDriver[ModbusLink, RingMotion]):
    """`drivers.protocol.Driver` over Modbus/TCP; the address is `host:port`.

    Parameters
    ----------
    address : of the controller.
    unit : Modbus unit, for a controller behind a gateway.
    options : of `LinkDriver`.

    Raises:
        ConfigurationError: not an address.
    """

    def __init__(self, address: str, *, unit: int = wire.UNIT, **options: Any) -> None:
        parse_address(address)
        super().__init__(address, **options)
        self._unit = unit
        self._closed = threading.Event()
        self._stopping = threading.Lock()

    def identify(self) -> Identity:
        """Ask the controller who it is."""
        link = self._connected()
        who = link.read(wire.IDENTITY)
        names = itertools.chain.from_iterable(link.read(block)["names"] for block in wire.NAMES)
        return Identity(
            robot=who["robot"],
            serial=who["serial"],
            controller=who["controller"],
            version=who["software"],
            joint_names=tuple(itertools.islice(names, who["joints"])),
            period=who["period"] * 1e-9,
        )

    def status(self) -> Status:
        """Ask for the state."""
        link = self._connected()
        values = link.read(wire.STATUS)
        alarms = link.read(wire.ALARMS)["text"].splitlines() if values["alarms"] else []
        flags = wire.Flag(values["flags"])
        return Status(
            drives_on=wire.Flag.DRIVES_ON in flags,
            mode=next((name for name, code in wire.MODES.items() if code == values["mode"]), "unknown"),
            emergency_stop=wire.Flag.EMERGENCY_STOP in flags,
            # More alarms than fit are alarms all the same.
            alarms=tuple(alarms) or (("unnamed",) if values["alarms"] else ()),
            override=values["override"],
            cell_closed=wire.Flag.CELL_CLOSED in flags,
            moving=wire.Flag.MOVING in flags,
            program=values["program"],
            checksum=values["checksum"].hex() if values["program"] else "",
            position=np.array(values["position"][: self._joints]),
            emulator=wire.Flag.EMULATOR in flags,
        )

    def throughput(self) -> float:
        """`MeasuresThroughput`: by the exchanges that the link makes in a second, less those for other things."""
        link, took = self._connected(), []
        for _ in range(_MEASURED):
            began = time.monotonic()
            link.read_registers(wire.RING, wire.MAX_READ)
            took.append(time.monotonic() - began)
        exchanges = max(0.0, 1.0 / min(took) - _OTHERS - 4 / link.watchdog)
        return exchanges * wire.MAX_READ / wire.slot_registers(self._joints)

    def frames(self) -> dict[str, np.ndarray]:
        """`ReportsFrames`; empty where this controller has no such registers."""
        link = self._connected()
        try:
            values = link.read(wire.FRAMES)
        except ProtocolError:
            return {}
        return poses_of_frames(values["base"], values["tool"], values["uframe"])

    def upload(self, name: str, text: str) -> str:
        """Store a program; returns the SHA-256 (hex) of the text as the controller stored it.

        Raises:
            RefusedError: not a program (with line and column), too large, no memory, or the arm is moving.
        """
        link = self._connected()
        data = text.encode("utf-8")
        what = f"the program {name}"
        _fits(name)
        checksum = hashlib.sha256(data).digest()
        self._command(wire.Command.UPLOAD_BEGIN, self._timeout, what, name=name, size=len(data), checksum=checksum)
        for offset in range(0, len(data), wire.UPLOAD_BYTES):
            part = data[offset : offset + wire.UPLOAD_BYTES]
            link.write(wire.UPLOAD, session=self._session, offset=offset, count=len(part), data=part)
        return self._command(wire.Command.UPLOAD_END, self._start_timeout, what)["checksum"].hex()

    def start(self, name: str, checksum: str) -> None:
        """Run the stored program once. Where the answer is lost the link is closed, so that the arm cannot go on."""
        link = self._connected()
        self._check_over()
        _fits(name)
        motion_id = uuid.uuid4().bytes
        ring = self._session, self._joints, self._slots
        with self._start_of(RingMotion(self._buffer_limit, link, *ring, motion_id, self._beat_if_due)) as motion:
            link.call(lambda: self._guard(link))
            fields = {"name": name, "checksum": bytes.fromhex(checksum), "motion": motion_id}
            # Samples say as well that the arm moves: then it is time to watch it.
            self._command(wire.Command.START, self._start_timeout, f"start of {name}", motion.has_begun, **fields)

    def close(self) -> None:
        """Give the controller back and close the link; an arm that still moves comes to rest. Never raises."""
        link, self._link = self._link, None
        self._closed.set()
        if link is None:
            return
        if self._beating and link.failure is None:
            link.timeout = min(link.timeout, _GOODBYE)
            with contextlib.suppress(DriverError):
                self._give(link, wire.Command.RELEASE)
        link.close()

    def _open(self) -> None:
        """See that the right map is there, take the controller, and agree on the watchdog."""
        self._session = secrets.randbelow(2**32 - 1) + 1
        self._requests = itertools.count(1)
        self._beats = itertools.count(1)
        self._beating = False
        self._beaten = 0.0
        self._closed.clear()
        self._link = link = ModbusLink(
            self.address, self._unit, self._turn, self._beat_meanwhile, self._on_failure, self._timeout
        )
        link.watchdog = self._watchdog
        identity = link.read(wire.IDENTITY)
        if identity["magic"] != wire.MAGIC:
            raise ProtocolError(f"{self.address} speaks Modbus, but is no calibration controller")
        if identity["version"] != wire.VERSION:
            raise ProtocolError(
                f"the controller at {self.address} has version {identity['version']} of the register map, this "
                f"driver {wire.VERSION}; update the older one"
            )
        joints, slots = identity["joints"], identity["slots"]
        if not 1 <= joints <= wire.MAX_JOINTS or not 1 <= slots <= wire.slot_count(joints):
            raise ProtocolError(f"the controller at {self.address} announces {joints} joints, {slots} slots")
        self._joints, self._slots = joints, slots
        answer = self._command(wire.Command.OPEN, self._timeout, "the session", watchdog=round(1000 * self._watchdog))
        if not 10 <= answer["watchdog"] <= 60_000:
            raise ProtocolError(f"the controller at {self.address} wants a watchdog of {answer['watchdog']} ms")
        link.watchdog = answer["watchdog"] / 1000
        self._beating = True
        link.call(lambda: None)  # wake the thread: its heart begins to beat

    def _bring_to_rest(self, link: ModbusLink, motion: RingMotion | None) -> None:
        if motion is not None:
            motion.stopping = True
        with self._stopping:  # a second one would take the answer of the first
            self._command_stop()
        until = time.monotonic() + self._start_timeout
        while link.read(wire.PROGRESS)["state"] == wire.MotionState.RUNNING:
            if time.monotonic() > until:
                raise self._still_moves()
            self._closed.wait(_ANSWER_POLL)

    def _command_stop(self) -> None:
        for _ in range(_STOPS - 1):
            with contextlib.suppress(SilentError):
                self._command(wire.Command.STOP, self._timeout, "stop")  # sent again at once where nothing answers
                return
        self._command(wire.Command.STOP, self._timeout, "stop", lambda: False)

    def _give(self, link: ModbusLink, command: wire.Command, request: int | None = None, **fields: Any) -> None:
        """Write a command, once."""
        blank = {"watchdog": 0, "name": "", "size": 0, "checksum": b"", "motion": b""}
        number = next(self._requests) if request is None else request
        link.write(wire.COMMAND, **{**blank, **fields}, session=self._session, request=number, command=command)

    def _command(
        self, command: wire.Command, timeout: float, what: str, acts: Callable[[], bool] | None = None, **fields: Any
    ) -> dict[str, Any]:
        """Give a command once and wait for what becomes of it, but no longer than until it is seen that it `acts`.

        A lost answer to the writing of what `acts` is made good by reading what became of it.
        """
        link = self._connected()
        request = next(self._requests)
        lost: DriverError | None = None
        try:
            self._give(link, command, request, **fields)
        except SilentError as error:
            if acts is None:
                raise
            lost = error
        until = time.monotonic() + timeout
        while True:
            answer = link.read(wire.ANSWER)
            if (answer["session"], answer["request"]) != (self._session, request):
                raise lost or DriverError(
                    f"{what}: the controller at {self.address} went on to another command, or was started again"
                )
            if answer["outcome"] != wire.OutcomeCode.WORKING:
                break
            if acts is not None and acts():
                return answer
            if time.monotonic() > until:
                raise DriverError(f"the controller at {self.address} did not finish {what} within {timeout:g} s")
            self._closed.wait(_ANSWER_POLL)
        if answer["outcome"] == wire.OutcomeCode.DONE:
            return answer
        position = answer["line"], answer["column"]
        raise refusal_error(self.address, what, answer["refusal"], *position, answer["message"])

    def _not_started(self) -> None:
        link = self._connected()
        link.call(lambda: self._unguard(link))

    # From here on in the link's thread.

    def _guard(self, link: ModbusLink) -> None:
        link.guarded = True
        link.timeout = min(self._timeout, link.watchdog, WATCHDOG)  # an answer that is lost must not cost more
        self._beat()  # from now on the ring shows samples from 0 on

    def _unguard(self, link: ModbusLink) -> None:
        link.guarded = False
        link.timeout = self._timeout

    def _turn(self) -> float:
        """A heartbeat if it is due, and a look at the motion if there is one; the time to the next turn [s]."""
        if not self._beating:
            return 60.0
        watchdog, link, motion = self.watchdog, self._link, self._guarded_motion
        try:
            if motion is not None and motion.wants_room:
                self._beat()
            self._beat_if_due()
            more = motion is not None and motion.poll()
        except SilentError:
            more = False  # one answer may be lost; silence is counted below
        if link is None or motion is None:
            return watchdog / 4
        if motion.over:
            self._unguard(link)
            return watchdog / 4
        if (full := motion.too_full()) is not None:
            self._give(link, wire.Command.STOP)
            motion.finish(full)
        if motion.silence(watchdog / 2) >= watchdog:
            raise DriverError(
                f"the controller at {self.address} fell silent: no heartbeat for {watchdog * 1000:.0f} ms while "
                "the arm may move; go and look at it"
            )
        return 0.0 if more else min(_POLL, watchdog / 8)

    @property
    def _guarded_motion(self) -> RingMotion | None:
        return self._motion if self._link is not None and self._link.guarded else None

    def _beat_if_due(self) -> None:
        if time.monotonic() - self._beaten >= self.watchdog / 4:
            self._beat()

    def _beat_meanwhile(self) -> None:
        """A controller that is late with an answer must not take this end for silent while it is waited for."""
        if self._guarded_motion is not None:
            with contextlib.suppress(SilentError):  # silence is counted where the ring is looked at
                self._beat_if_due()

    def _beat(self) -> None:
        self._beaten = time.monotonic()
        motion = self._guarded_motion
        expected = 0 if motion is None else motion.expected
        self._connected().write(wire.HEARTBEAT, session=self._session, count=next(self._beats) % 65536, taken=expected)
        if motion is not None:
            motion.shown_from = expected


def _fits(name: str) -> None:
    """A longer name would be cut, and mean another program."""
    if len(name.encode("utf-8")) > 32:
        raise RefusedError(f"{name!r} cannot name a program: the register map has room for 32 bytes")
