"""Network ports: their addresses, how they are opened, and how two are distinguished."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Iterator
from typing import Any

from drivers.errors import ConfigurationError, DriverError
from drivers.texts import public_address


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of `host:port`, `[IPv6]:port` included.

    Raises:
        ConfigurationError: anything else.
    """
    host, separator, port = str(address).rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    public = public_address(address)
    numbered = separator and host and port.isascii() and port.isdigit() and 0 < int(port) < 65536
    if not numbered or public != address:
        raise ConfigurationError(f"address {public!r}: host:port is expected, like 192.168.0.10:9100")
    return host, int(port)


def open_socket(address: str, timeout: float) -> socket.socket:
    """A connected socket, whose operations take the timeout [s] at most.

    Raises:
        DriverError: nobody there.
        ConfigurationError: not an address.
    """
    host, port = parse_address(address)
    try:
        connection = socket.create_connection((host, port), timeout)
    except ConnectionRefusedError:
        raise DriverError(
            f"no controller answers at {address}: connection refused; is it on, is the address right?"
        ) from None
    except TimeoutError:
        raise DriverError(
            f"no controller answers at {address} within {timeout:g} s; is it on, is the address right, "
            "does a firewall stand between?"
        ) from None
    except (socket.gaierror, UnicodeError):
        raise DriverError(f"no controller at {address}: the host name {host!r} is not known; check it") from None
    except OSError as error:
        raise DriverError(f"no controller answers at {address}: {error.strerror or error}; check the network") from None
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def socket_endpoints(host: str, port: int) -> tuple[str, ...]:
    """Of a port. A host is known by its IP addresses, and this machine by one name."""
    return tuple(sorted(set(_ports(host, port))))


def _ports(host: str, port: int) -> Iterator[str]:
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        yield f"{host.lower()}:{port}"
        return
    for family, _, _, _, endpoint in addresses:
        yield f"{'this machine' if _is_here(family, endpoint) else endpoint[0]}:{port}"


def _is_here(family: int, endpoint: tuple[Any, ...]) -> bool:
    """Whether an IP address is one of this machine's: nobody can listen at another's."""
    if ipaddress.ip_address(str(endpoint[0]).partition("%")[0]).is_loopback:
        return True
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((endpoint[0], 0, *endpoint[2:]))
    except OSError:
        return False
    return True
