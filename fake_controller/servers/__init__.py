"""Servers by the name of the wire they speak."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from fake_controller.faults import LASTING, check_wire
from fake_controller.servers.base import BROKER, NoBrokerError, Server

if TYPE_CHECKING:
    from fake_controller.controller import Controller

__all__ = ["BROKER", "IMPOSSIBLE", "WIRES", "NoBrokerError", "Server", "open_server"]

#: Wires by name, with the name of the driver that speaks each.
WIRES = {"tcp": "tcp", "modbus": "modbus", "serial": "serial", "rtu": "serial", "cnr_comau": "cnr_comau"}
_NO_BROKER = dict.fromkeys(LASTING, "samples come by no broker there, points in no queue")
_ONE_ANSWER = "it sends one answer at a time, so none can overtake another"
_REGISTERS = {**_NO_BROKER, "columns": "its registers have their number of joints", "reorder": _ONE_ANSWER}
#: Faults that make no sense on a wire, and why.
IMPOSSIBLE = {
    "tcp": _NO_BROKER,
    "modbus": _REGISTERS,
    "serial": {**_NO_BROKER, "columns": "it packs samples anew, by its number of joints"},
    "rtu": _REGISTERS,
    "cnr_comau": {
        "columns": "its messages have ten axes",
        "clock_back": "its node counts time by itself",
        "no_numbers": "a message without numbers is damage there, as if it was lost",
        "reorder": _ONE_ANSWER,
    },
}


class _OnCable:
    """A server with a cable of its own, for machines without a serial port; both end together."""

    def __init__(self, address: str, undo: ExitStack) -> None:
        self.address, self.close = address, undo.close


def open_server(
    wire: str,
    controller: Controller,
    address: str = "127.0.0.1",
    port: int = 0,
    watchdog: float = 0.05,
    waits: bool = False,
    baud: int = 4_000_000,
    serial_port: str | None = None,
    broker: tuple[str, int] = BROKER,
    node_period: float | None = None,
) -> Server:
    """A server that is open.

    Args:
        wire: one of `WIRES`.
        controller: what is served.
        address, port: where to listen, but for `serial` and `rtu`; port 0 takes a free one.
        watchdog: the shortest [s] that a client is granted; a client that is silent for it is taken for gone.
        waits: the arm waits for a client that reads too slowly, as only an emulated one can, before samples are lost.
        baud, serial_port: the line, for `serial` and `rtu`; without a port a cable of pseudo-terminals is made.
        broker: host and port, for `cnr_comau`.
        node_period: [s] of the loop in which the C5G Open node publishes, as the published one does; by default every
            sample comes once, at the controller's own time.

    Raises:
        OSError: the port is taken, or is not this machine's; a `NoBrokerError` where no broker answers.
        ValueError: a fault of the controller makes no sense on this wire.
    """
    check_wire(controller.faults.waiting, wire, IMPOSSIBLE[wire])
    if wire == "tcp":
        from fake_controller.servers.tcp import TcpServer

        return TcpServer(controller, address, port, watchdog)
    if wire == "modbus":
        from fake_controller.servers.modbus.server import ModbusServer

        return ModbusServer(controller, address, port, watchdog, waits=waits)
    if wire == "cnr_comau":
        from fake_controller.servers.cnr.server import CnrServer

        return CnrServer(controller, address, port, watchdog, broker, waits, node_period)
    if serial_port is not None:
        return _on_port(wire, controller, serial_port, baud, watchdog, waits)
    from fake_controller.servers.cable import Cable

    with ExitStack() as undo:
        cable = Cable(baud)
        undo.callback(cable.close)
        undo.callback(_on_port(wire, controller, cable.near, baud, watchdog, waits).close)
        return _OnCable(f"{cable.far},{baud}" + ",rtu" * (wire == "rtu"), undo.pop_all())


def _on_port(wire: str, controller: Controller, port: str, baud: int, watchdog: float, waits: bool) -> Server:
    if wire == "rtu":
        from fake_controller.servers.modbus.server import ModbusRtuServer

        return ModbusRtuServer(controller, port, baud, watchdog, waits=waits)
    from fake_controller.servers.serial import SerialServer

    return SerialServer(controller, port, baud, watchdog, waits=waits)
