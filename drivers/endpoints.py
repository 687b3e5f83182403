"""Canonical form of an address, so that two runs at one controller share a lock."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
import stat
from collections.abc import Iterator
from typing import Any

from drivers.errors import ConfigurationError
from drivers.registry import available


def endpoints(driver: str, address: str) -> tuple[str, ...]:
    """Sorted texts; two addresses have one in common where they lead to the same device or port of a host.

    A host is known by its IP addresses, and this machine by one name; a serial port by its device.
    """
    from drivers.transports.cnr.address import parse_address as parse_cnr
    from drivers.transports.serial_port import parse_port
    from drivers.transports.tcp import parse_address
    from drivers.transports.ur.driver import places

    head, _, options = address.partition(",")
    try:
        if driver == "serial":
            return tuple(sorted(set(_line(parse_port(address).port))))
        if driver == "cnr_comau":
            where = parse_cnr(address)
            return tuple(sorted(set(_ports(where.host, where.trajectory))))
        if driver == "ur":
            return tuple(sorted(set(_ports(*parse_address(places(address)["primary"])))))
        if driver in available():
            host, port = parse_address(head.strip()) if ":" in head else (head.strip(), 0)
            return tuple(sorted({f"{one}{options and ','}{options}" for one in _ports(host, port)}))
    except ConfigurationError:  # an address that the driver itself refuses
        pass
    return (f"{driver}|{address}",)


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
    """Of a serial port as pyserial names it: a device, or a URL of one or of an adapter in the network."""
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
