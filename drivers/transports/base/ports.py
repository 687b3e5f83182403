"""Network ports and serial ports: their addresses, how they are opened, and how two are distinguished."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import re
import socket
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import serial

from drivers.errors import ConfigurationError, DriverError
from drivers.texts import place_of

BAUD = 115_200
PROTOCOLS = ("frames", "rtu")

_RATE = re.compile(r"[1-9][0-9]{2,7}")


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


@dataclass(frozen=True)
class PortAddress:
    """`port[,baud[,protocol]]`: the port as pyserial names it, bits per second, `frames` or `rtu`."""

    port: str
    baud: int
    protocol: str


def parse_port(address: str) -> PortAddress:
    """An address like `/dev/ttyUSB0`, `/dev/ttyUSB0,921600` or `COM3,115200,rtu`.

    Raises:
        ConfigurationError: anything else.
    """
    port, *rest = (part.strip() for part in str(address).split(","))
    baud, protocol = [*rest, *(str(BAUD), PROTOCOLS[0])[len(rest) :]][:2] if len(rest) < 3 else ("", "")
    if not port or not _RATE.fullmatch(baud) or protocol not in PROTOCOLS:
        raise ConfigurationError(
            f"address {place_of(address)!r}: port,baud,protocol is expected, like /dev/ttyUSB0,921600 or "
            "/dev/ttyUSB0,115200,rtu"
        )
    return PortAddress(port, int(baud), protocol)


def open_port(address: PortAddress, timeout: float) -> serial.SerialBase:
    """The port, ours alone, with nothing old in its buffers.

    Raises:
        DriverError: there is none, or somebody has it.
    """
    place = place_of(address.port)
    try:
        port = serial.serial_for_url(
            address.port, baudrate=address.baud, timeout=timeout, write_timeout=timeout, exclusive=True
        )
        port.reset_input_buffer()
    except (serial.SerialException, OSError, ValueError) as error:
        if "exclusively lock" in str(error) or getattr(error, "errno", None) in (11, 16):
            raise DriverError(f"{place} is busy: another program has the serial port; close it first") from None
        reason = str(getattr(error, "strerror", None) or error)
        if place != address.port:  # the library repeats what it does not know
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else "it cannot be opened"
        raise DriverError(
            f"no controller at {place}: {reason}; is the adapter plugged in, is its name right?"
        ) from None
    return port


class SerialChannel:
    """`drivers.transports.frames.driver.Channel` over a serial port."""

    def __init__(self, port: serial.Serial) -> None:
        self._port = port
        self._open = True

    def fileno(self) -> int:
        """For a selector to wait on."""
        return self._port.fileno()

    def recv(self, size: int) -> bytes:
        """Received bytes; called when there are some."""
        if not self._open:
            return b""
        try:
            return self._port.read(max(1, min(size, self._port.in_waiting)))
        except serial.SerialException as error:
            raise OSError(None, str(error)) from None

    def sendall(self, data: bytes) -> None:
        """Send, or raise TimeoutError where the line takes nothing any more."""
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            raise TimeoutError from None
        except serial.SerialException as error:
            raise OSError(None, str(error)) from None

    def shutdown(self, how: int) -> None:
        """Stop receiving."""
        self._open = False
        with contextlib.suppress(OSError, AttributeError):
            self._port.cancel_write()

    def close(self) -> None:
        """Give the port back."""
        with contextlib.suppress(OSError):
            self._port.close()


def socket_endpoints(host: str, port: int) -> tuple[str, ...]:
    """Of a port. A host is known by its IP addresses, and this machine by one name."""
    return tuple(sorted(set(_ports(host, port))))


def serial_endpoints(port: str) -> tuple[str, ...]:
    """Of a serial port as pyserial names it: a device, or a URL of one or of an adapter in the network."""
    return tuple(sorted(set(_line(port))))


def _ports(host: str, port: int) -> Iterator[str]:
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        yield f"{host.lower()}:{port}"
        return
    for family, _, _, _, place in found:
        yield f"{'this machine' if _is_here(family, place) else place[0]}:{port}"


def _is_here(family: int, place: tuple[Any, ...]) -> bool:
    """Whether an IP address is one of this machine's: nobody can listen at another's."""
    if ipaddress.ip_address(str(place[0]).partition("%")[0]).is_loopback:
        return True
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((place[0], 0, *place[2:]))
    except OSError:
        return False
    return True


def _line(port: str) -> Iterator[str]:
    scheme, url, rest = port.lower().rpartition("://")
    where = re.fullmatch(r"\[?(.*?)\]?:(\d+)", re.split("[/?]", rest, maxsplit=1)[0])
    if not url:
        yield _device(port)
    elif scheme in ("socket", "rfc2217") and where is not None:
        yield from _ports(where[1], int(where[2]))
    else:
        yield _device(port[-len(rest) :].partition("?")[0]) if scheme in ("spy", "alt") else f"port|{port}"


def _device(port: str) -> str:
    path = os.path.realpath(port)
    try:
        about = os.stat(path)
    except OSError:
        return f"port|{path if os.sep in port else port}"
    return f"device|{about.st_rdev}" if stat.S_ISCHR(about.st_mode) else f"port|{path}"
