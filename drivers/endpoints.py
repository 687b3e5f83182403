"""Canonical form of an address, so that two runs at one controller share a lock."""

from __future__ import annotations

from drivers.errors import ConfigurationError
from drivers.protocol import NamesEndpoints
from drivers.registry import create
from drivers.transports.base.ports import parse_address, socket_endpoints


def endpoints(driver: str, address: str) -> tuple[str, ...]:
    """Sorted texts; two addresses have one in common where they lead to the same device or port of a host.

    They are what the driver says (`NamesEndpoints`), or the port of an address that begins with `host:port`.
    """
    try:
        made = create(driver, address)
        if isinstance(made, NamesEndpoints):
            return made.endpoints()
        socket, comma, options = address.partition(",")
        return tuple(f"{endpoint}{comma}{options}" for endpoint in socket_endpoints(*parse_address(socket.strip())))
    except ConfigurationError:  # an address that no driver takes, or that this one refuses
        return (f"{driver}|{address}",)
