"""What servers answer out of a controller, and the programs they take in."""

from __future__ import annotations

import hashlib

from drivers.wire.reasons import Refusal
from drivers.wire.tcp import IdentityReply, StatusReply
from fake_controller.controller import CONTROLLER, PERIOD, VERSION as CONTROLLER_VERSION, Controller
from fake_controller.programs import RefusedRequest


class Upload:
    """A program on its way in; `checksum` is the SHA-256 (hex) that was announced."""

    def __init__(self, name: str, size: int, checksum: str) -> None:
        self.name = name
        self._size = size
        self._checksum = checksum.lower()
        self._data = bytearray()

    def add(self, offset: int, data: bytes) -> None:
        """Take the next block.

        Raises:
            RefusedRequest: it is not the next, or too much.
        """
        if offset != len(self._data):
            raise RefusedRequest(Refusal.BAD_REQUEST, f"a block for byte {offset}, where {len(self._data)} comes next")
        if offset + len(data) > self._size:
            raise RefusedRequest(Refusal.TOO_LARGE, f"more than the {self._size} bytes that were announced")
        self._data += data

    def complete(self) -> bytes:
        """All of it.

        Raises:
            RefusedRequest: something is missing or damaged.
        """
        if len(self._data) != self._size:
            raise RefusedRequest(Refusal.BAD_REQUEST, f"{len(self._data)} of {self._size} bytes came")
        if hashlib.sha256(self._data).hexdigest() != self._checksum:
            raise RefusedRequest(Refusal.CHECKSUM, "the bytes that came are not those of the checksum; send them again")
        return bytes(self._data)


def identity_reply(controller: Controller) -> IdentityReply:
    """Who the controller is."""
    robot = controller.robot
    return IdentityReply(controller.name, controller.serial, CONTROLLER, CONTROLLER_VERSION, robot.joint_names, PERIOD)


def status_reply(controller: Controller) -> StatusReply:
    """How it is."""
    name, checksum = controller.stored
    return StatusReply(
        **vars(controller.state),
        moving=controller.moving,
        program=name,
        checksum=checksum,
        position=tuple(controller.position),
    )
