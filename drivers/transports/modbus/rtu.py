"""The Modbus driver over a serial line (RTU): unlike in Modbus/TCP, answers do not name their request."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from pymodbus.client import ModbusSerialClient
from pymodbus.framer import FramerRTU

from drivers.transports.base.ports import open_port, parse_port, serial_endpoints
from drivers.transports.modbus.driver import MakeClient, ModbusDriver
from drivers.transports.modbus.link import Client
from drivers.wire.serial import frame_time

_FRAMES_IN_WATCHDOG = 3
_EXCHANGE = 8 + 255  # bytes of the longest request and its answer
_TOGETHER = 4  # bytes: silence for their duration ends the answer
_PAUSE = 0.001  # s, at least
_REST = 0.1  # s: what has not come of an answer by then, once it has begun, was damaged


class _RtuClient(ModbusSerialClient):
    """Waits by a monotonic clock; the library uses the wall clock."""

    _begun = False  # the answer

    def send(self, request: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Send a request."""
        self._begun = False
        return super().send(request, addr)

    def recv(self, size: int | None) -> bytes:
        """Received bytes once no more follow; empty if none come within the timeout."""
        port = self.socket
        assert port is not None  # it was written to just now
        limit = self.comm_params.timeout_connect
        until = time.monotonic() + (min(limit, _REST) if self._begun else limit)
        pause = max(_PAUSE, frame_time(self.comm_params.baudrate, _TOGETHER))
        came, before = 0, 0
        while time.monotonic() < until and (came == 0 or came != before):
            time.sleep(pause)
            before, came = came, port.in_waiting
        self._begun = came > 0
        return bytes(port.read(came))


class RtuDriver(ModbusDriver):
    """`drivers.protocol.Driver` over Modbus RTU; the address is `port,baud,rtu`."""

    def __init__(self, address: str, **options: Any) -> None:
        super().__init__(address, **options)
        self._watchdog = max(self._watchdog, _FRAMES_IN_WATCHDOG * frame_time(self._port.baud, _EXCHANGE))

    def endpoints(self) -> tuple[str, ...]:
        """`NamesEndpoints`."""
        return serial_endpoints(self._port.port)

    def _check_address(self, address: str) -> None:
        self._port = parse_port(address)

    def _make_client(self) -> MakeClient:
        port = open_port(self._port, self._timeout)
        request = b""

        def make(trace: Callable[[bool, bytes], bytes]) -> Client:
            def pass_on(sending: bool, data: bytes) -> bytes:
                nonlocal request
                data = trace(sending, data)
                if sending:
                    request = data
                return data if sending else without_strays(request, data)

            client = _RtuClient(
                self._port.port, baudrate=self._port.baud, timeout=self._timeout, retries=0, trace_packet=pass_on
            )
            port.inter_byte_timeout = client.inter_byte_timeout
            client.socket = port
            return client

        return make


_READ, _WRITE = 3, 16
_WRITTEN = 8  # bytes of the answer to a write: unit, function, address, count, checksum


def without_strays(request: bytes, data: bytes) -> bytes:
    """What has come of the answer to a request, without whole answers before it that belong to earlier ones.

    An answer that comes late or twice would be taken for the next one. Whatever is no whole answer is left as it is.
    """
    while (size := _answer_size(data)) and size <= len(data) and not _belongs(request, data):
        frame, rest = data[:size], data[size:]
        if not FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big")):
            break
        data = rest
    return data


def _answer_size(data: bytes) -> int:
    """Bytes of the answer that begins here; 0 where none does that is known here."""
    if len(data) < 3:
        return 0
    return {_READ: 5 + data[2], _WRITE: _WRITTEN}.get(data[1], 0)


def _belongs(request: bytes, answer: bytes) -> bool:
    if request[:2] != answer[:2]:
        return False
    if request[1] == _READ:
        return answer[2] == 2 * int.from_bytes(request[4:6], "big")
    return request[2:6] == answer[2:6]
