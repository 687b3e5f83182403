"""The address of a COMAU controller with CNR's open programs: its IP address, and what differs from the usual."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.errors import ConfigurationError
from drivers.secrets import ADVICE, check_source, refuse_in_address
from drivers.texts import public_address
from drivers.transports.base.ports import parse_address as parse_host_and_port
from drivers.wire import cnr as wire

FTP_PORT, BROKER_PORT = 21, 1883


@dataclass(frozen=True)
class CnrAddress:
    """Where everything is. `broker` is None where no C5G Open node publishes.

    The address names where passwords are stored; `drivers.secrets` reads them when the link is opened.
    `points`: via-points go through the socket instead of a program; `by_hand`: a person starts the program.
    """

    host: str
    trajectory: int = wire.TRAJECTORY_PORT
    feedback: int = wire.FEEDBACK_PORT
    status: int = wire.STATUS_PORT
    ftp: int = FTP_PORT
    user: str = "anonymous"
    password_from: str = ""
    folder: str = ""
    broker: tuple[str, int] | None = None
    topic: str = wire.TOPIC
    points: bool = False
    by_hand: bool = False
    broker_user: str = ""
    broker_password_from: str = ""


def parse_address(text: str) -> CnrAddress:
    """`host`, then options: `host,trajectory=1212,feedback=1213,status=1214,ftp=21,user=…,password_from=…,folder=…,
    mqtt=host:port (or none),mqtt_user=…,mqtt_password_from=…,topic=robot/arm1,mode=program (or points),
    start=socket (or hand)`, in any order.

    Without `mqtt` the broker is expected at the controller's own address.

    Raises:
        ConfigurationError: anything else; names what is allowed.
    """
    refuse_in_address(str(text))
    public = public_address(str(text))
    host, *options = (part.strip() for part in str(text).split(","))
    if not host or public_address(host) != host:
        raise ConfigurationError(f"address {public!r}: the controller's address comes first, like 192.168.0.10")
    values: dict[str, Any] = {"broker": (host, BROKER_PORT)}
    for number, option in enumerate(options, 1):
        key, equals, value = option.partition("=")
        if key not in _OPTIONS or not equals:
            raise ConfigurationError(
                f"address {public!r}: option {number} after the host is none of {', '.join(_OPTIONS)}; {ADVICE}"
            )
        field, read = _OPTIONS[key]
        try:
            values[field] = read(value)
        except ValueError as error:
            raise ConfigurationError(f"address {public!r}: {key}: {error}") from None
    if values.get("points") and values.get("by_hand"):
        raise ConfigurationError(f"address {public!r}: points are started by the socket; leave start=hand out")
    return CnrAddress(host, **values)


def _port(value: str) -> int:
    if not (value.isascii() and value.isdigit() and 0 < int(value) < 65536):
        raise ValueError("a port is expected, 1 to 65535")
    return int(value)


def _broker(value: str) -> tuple[str, int] | None:
    if value == "none":
        return None
    try:
        return parse_host_and_port(value if ":" in value else f"{value}:{BROKER_PORT}")
    except ConfigurationError:
        raise ValueError("host:port or none is expected") from None


def _one_of(*words: str) -> Callable[[str], bool]:
    def read(value: str) -> bool:
        if value not in words:
            raise ValueError(f"{' or '.join(words)} is expected")
        return value == words[1]

    return read


def _text(value: str) -> str:
    if not value:
        raise ValueError("a text is expected")
    return value


_OPTIONS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "trajectory": ("trajectory", _port),
    "feedback": ("feedback", _port),
    "status": ("status", _port),
    "ftp": ("ftp", _port),
    "user": ("user", _text),
    "password_from": ("password_from", check_source),
    "folder": ("folder", _text),
    "mqtt": ("broker", _broker),
    "mqtt_user": ("broker_user", _text),
    "mqtt_password_from": ("broker_password_from", check_source),
    "topic": ("topic", lambda value: _text(value).rstrip("/")),
    "mode": ("points", _one_of("program", "points")),
    "start": ("by_hand", _one_of("socket", "hand")),
}
