"""The Modbus servers, over TCP and over a serial line (RTU); the map is in docs/wire-modbus.md."""

from __future__ import annotations

import asyncio
import errno
import logging
import threading

from pymodbus.framer import FramerType
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.server.base import ModbusBaseServer

from fake_controller.controller import Controller
from fake_controller.registers import MEMORY, RegisterMap

MAX_CONNECTIONS = 8

# The library's own complaints about what clients send belong in no terminal.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())
logging.getLogger("pymodbus").propagate = False


class ModbusServer:
    """Serves the registers of one controller; a thread of its own does it.

    Args:
        controller: what is served.
        address, port: where to listen; port 0 takes a free one.
        watchdog: the shortest [s] that a client is granted.
        memory, waits: see `RegisterMap`.

    Raises:
        OSError: the port is taken, or the address is not this machine's.
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
        self._where = (address, port)
        self._run(controller, watchdog, memory, waits)

    def close(self) -> None:
        """Bring the arm to rest and stop listening."""
        self.registers.close()
        self._loop.call_soon_threadsafe(self._done.set)
        self._thread.join(10.0)

    def drop_clients(self) -> None:
        """Cut every connection, as a pulled cable does."""
        self._loop.call_soon_threadsafe(self._drop)

    def _run(self, controller: Controller, watchdog: float, memory: int, waits: bool) -> None:
        self.controller = controller
        self.registers = RegisterMap(controller, watchdog, memory, waits)
        controller.when_restarting.append(self.drop_clients)
        self._failure: OSError | None = None
        started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(started)), name="modbus", daemon=True)
        self._thread.start()
        started.wait()
        if self._failure is not None:
            self.registers.close()
            raise self._failure

    async def _serve(self, started: threading.Event) -> None:
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(lambda *_: None)  # a client's nonsense ends its connection, nothing else
        self._done = asyncio.Event()
        try:
            self._server = self._create()
            if not await self._server.listen():
                raise OSError(errno.EADDRINUSE, "address cannot be used")
            self._opened()
        except OSError as error:
            self._failure = error
            return
        finally:
            started.set()
        await self._done.wait()
        self._drop()
        await self._server.shutdown()

    def _create(self) -> ModbusBaseServer:
        return _TcpServer(self.registers.device(), framer=FramerType.SOCKET, address=self._where)

    def _opened(self) -> None:
        (host, self.port), *_ = (handle.getsockname()[:2] for handle in self._server.transport.sockets)
        self.address = f"[{host}]:{self.port}" if ":" in host else f"{host}:{self.port}"

    def _drop(self) -> None:
        for client in list(self._server.active_connections.values()):
            client.close()


class ModbusRtuServer(ModbusServer):
    """The same over a serial port: its name, and its baud rate.

    Raises:
        OSError: the port cannot be opened.
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
        self.address = port
        self._baud = baud
        self._run(controller, watchdog, memory, waits)

    def _create(self) -> ModbusBaseServer:
        return ModbusSerialServer(
            self.registers.device(), framer=FramerType.RTU, port=self.address, baudrate=self._baud
        )

    def _opened(self) -> None:
        pass


class _TcpServer(ModbusTcpServer):
    """With a limit on connections: one too many is closed at once."""

    def callback_new_connection(self):  # type: ignore[no-untyped-def]
        handler = super().callback_new_connection()
        if len(self.active_connections) >= MAX_CONNECTIONS:
            # Its transport comes with the next turn of the loop; there is nothing to close before that.
            self.loop.call_soon(self.loop.call_soon, handler.close)
        return handler
