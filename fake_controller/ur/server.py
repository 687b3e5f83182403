"""All published ports of one UR controller, on one address."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

from fake_controller.servers.base import accepted, listening_socket
from fake_controller.ur.cell import UrCell
from fake_controller.ur.ports import DashboardConnection, ScriptConnection, UrConnection
from fake_controller.ur.rtde import RtdeConnection

DASHBOARD, PRIMARY, SECONDARY, REALTIME, RTDE = 29999, 30001, 30002, 30003, 30004
_MOST = 64  # clients


class UrServer:
    """Listens at `address`, where unmodified clients look for a robot. PolyScope X (10.x) has no dashboard.

    Raises:
        OSError: a port is taken, or the address is not this machine's.
    """

    def __init__(self, cell: UrCell, address: str = "127.0.0.1") -> None:
        self.cell, self.address = cell, address
        self._owners: dict[str, RtdeConnection] = {}
        self._clients: dict[UrConnection, threading.Thread] = {}
        self._closing = threading.Event()
        kinds: dict[int, Callable[[socket.socket], UrConnection]] = {
            PRIMARY: lambda connection: ScriptConnection(cell, connection, realtime=False),
            SECONDARY: lambda connection: ScriptConnection(cell, connection, realtime=False),
            REALTIME: lambda connection: ScriptConnection(cell, connection, realtime=True),
            RTDE: lambda connection: RtdeConnection(cell, connection, self._owners),
        }
        if cell.version[0] < 10:
            kinds[DASHBOARD] = lambda connection: DashboardConnection(cell, connection)
        deaf = cell.faults.refusing
        with contextlib.ExitStack() as undo:
            self._listeners = [
                undo.enter_context(contextlib.closing(listening_socket(address, port, deaf))) for port in kinds
            ]
            undo.pop_all()
        pairs = zip(self._listeners, kinds.values(), strict=True)
        self._threads = [threading.Thread(target=self._accept, args=pair, daemon=True) for pair in pairs]
        for thread in [] if deaf else self._threads:
            thread.start()
        cell.when_cut.append(self.drop_clients)

    def close(self) -> None:
        """Bring the arm to rest and stop listening."""
        self._closing.set()
        self.cell.shut_down()
        for listener in self._listeners:
            with contextlib.suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
        threads = list(self._clients.values())
        self.drop_clients()
        for thread in [*threads, *self._threads]:
            if thread.is_alive():
                thread.join(5.0)

    def drop_clients(self) -> None:
        """Cut every connection."""
        for client in list(self._clients):
            client.close()

    def _accept(self, listener: socket.socket, kind: Callable[[socket.socket], UrConnection]) -> None:
        for connection in accepted(listener, self._closing):
            self._clients = {client: thread for client, thread in self._clients.items() if not client.closed.is_set()}
            if len(self._clients) >= _MOST:
                connection.close()
                continue
            self.cell.faults.heal()
            client = kind(connection)
            thread = self._clients[client] = threading.Thread(target=client.serve, daemon=True)
            thread.start()
