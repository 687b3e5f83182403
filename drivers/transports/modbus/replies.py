"""What the registers say, as the driver protocol has it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from drivers.protocol import Identity, Status
from drivers.wire import modbus as wire


def identity_of(identity: dict[str, Any], names: Iterable[str]) -> Identity:
    """From the values of the identity block, and the names of the joints."""
    return Identity(
        robot=identity["robot"],
        serial=identity["serial"],
        controller=identity["controller"],
        version=identity["software"],
        joint_names=tuple(names),
        period=identity["period"] * 1e-9,
    )


def status_of(values: dict[str, Any], alarms: Sequence[str], joints: int) -> Status:
    """From the values of the status block, the lines of the alarm block, and the number of joints."""
    flags = wire.Flag(values["flags"])
    return Status(
        drives_on=wire.Flag.DRIVES_ON in flags,
        mode=next((name for name, code in wire.MODES.items() if code == values["mode"]), "unknown"),
        emergency_stop=wire.Flag.EMERGENCY_STOP in flags,
        # More alarms than fit are alarms all the same.
        alarms=tuple(alarms) or (("unnamed",) if values["alarms"] else ()),
        override=values["override"],
        cell_closed=wire.Flag.CELL_CLOSED in flags,
        moving=wire.Flag.MOVING in flags,
        program=values["program"],
        checksum=values["checksum"].hex() if values["program"] else "",
        position=np.array(values["position"][:joints]),
        emulator=wire.Flag.EMULATOR in flags,
    )
