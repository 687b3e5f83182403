"""The Modbus/TCP server; the map is in docs/wire-modbus.md."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import threading
from typing import Any

from pymodbus.framer import FramerType
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import SimDevice

from drivers.wire.modbus import HEARTBEAT
from fake_controller.controller import Controller
from fake_controller.faults import Faults
from fake_controller.servers.base import listening_socket, name_of
from fake_controller.servers.modbus.registers import MEMORY, RegisterMap

MAX_CONNECTIONS = 8
MAX_WAITING = 4096  # bytes of requests of one client that are not carried out yet

# The library's own complaints about what clients send belong in no terminal.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class ModbusServer:
    """Serves the registers of one controller; a thread of its own does it.

    Arguments and errors as of `open_server`, and `memory`: samples kept.
    """

    def __init__(
        self,
        controller: Controller,
        address: str = "127.0.0.1",
        port: int = 0,
        watchdog: float = 0.05,
        memory: int = MEMORY,
        waits: bool = False,
    ) -> None:
        self.controller, self._faults, self._where = controller, controller.faults, (address, port)
        self.registers = RegisterMap(controller, watchdog, memory, waits)
        self._server: _TcpServer | None = None
        self._failure: OSError | None = None
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(started)), name="modbus", daemon=True)
        self._thread.start()
        started.wait()
        if self._failure is not None:
            self.registers.close()
            raise self._failure
        controller.when_restarting.append(self.drop_clients)

    def close(self) -> None:
        """Bring the arm to rest and stop listening."""
        self.registers.close()
        self._loop.call_soon_threadsafe(self._done.set)
        self._thread.join(10.0)

    def drop_clients(self) -> None:
        """Cut every connection, as a pulled cable does."""
        self._loop.call_soon_threadsafe(self._drop)

    async def _serve(self, started: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(lambda *_: None)  # a client's nonsense ends its connection, nothing else
        self._done = asyncio.Event()
        deaf = None
        try:
            if self._faults.refusing:
                deaf = listening_socket(*self._where, deaf=True)
                where = deaf.getsockname()
            else:
                self._server = _TcpServer(
                    self.registers.device(), self._faults, framer=FramerType.SOCKET, address=self._where
                )
                if not await self._server.listen():
                    raise OSError(errno.EADDRINUSE, "address cannot be used")
                where = self._server.transport.sockets[0].getsockname()  # type: ignore[attr-defined]
            self.port, self.address = where[1], name_of(where)
        except OSError as error:
            self._failure = error
            return
        finally:
            started.set()
        await self._done.wait()
        self._drop()
        if self._server is not None:
            await self._server.shutdown()
        if deaf is not None:
            deaf.close()

    def _drop(self) -> None:
        if self._server is not None:
            for client in list(self._server.active_connections.values()):
                client.close()


class _Connection(ServerRequestHandler):
    """One client; what it is sent and what it says goes through the faults of the wire.

    Carries out one request after the other; of those that come before it has answered, the library forgets some.
    """

    _waiting = b""

    def __init__(self, server: ModbusTcpServer, faults: Faults) -> None:
        super().__init__(server, None, None, None)
        self._faults = faults

    def send(self, data: bytes, addr: tuple[Any, ...] | None = None) -> None:
        """Called by the library with a whole answer. A delay holds up the loop: there is nobody else to serve."""
        # The answer to a heartbeat holds nothing.
        spare = getattr(self.last_pdu, "address", None) == HEARTBEAT.address
        with contextlib.suppress(ConnectionResetError):
            self._faults.send(data, super().send, self.close, spare)

    def data_received(self, data: bytes) -> None:
        """Called by the library with whatever came."""
        self._waiting += self._faults.heard(data)
        if len(self._waiting) > MAX_WAITING:
            self.close()
            return
        self._take_up()

    async def handle_request(self) -> None:
        """Called by the library to answer `last_pdu`."""
        await super().handle_request()
        self.last_pdu = None
        self._take_up()

    def _take_up(self) -> None:
        """Have the library read the next request, if there is a whole one and none is being carried out."""
        size = self.max_buffer_size
        while self._waiting and self.last_pdu is None:
            before = len(self._waiting)
            super().data_received(self._waiting[:size])
            self._waiting, self.recv_buffer = self.recv_buffer + self._waiting[size:], b""
            if len(self._waiting) == before:
                return


class _TcpServer(ModbusTcpServer):
    """With a limit on connections: one too many is closed at once."""

    def __init__(self, device: SimDevice, faults: Faults, **options: Any) -> None:
        super().__init__(device, **options)
        self._faults = faults

    def callback_new_connection(self) -> _Connection:
        """Called by the library."""
        connection = _Connection(self, self._faults)
        if len(self.active_connections) >= MAX_CONNECTIONS:
            # Its transport comes with the next turn of the loop; there is nothing to close before that.
            self.loop.call_soon(lambda: self.loop.call_soon(connection.close))
        else:
            self._faults.heal()
        return connection
