"""The controller behind a register map: sessions, commands, the sample ring; the map is in drivers/wire/modbus.py."""

from __future__ import annotations

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.errors import ProtocolError
from drivers.wire import modbus as wire
from drivers.wire.modbus import Block
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.controller import CONTROLLER, PERIOD, VERSION, Controller
from fake_controller.execution import Slice
from fake_controller.program.memory import RefusedRequest, Upload
from fake_controller.servers.base import IDLE_LIMIT, stop_unheard

MEMORY = 400_000  # samples kept for a client that reads slower than the arm moves: 13 minutes
LONGEST_WATCHDOG = 30.0  # s

_WRITABLE = {block.address: block for block in wire.BLOCKS if block.access == "write"}


class RegisterMap:
    """What the registers of one controller say and do. Reads and writes come from one thread.

    Arguments as of `open_server`, and `memory`: samples kept.
    """

    def __init__(self, controller: Controller, watchdog: float, memory: int = MEMORY, waits: bool = False) -> None:
        joints = controller.robot.dof
        if joints > wire.MAX_JOINTS:
            raise ValueError(f"{joints} joints; the register map has room for {wire.MAX_JOINTS}")
        self._controller, self._shortest, self._waits = controller, watchdog, waits
        self._slots, self._slot = wire.slot_count(joints), wire.slot_registers(joints)
        self._rows = np.empty((memory, self._slot), np.uint16)
        self._empty = np.zeros(self._slot, np.uint16)
        self._empty[:2] = 0xFFFF
        self._taken_changed = threading.Condition()
        self._taken = self._produced = 0  # samples
        self._state, self._motion, self._end = wire.MotionState.NONE, b"", (EndReason.DONE, "")
        self._session = self._request = 0
        self._watchdog, self._silence = 1.0, 0.0  # s
        self._heartbeat, self._heard = 0, False
        self._answer = _no_answer()
        self._upload: Upload | None = None
        self._stop_wanted = self._driving = False
        self._worker = ThreadPoolExecutor(1, "command")
        self._closing = threading.Event()
        controller.when_restarting.append(self._forget)
        self._beats = threading.Thread(target=self._beat, name="watchdog", daemon=True)
        self._beats.start()

    def device(self) -> SimDevice:
        """The registers as pymodbus serves them."""
        blocks = [(block.address, block.registers, block.access == "read") for block in wire.BLOCKS]
        blocks.append((wire.RING, self._slots * self._slot, True))
        data = [SimData(at, count, 0, DataType.REGISTERS, readonly=readonly) for at, count, readonly in blocks]
        return SimDevice(wire.UNIT, data, action=self._access)

    def close(self) -> None:
        """Bring the arm to rest and end the threads."""
        self._closing.set()
        with self._taken_changed:
            self._taken_changed.notify_all()
        self._controller.shut_down()
        self._worker.shutdown(wait=True)
        self._beats.join(5.0)

    # Listener: in the motion's thread.

    def on_samples(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Keep samples for the ring."""
        rows = wire.pack_slots(first, time_ns, samples.columns)
        depth = len(self._rows)
        if self._waits:
            with self._taken_changed:
                self._taken_changed.wait_for(lambda: first + len(rows) - self._taken <= depth or self._gone())
        self._rows[np.arange(first, first + len(rows)) % depth] = rows
        self._produced = first + len(rows)

    def on_end(self, reason: EndReason, samples: int, message: str) -> None:
        """Note that the arm rests."""
        self._driving = False
        self._end = (reason, message)
        self._state = wire.MotionState.ENDED

    # Registers: in the server's thread.

    async def _access(
        self, function: int, start: int, address: int, count: int, registers: list[int], values: list[Any] | None
    ) -> ExcCodes | None:
        """pymodbus asks before every read (`values` is None) and write."""
        if values is None:
            at = address - start
            registers[at : at + count] = self._read(address, count)
            return None
        outcome = self._write(address, [int(value) for value in values])
        values[:] = [0] * len(values)
        return outcome

    def _read(self, address: int, count: int) -> list[int]:
        if address >= wire.RING:
            return self._ring(address - wire.RING, count)
        result = [0] * count
        for block in wire.BLOCKS:
            low, high = max(address, block.address), min(address + count, block.end)
            if low < high and block.access == "read":
                content = self._content(block)
                result[low - address : high - address] = content[low - block.address : high - block.address]
        return result

    def _content(self, block: Block) -> list[int]:
        if block is wire.ANSWER:
            return block.pack(**self._answer)
        if block is wire.PROGRESS:
            produced = self._produced
            return block.pack(
                heartbeat=self._heartbeat % 65536,
                session=self._session,
                state=self._state,
                motion=self._motion,
                samples=produced,
                oldest=max(0, produced - len(self._rows)),
                reason=self._end[0],
            )
        if block is wire.END:
            return block.pack(message=self._end[1])
        return self._own(block)

    def _own(self, block: Block) -> list[int]:
        """Identity, joint names, status, frames and alarms."""
        controller, state = self._controller, self._controller.state
        if block is wire.IDENTITY:
            return block.pack(
                magic=wire.MAGIC,
                version=wire.VERSION,
                joints=controller.robot.dof,
                period=round(PERIOD * 1e9),
                slots=self._slots,
                robot=controller.name,
                serial=controller.serial,
                controller=CONTROLLER,
                software=VERSION,
            )
        if block is wire.STATUS:
            flags = {
                wire.Flag.DRIVES_ON: state.drives_on,
                wire.Flag.EMERGENCY_STOP: state.emergency_stop,
                wire.Flag.CELL_CLOSED: state.cell_closed,
                wire.Flag.MOVING: controller.moving,
                wire.Flag.EMULATOR: state.emulator,
            }
            name, checksum = controller.stored
            return block.pack(
                flags=sum(flag for flag, on in flags.items() if on),
                mode=wire.MODES.get(state.mode, 0),
                alarms=len(state.alarms),
                override=state.override,
                position=controller.position,
                program=name,
                checksum=bytes.fromhex(checksum),
            )
        if block is wire.FRAMES:
            base, uframe, tool = controller.frames
            return block.pack(base=base, tool=tool, uframe=uframe)
        if block is wire.ALARMS:
            return block.pack(text="\n".join(state.alarms))
        first = wire.NAMES.index(block) * wire.NAMES_PER_BLOCK
        return block.pack(names=controller.robot.joint_names[first : first + wire.NAMES_PER_BLOCK])

    def _ring(self, at: int, count: int) -> list[int]:
        first, last = at // self._slot, (at + count - 1) // self._slot
        rows = np.concatenate([self._row(slot) for slot in range(first, last + 1)])
        begin = at - first * self._slot
        return rows[begin : begin + count].tolist()

    def _row(self, slot: int) -> np.ndarray:
        sequence = self._taken + (slot - self._taken) % self._slots
        stored = self._produced - len(self._rows) <= sequence < self._produced
        return self._rows[sequence % len(self._rows)] if stored else self._empty

    def _write(self, address: int, registers: list[int]) -> ExcCodes | None:
        block = _WRITABLE.get(address)
        if block is None:
            return ExcCodes.ILLEGAL_ADDRESS
        try:
            values = block.unpack(registers)
        except ProtocolError:
            return ExcCodes.ILLEGAL_VALUE
        session = values["session"]
        if block is wire.COMMAND and values["command"] == wire.Command.OPEN:
            return self._open(values)
        if not self._session:
            return ExcCodes.NEGATIVE_ACKNOWLEDGE
        if session != self._session:
            return ExcCodes.DEVICE_BUSY
        self._heard = True
        if block is wire.HEARTBEAT:
            with self._taken_changed:
                if values["taken"] <= self._produced:
                    self._taken = max(self._taken, values["taken"])
                self._taken_changed.notify_all()
            return None
        if block is wire.UPLOAD:
            return self._upload_block(values)
        return self._command(values)

    def _open(self, values: dict[str, Any]) -> ExcCodes | None:
        """A client that is gone may be succeeded once the arm rests."""
        if not values["session"]:
            return ExcCodes.ILLEGAL_VALUE
        if self._session not in (0, values["session"]) and not (self._gone() and not self._controller.moving):
            return ExcCodes.DEVICE_BUSY
        if self._session == values["session"] and values["request"] <= self._request:
            return None
        self._session, self._request = values["session"], values["request"]
        self._watchdog = min(max(values["watchdog"] / 1000, self._shortest), LONGEST_WATCHDOG)
        self._heard, self._silence, self._upload = True, 0.0, None
        self._controller.reach("connect")
        self._answer = _no_answer(values, wire.OutcomeCode.DONE, watchdog=round(self._watchdog * 1000))
        return None

    def _upload_block(self, values: dict[str, Any]) -> ExcCodes | None:
        if self._upload is None or not 1 <= values["count"] <= wire.UPLOAD_BYTES:
            return ExcCodes.ILLEGAL_VALUE
        try:
            self._upload.add(values["offset"], values["data"][: values["count"]])
        except RefusedRequest:
            return ExcCodes.ILLEGAL_VALUE
        return None

    def _command(self, values: dict[str, Any]) -> ExcCodes | None:
        if values["request"] <= self._request:
            return None  # taken before: said twice, done once
        self._request = values["request"]
        self._answer = _no_answer(values, wire.OutcomeCode.WORKING)
        command = values["command"]
        if command in (wire.Command.UPLOAD_END, wire.Command.START):  # these take their time
            if command == wire.Command.START:
                self._stop_wanted = False
                self._controller.reach("start")  # now, while the answer to this very message is still to be sent
            self._worker.submit(self._carry_out, values)
        else:
            self._carry_out(values)
        return None

    def _carry_out(self, values: dict[str, Any]) -> None:
        try:
            answer = _no_answer(values, wire.OutcomeCode.DONE, checksum=self._do(values))
        except RefusedRequest as refused:
            answer = _no_answer(
                values,
                wire.OutcomeCode.REFUSED,
                refusal=refused.reason,
                line=refused.line,
                column=refused.column,
                message=str(refused),
            )
        if self._answer["request"] == values["request"] and self._answer["session"] == values["session"]:
            self._answer = answer

    def _do(self, values: dict[str, Any]) -> bytes:
        controller = self._controller
        match values["command"]:
            case wire.Command.RELEASE:
                self._stop(EndReason.WATCHDOG, "the client has left")
                self._session = 0
            case wire.Command.UPLOAD_BEGIN:
                controller.check_upload(values["name"], values["size"])
                self._upload = Upload(values["name"], values["size"], values["checksum"].hex())
            case wire.Command.UPLOAD_END:
                if self._upload is None:
                    raise RefusedRequest(Refusal.BAD_REQUEST, "no upload has begun")
                upload, self._upload = self._upload, None
                return bytes.fromhex(controller.store(upload.name, upload.complete()))
            case wire.Command.START:
                self._start(values)
            case wire.Command.STOP:
                self._stop(EndReason.STOPPED, "stopped on command")
            case other:
                raise RefusedRequest(Refusal.UNKNOWN_MESSAGE, f"{other} is no command")
        return b""

    def _start(self, values: dict[str, Any]) -> None:
        self._controller.start(values["name"], values["checksum"].hex(), values["motion"], self)
        self._produced = self._taken = 0
        self._motion = values["motion"]
        self._end = (EndReason.DONE, "")
        self._state = wire.MotionState.RUNNING
        self._driving = True
        self._controller.go()
        if self._stop_wanted:  # it came while the first moves were planned
            self._controller.stop(EndReason.STOPPED, "stopped on command")

    def _stop(self, reason: EndReason, message: str) -> None:
        self._stop_wanted = True
        self._controller.stop(reason, message)

    def _forget(self) -> None:
        """Power off and on, or nobody there."""
        self._session = self._request = 0
        self._upload = None
        self._answer = _no_answer()
        self._state = wire.MotionState.NONE

    def _gone(self) -> bool:
        return self._session == 0 or self._silence >= self._watchdog or self._closing.is_set()

    def _beat(self) -> None:
        """Count the client's silence in turns, so that a stall of this process is not the client's."""
        while not self._closing.wait(interval := self._watchdog / 4):
            self._heartbeat += 1
            self._silence = 0.0 if self._heard else self._silence + interval
            self._heard = False
            if self._silence >= max(IDLE_LIMIT, self._watchdog) and not self._controller.moving:
                self._forget()  # before the wire is in order again: who was cut off does not go on as if nothing were
                self._controller.faults.heal()
            if self._driving and self._gone():
                with contextlib.suppress(RuntimeError):
                    stop_unheard(self._controller, self._watchdog)
                with self._taken_changed:
                    self._taken_changed.notify_all()


def _no_answer(
    values: dict[str, Any] | None = None, outcome: wire.OutcomeCode = wire.OutcomeCode.WORKING, **more: Any
) -> dict[str, Any]:
    """The fields of the answer block to a command."""
    about = {key: values[key] if values else 0 for key in ("session", "request")}
    empty = {"refusal": 0, "line": 0, "column": 0, "message": "", "checksum": b"", "watchdog": 0}
    return {**about, "outcome": outcome, **empty, **more}
