"""One motion whose samples are taken out of the register ring."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from drivers.errors import DriverError, ProtocolError
from drivers.protocol import SampleBlock
from drivers.transports.base.samples import SampleStream
from drivers.transports.modbus.link import ModbusLink
from drivers.wire import modbus as wire

_CHUNK = 64  # samples taken in one turn
_ATTEMPTS = 3  # at a sample that arrives damaged; then it is lost


class RingMotion(SampleStream):
    """State of one motion. `expected` is the next sequence number; `shown_from` the first one in the ring.

    Called from the thread of the link.

    Parameters
    ----------
    limit : bytes that may wait for the consumer.
    link, session : of the controller.
    joints, slots : n, and the samples that the ring holds.
    motion_id : of the start.
    beat_if_due : is called between two reads: on a slow link a few of them last as long as a watchdog.
    """

    def __init__(
        self,
        limit: int,
        link: ModbusLink,
        session: int,
        joints: int,
        slots: int,
        motion_id: bytes,
        beat_if_due: Callable[[], None],
    ) -> None:
        super().__init__(limit)
        self.expected = 0
        self.shown_from = 0
        self._link = link
        self._session = session
        self._joints = joints
        self._slots = slots
        self._motion_id = motion_id
        self._beat_if_due = beat_if_due
        self._damaged = 0
        self._produced = 0
        self._heartbeat: int | None = None
        self._beat = False  # the controller's, since this was asked last
        self._silence, self._turned = 0.0, time.monotonic()

    @property
    def wants_room(self) -> bool:
        """Whether the ring should be moved on before the next poll."""
        return self.expected - self.shown_from >= self._slots // 2

    def silence(self, longest: float) -> float:
        """Seconds without a heartbeat of the controller, at the end of a turn; a turn counts for `longest` [s] at most.

        A stall of this process is not the controller's silence.
        """
        now = time.monotonic()
        self._silence = 0.0 if self._beat else self._silence + min(now - self._turned, longest)
        self._turned, self._beat = now, False
        return self._silence

    def poll(self) -> bool:
        """Take what there is, at most a chunk; True if more is waiting already.

        Raises:
            DriverError: no answer, the session is lost, or the controller counts from the start again.
        """
        progress = self._link.read(wire.PROGRESS)
        self._beat |= progress["heartbeat"] != self._heartbeat
        self._heartbeat = progress["heartbeat"]
        if progress["session"] != self._session:
            raise DriverError(
                f"the controller at {self._link.peer} does not know this session any more: it was started again, or "
                "given to another; go and look at the arm"
            )
        if progress["motion"] != self._motion_id or progress["state"] == wire.MotionState.NONE:
            return False
        if progress["samples"] < self._produced:
            raise ProtocolError(
                f"the controller's sample counter went back from {self._produced} to {progress['samples']}: it was "
                "reset in mid-motion"
            )
        self._produced = progress["samples"]
        if progress["oldest"] > self.expected:
            self._lose(progress["oldest"])
        if self.expected < self._produced:
            self._take_chunk()
        more = self.expected < self._produced
        if not more and progress["state"] == wire.MotionState.ENDED:
            message = self._link.read(wire.END)["message"]
            self.ended(progress["reason"], self._produced, message)
        return more

    def _take_chunk(self) -> None:
        slot = self.expected % self._slots
        room = self.shown_from + self._slots - self.expected
        count = min(self._produced - self.expected, self._slots - slot, room, _CHUNK)
        if count <= 0:
            return
        size = wire.slot_registers(self._joints)
        begin, end = wire.RING + slot * size, wire.RING + (slot + count) * size
        registers: list[int] = []
        for at in range(begin, end, wire.MAX_READ):
            self._beat_if_due()
            self._link.carry_out_waiting()
            registers += self._link.read_registers(at, min(wire.MAX_READ, end - at))
        slots = wire.unpack_slots(np.array(registers, np.uint16), self._joints, self.expected)
        received = len(slots.sequence)
        if received:
            times, (q, qd, torque, reference, reference_rate) = slots.time_ns * 1e-9, slots.values
            self.take(SampleBlock(slots.sequence, times, q, qd, torque, reference, reference_rate, time.time()))
            self.expected += received
            self._damaged = 0
        if received < count:  # the one after is damaged: again, but not for ever
            self._damaged += 1
            if self._damaged >= _ATTEMPTS:
                self._lose(self.expected + 1)

    def _lose(self, before: int) -> None:
        self.lost(before)
        self.expected = before
        self._damaged = 0
