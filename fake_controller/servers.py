"""Servers by the name of the driver they are for."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from fake_controller.controller import Controller

DRIVERS = ("tcp", "modbus", "serial", "rtu")


class Server(Protocol):
    """`address` is what the driver of the same name takes."""

    address: str

    def close(self) -> None:
        """Bring the arm to rest and stop serving."""


class _OnCable:
    """A serial server with a cable of its own, for machines without a serial port."""

    def __init__(self, protocol: str, controller: Controller, baud: int, watchdog: float, waits: bool) -> None:
        from fake_controller.cable import Cable

        with contextlib.ExitStack() as undo:
            cable = Cable(baud)
            undo.callback(cable.close)
            server = _on_port(protocol, controller, cable.near, baud, watchdog, waits)
            undo.callback(server.close)
            self._undo = undo.pop_all()
        self.address = ",".join([cable.far, str(baud), *(["rtu"] if protocol == "rtu" else [])])

    def close(self) -> None:
        """Bring the arm to rest, stop serving, and take the cable away."""
        self._undo.close()


def open_server(
    driver: str,
    controller: Controller,
    address: str,
    port: int,
    watchdog: float,
    waits: bool,
    baud: int,
    serial_port: str | None,
) -> Server:
    """A server that is open.

    Args:
        driver: one of `DRIVERS`.
        controller: what is served.
        address, port: where to listen, for `tcp` and `modbus`.
        watchdog: the shortest [s] that a client is granted.
        waits: the arm waits for a client that reads too slowly, as only an emulated one can.
        baud, serial_port: the line, for `serial` and `rtu`; without a port a cable of pseudo-terminals is made.

    Raises:
        OSError: the port is taken, or is not this machine's.
    """
    if driver == "tcp":
        from fake_controller.server_tcp import TcpServer

        return TcpServer(controller, address, port, watchdog)
    if driver == "modbus":
        from fake_controller.server_modbus import ModbusServer

        return ModbusServer(controller, address, port, watchdog, waits=waits)
    if serial_port is None:
        return _OnCable(driver, controller, baud, watchdog, waits)
    return _on_port(driver, controller, serial_port, baud, watchdog, waits)


def _on_port(protocol: str, controller: Controller, port: str, baud: int, watchdog: float, waits: bool) -> Server:
    if protocol == "rtu":
        from fake_controller.server_modbus import ModbusRtuServer

        return ModbusRtuServer(controller, port, baud, watchdog, waits=waits)
    from fake_controller.server_serial import SerialServer

    return SerialServer(controller, port, baud, watchdog, waits=waits)
