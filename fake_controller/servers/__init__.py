"""Servers by the name of the wire they speak, which is that of its driver."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fake_controller.faults import LASTING, check_wire
from fake_controller.servers.base import BROKER, NoBrokerError, Server

if TYPE_CHECKING:
    from fake_controller.controller import Controller

__all__ = ["BROKER", "IMPOSSIBLE", "WIRES", "NoBrokerError", "Server", "open_server"]

_NO_BROKER = dict.fromkeys(LASTING, "samples come by no broker there, points in no queue")
_ONE_ANSWER = "it sends one answer at a time, so none can overtake another"
#: Faults that make no sense on a wire, and why.
IMPOSSIBLE = {
    "tcp": _NO_BROKER,
    "modbus": {**_NO_BROKER, "columns": "its registers have their number of joints", "reorder": _ONE_ANSWER},
    "cnr_comau": {
        "columns": "its messages have ten axes",
        "clock_back": "its node counts time by itself",
        "no_numbers": "a message without numbers is damage there, as if it was lost",
        "reorder": _ONE_ANSWER,
    },
}
WIRES = tuple(IMPOSSIBLE)


def open_server(
    wire: str,
    controller: Controller,
    address: str = "127.0.0.1",
    port: int = 0,
    watchdog: float = 0.05,
    waits: bool = False,
    broker: tuple[str, int] = BROKER,
    node_period: float | None = None,
) -> Server:
    """A server that is open.

    Args:
        wire: one of `WIRES`.
        controller: what is served.
        address, port: where to listen; port 0 takes a free one.
        watchdog: the shortest [s] that a client is granted; a client that is silent for it is taken for gone.
        waits: the arm waits for a client that reads too slowly, as only an emulated one can, before samples are lost.
        broker: host and port, for `cnr_comau`.
        node_period: [s] of the loop in which the C5G Open node publishes, as the published one does; by default every
            sample comes once, at the controller's own time.

    Raises:
        OSError: the port is taken, or is not this machine's; a `NoBrokerError` where no broker answers.
        ValueError: a fault of the controller makes no sense on this wire.
    """
    check_wire(controller.faults.waiting, wire, IMPOSSIBLE[wire])
    about = (controller, address, port, watchdog)
    if wire == "modbus":
        from fake_controller.servers.modbus.server import ModbusServer  # imports a web server: a third of a second

        return ModbusServer(*about, waits=waits)
    if wire == "cnr_comau":
        from fake_controller.servers.cnr.server import CnrServer

        return CnrServer(*about, waits=waits, broker=broker, node_period=node_period)
    from fake_controller.servers.tcp import TcpServer

    return TcpServer(*about)
