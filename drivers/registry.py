"""Drivers by name: those of `_BUILT_IN`, and what others install under the entry point group below.

A driver is loaded when it is asked for. One that cannot be loaded is reported and left out.
"""

from __future__ import annotations

import importlib
import logging
from collections.abc import Callable
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from drivers.errors import ConfigurationError
from drivers.protocol import Driver
from drivers.secrets import refuse_in_address

if TYPE_CHECKING:
    from drivers.transports.ros2.watch import RosWatch

GROUP = "calibration_agent.drivers"

_BUILT_IN = {
    "tcp": "drivers.transports.tcp.driver:TcpDriver",
    "modbus": "drivers.transports.modbus.driver:ModbusDriver",
    "cnr_comau": "drivers.transports.cnr.driver:create",
    "ur": "drivers.transports.ur.driver:UrDriver",
    "ros2": "drivers.transports.ros2.driver:Ros2Driver",
}

_log = logging.getLogger(__name__)


def available() -> tuple[str, ...]:
    """Names of all drivers there are, sorted; none is loaded for that."""
    return tuple(sorted({*_BUILT_IN, *(point.name for point in entry_points(group=GROUP))}))


def create(name: str, address: str, **options: object) -> Driver:
    """A driver for the controller at `address`; not connected yet.

    Raises:
        ConfigurationError: no such driver, or one that cannot be loaded (the message lists the others), or an
            address that this driver cannot use, or that holds a password.
    """
    refuse_in_address(str(address))
    factory = _load(name)
    if factory is None:
        others = ", ".join(other for other in available() if other != name)
        raise ConfigurationError(f"there is no driver {name!r}; there are: {others}")
    driver = factory(address, **options)
    if missing := sorted(method for method in set(vars(Driver)) - set(dir(driver)) if not method.startswith("_")):
        raise ConfigurationError(f"driver {name!r} lacks a method of drivers.protocol.Driver: {', '.join(missing)}")
    return driver


def watch(address: str, tell: Callable[[str], None]) -> RosWatch:
    """What listens to the arm at `address` while somebody else moves it; not open yet.

    Raises:
        ConfigurationError: no address of ROS 2, or nothing here that can listen.
        DriverError: its network cannot be joined.
    """
    refuse_in_address(address)
    from drivers.transports.ros2.watch import RosWatch

    return RosWatch(address, tell)


def dialect(name: str) -> str:
    """Name of the program language that a driver's controllers take: its `dialect`, PDL2 where it declares none."""
    return getattr(_load(name), "dialect", "pdl2")


def efforts(name: str) -> tuple[str, ...]:
    """What a recipe may say that a driver's controllers report as effort; empty where the wire leaves no choice."""
    return tuple(getattr(_load(name), "efforts", ()))


def _load(name: str) -> Callable[..., Driver] | None:
    if name in _BUILT_IN:
        module, _, attribute = _BUILT_IN[name].partition(":")
        return getattr(importlib.import_module(module), attribute)
    for point in entry_points(group=GROUP, name=name):
        try:
            return point.load()
        except Exception as error:  # whatever a stranger's module does when it is imported
            _log.warning("driver %r (%s) cannot be loaded and is left out: %s", point.name, point.value, error)
    return None
