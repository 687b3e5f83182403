"""Servers by the name of the wire they speak."""

from fake_controller.servers.base import BROKER, NoBrokerError, Server
from fake_controller.servers.by_wire import WIRES, open_server

__all__ = ["BROKER", "WIRES", "NoBrokerError", "Server", "open_server"]
