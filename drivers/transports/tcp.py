"""The binary TCP driver. The wire is in docs/wire-tcp.md."""

from __future__ import annotations

import socket
from typing import Any

from drivers.errors import ConfigurationError, DriverError
from drivers.texts import place_of
from drivers.transports.frame_link import FrameLink
from drivers.transports.frames import FrameDriver
from drivers.wire.tcp import MAX_REPLY_PAYLOAD, FrameDecoder, decode


class TcpDriver(FrameDriver):
    """`drivers.protocol.Driver` over the binary TCP link; the address is `host:port`.

    Raises:
        ConfigurationError: not an address.
    """

    def __init__(self, address: str, **options: Any) -> None:
        parse_address(address)
        super().__init__(address, **options)

    def _channel_link(self) -> FrameLink:
        connection = open_socket(self.address, self._timeout)
        connection.settimeout(self._timeout)
        return self._link_over(connection, self.address, FrameDecoder(MAX_REPLY_PAYLOAD), decode)


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of `host:port`, `[IPv6]:port` included.

    Raises:
        ConfigurationError: anything else.
    """
    host, separator, port = str(address).rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    place = place_of(address)
    numbered = separator and host and port.isascii() and port.isdigit() and 0 < int(port) < 65536
    if not numbered or place != address:
        raise ConfigurationError(f"address {place!r}: host:port is expected, like 192.168.0.10:9100")
    return host, int(port)


def open_socket(address: str, timeout: float) -> socket.socket:
    """A connected socket.

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
