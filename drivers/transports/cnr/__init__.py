"""The driver for a COMAU controller with CNR's open programs; docs/real-robot.md says what has to be there."""

from __future__ import annotations

from typing import Any

from drivers.transports.cnr.address import parse_address
from drivers.transports.cnr.driver import CnrDriver
from drivers.transports.cnr.points import PointDriver

__all__ = ["create"]


def create(address: str, **options: Any) -> CnrDriver:
    """The driver for an address of `drivers.transports.cnr.address`; a `PointDriver` where it says `mode=points`.

    Raises:
        ConfigurationError: not an address.
    """
    parsed = parse_address(address)
    if parsed.points:
        return PointDriver(parsed, **options)
    return CnrDriver(parsed, **options)
