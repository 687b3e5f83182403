"""A serial port: its address, opening it, and what it can carry."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass

import serial

from drivers.errors import ConfigurationError, DriverError
from drivers.texts import place_of

BAUD = 115_200
PROTOCOLS = ("frames", "rtu")

_RATE = re.compile(r"[1-9][0-9]{2,7}")


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
    """`drivers.transports.frame_link.Channel` over a serial port."""

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
