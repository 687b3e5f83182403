"""One Modbus connection: a thread that alone talks to it, beats its heart, and carries out what others ask.

A lost answer is only asked for again where a read was lost; a write is sent once, whatever becomes of it.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, TypeVar

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.transports.base.link import LinkThread, dropped
from drivers.transports.base.ports import open_socket, parse_address
from drivers.wire.modbus import Block

# Errors are raised as exceptions; the library would print it as well.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

_READ_ATTEMPTS = 2
_STANDSTILL = 5.0  # s that an exchange may take longer than its answer may, on a machine with other things to do
_FLOOD = 4096  # bytes without an answer among them
_REFUSALS = {
    1: "it does not know that function",
    2: "it has no such registers",
    3: "it takes the registers for damaged, or out of order",
    4: "it failed",
}
_BUSY, _NO_SESSION = 6, 7

Result = TypeVar("Result")


class SilentError(DriverError):
    """No answer in time."""


class ModbusLink(LinkThread):
    """A pymodbus client, connected to an address, and the thread that owns it.

    `on_turn()` is called in that thread between two requests; it may use `read`, `read_registers` and `write`, and
    returns how long [s] to wait for the next turn. `on_repeat()` is called before a read is asked for again.
    `on_failure(error)` comes once, as the last call. `timeout` [s] is how long an answer may take.

    Raises:
        DriverError: nobody there.
    """

    def __init__(
        self,
        address: str,
        unit: int,
        on_turn: Callable[[], float],
        on_repeat: Callable[[], None],
        on_failure: Callable[[DriverError], None],
        timeout: float,
    ) -> None:
        super().__init__(address, on_failure)
        self.timeout = timeout
        self._unit = unit
        self._received = 0
        self._turns = 0  # of the thread, and its exchanges
        self._understood = False  # an answer of this peer, once
        host, port = parse_address(address)
        connection = open_socket(address, timeout)
        self._client = ModbusTcpClient(host, port=port, timeout=timeout, retries=0, trace_packet=self._trace)
        self._client.socket = connection
        self._on_turn = on_turn
        self._on_repeat = on_repeat
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._thread.start()

    def call(self, work: Callable[[], Result]) -> Result:
        """Have the thread do it, and return what it returns or raises."""
        if threading.current_thread() is self._thread:
            return work()
        future: Future[Result] = Future()
        self._jobs.put((work, future))
        if self.failure is not None:
            self._refuse_jobs()
        return self._result(future)

    def _result(self, future: Future[Result]) -> Result:
        """Of a job, however long it takes while the thread goes on; a stall of the whole process passes."""
        turns, stood = -1, 0
        while stood < 2:
            with contextlib.suppress(TimeoutError):
                return future.result(self.timeout + _STANDSTILL)
            if future.done():
                return future.result()
            stood = stood + 1 if turns == self._turns else 0
            turns = self._turns
        self.failure = DriverError(
            f"the link to {self.peer} does not go on: its thread waits for something that does not come; connect again"
        )
        raise self.failure

    def read(self, block: Block) -> dict[str, Any]:
        """A block's values.

        Raises:
            SilentError: no answer, asked twice.
            ProtocolError: not this map, or damaged.
            DriverError: the link is down.
        """
        return self.call(lambda: self._read_block(block))

    def read_registers(self, address: int, count: int) -> list[int]:
        """Registers as they are; errors as of `read`."""
        return self.call(lambda: self._read(address, count))

    def write(self, block: Block, **values: Any) -> None:
        """Write a block, once.

        Raises:
            RefusedError: another client holds the controller, or it takes the block for damaged.
            SilentError: no answer; whether it was carried out is not known.
            DriverError: the link is down.
        """
        registers = block.pack(**values)
        self.call(
            lambda: self._exchange(
                lambda: self._client.write_registers(block.address, registers, device_id=self._unit), 1, block.name
            )
        )

    def close(self) -> None:
        """End the link and its thread; never raises."""
        self._closing.set()
        self._jobs.put(None)
        self._join(2 * self.timeout + 1.0)

    def _work(self) -> None:
        while not self._closing.is_set():
            self._turns += 1
            wait = self._on_turn()
            with contextlib.suppress(queue.Empty):
                self._do(self._jobs.get(timeout=wait) if wait > 0 else self._jobs.get_nowait())

    def carry_out_waiting(self) -> None:
        """Do the next thing that somebody waits for, if any: a stop must not wait for a whole turn (in the thread)."""
        with contextlib.suppress(queue.Empty):
            self._do(self._jobs.get_nowait())

    def _end(self, failure: DriverError) -> None:
        self.failure = failure
        with contextlib.suppress(Exception):  # whoever waits must hear of it all the same
            self._client.close()
        self._refuse_jobs()

    def _do(self, job: tuple[Callable[[], Any], Future[Any]] | None) -> None:
        if job is None:
            return
        work, future = job
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)
            if not self._client.connected:
                raise

    def _refuse_jobs(self) -> None:
        assert self.failure is not None
        with contextlib.suppress(queue.Empty):
            while True:
                job = self._jobs.get_nowait()
                if job is not None:
                    job[1].set_exception(type(self.failure)(str(self.failure)))

    def _read_block(self, block: Block) -> dict[str, Any]:
        for _ in range(_READ_ATTEMPTS):
            registers = self._read(block.address, block.registers)
            try:
                return block.unpack(registers)
            except ProtocolError as error:
                damage = error
        raise ProtocolError(f"{self.peer}: {damage}")

    def _read(self, address: int, count: int) -> list[int]:
        reply = self._exchange(
            lambda: self._client.read_holding_registers(address, count=count, device_id=self._unit),
            _READ_ATTEMPTS,
            "a read",
        )
        registers: Sequence[int] = reply.registers
        if len(registers) != count:
            raise ProtocolError(f"{self.peer} answered with {len(registers)} registers, where {count} were asked for")
        return list(registers)

    def _exchange(self, ask: Callable[[], ModbusPDU], attempts: int, what: str) -> ModbusPDU:
        limit = self.timeout / _READ_ATTEMPTS
        for part in (self._client, self._client.transaction):
            part.comm_params.timeout_connect = limit
        for attempt in range(attempts):
            if attempt:
                self._on_repeat()
            # The library would connect again by itself, to whoever listens there by then.
            if not self._client.connected:
                raise DriverError(f"the link to {self.peer} dropped")
            self._received = 0
            self._turns += 1
            try:
                return self._checked(ask(), what)
            except ConnectionException:
                raise self._dropped(OSError("the controller closed the connection")) from None
            except ModbusException:
                continue
            except (OSError, TimeoutError) as error:
                raise self._dropped(error) from None
        raise self._silence(what)

    def _checked(self, reply: ModbusPDU, what: str) -> ModbusPDU:
        self._understood = True
        if not reply.isError():
            return reply
        code = getattr(reply, "exception_code", 0)
        if code == _BUSY:
            raise RefusedError(f"the controller at {self.peer} is busy: another client holds it; close it first")
        if code == _NO_SESSION:
            raise DriverError(
                f"the controller at {self.peer} does not know this session any more: it was started again, or this end "
                "was silent for too long; connect again"
            )
        reason = _REFUSALS.get(code, f"Modbus exception {code}")
        if code in (1, 2):
            raise ProtocolError(
                f"{self.peer} speaks Modbus, but is no calibration controller: {reason}; is the address right?"
            )
        raise RefusedError(f"the controller at {self.peer} refused {what}: {reason}")

    def _silence(self, what: str) -> DriverError:
        if self._received and not self._understood:
            return ProtocolError(
                f"what answers at {self.peer} does not speak this protocol; is the address right, and that of the "
                "Modbus server?"
            )
        return SilentError(
            f"the controller at {self.peer} is silent: no answer to {what} within {self.timeout:g} s; is it the "
            "calibration server that listens there?"
        )

    def _dropped(self, error: OSError) -> DriverError:
        self._client.close()
        return dropped(self.peer, error)

    def _trace(self, sending: bool, data: bytes) -> bytes:
        if not sending:
            self._received = len(data)
            if len(data) > _FLOOD:
                self._client.close()
                raise ProtocolError(f"the device at {self.peer} floods the line with data that are not Modbus")
        return data
