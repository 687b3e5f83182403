"""RTDE, protocol version 2, as bytes: what is asked of the controller, and its answers.

Big-endian. A package is uint16 size, header included, uint8 type, and the content (Universal Robots, "Real-Time Data
Exchange (RTDE) Guide").
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drivers.errors import ProtocolError, RefusedError
from drivers.texts import NAME, printable

VERSION, CONTROLLER, OUTPUTS, INPUTS, START, DATA, TEXT = b"VvOISUM"
#: Size and type of a package, its first bytes.
HEAD = struct.Struct(">HB")
_TYPES = {"DOUBLE": ">f8", "INT32": ">i4", "UINT32": ">u4", "UINT64": ">u8", "UINT8": "u1", "BOOL": "?"}
_TYPES |= {"VECTOR3D": "3>f8", "VECTOR6D": "6>f8", "VECTOR6INT32": "6>i4", "VECTOR6UINT32": "6>u4"}
#: Registers from 24 on belong to RTDE clients. Inputs: the heartbeat, and which program may move. Outputs: the cycle
#: that begins, and which program runs.
HEARTBEAT, PERMIT = "input_int_register_24", "input_int_register_25"
CYCLE, RUNNING = "output_int_register_24", "output_int_register_25"
#: What the driver reads of every sample.
FIELDS = (
    "timestamp",
    "actual_q",
    "actual_qd",
    "target_q",
    "target_qd",
    "actual_current",
    "joint_temperatures",
    "robot_mode",
    "safety_mode",
    "runtime_state",
    "target_speed_fraction",
    "tcp_offset",
    "payload",
    "payload_cog",
    CYCLE,
    RUNNING,
)
#: A further one of newer versions of PolyScope: inertia of the payload that is set [kg·m²].
INERTIA, INERTIA_SINCE = "payload_inertia", {3: (3, 15), 5: (5, 11)}
#: Torques, but without gravity and with the payload that is set taken out of them: no identification can use them.
COMPENSATED = "actual_current_as_torque"


def package(kind: int, content: bytes = b"") -> bytes:
    """A package of this type."""
    return HEAD.pack(HEAD.size + len(content), kind) + content


def output_request(names: Sequence[str], frequency: float) -> bytes:
    """Asks for these fields at this frequency [Hz].

    Raises:
        RefusedError: a field that is no measurement.
    """
    if COMPENSATED in names:
        raise RefusedError(
            f"{COMPENSATED} is the torque without gravity, and with the payload that is set taken out; a model "
            "identified from it would be wrong. Use actual_current"
        )
    return package(OUTPUTS, struct.pack(">d", frequency) + ",".join(names).encode())


@dataclass(frozen=True)
class OutputRecipe:
    """The id of an agreed set of fields, and how a sample of them is laid out."""

    number: int
    layout: np.dtype

    @classmethod
    def of(cls, names: Sequence[str], answer: bytes) -> OutputRecipe:
        """From the controller's answer to `output_request`.

        Raises:
            RefusedError: a field that this controller does not have; names it.
            ProtocolError: not such an answer.
        """
        types = _types(names, answer)
        if missing := [name for name, kind in zip(names, types, strict=True) if kind == "NOT_FOUND"]:
            raise RefusedError(
                f"the controller does not know {', '.join(missing)}; the driver needs PolyScope 5.6 or newer, of CB3 "
                "3.12.3 or newer"
            )
        for name, kind in zip(names, types, strict=True):
            if kind not in _TYPES:
                raise ProtocolError(f"RTDE: {name} has the unknown type {printable(kind, NAME)!r}")
        fields = [(name, _TYPES[kind]) for name, kind in zip(names, types, strict=True)]
        return cls(answer[0], np.dtype([("recipe", "u1"), *fields]))

    def samples(self, contents: Sequence[bytes]) -> np.ndarray:
        """(K,) structured samples of the contents of data packages; those of other recipes are left out.

        Raises:
            ProtocolError: a package of another length.
        """
        own = [content for content in contents if content[:1] == bytes([self.number])]
        if wrong := [content for content in own if len(content) != self.layout.itemsize]:
            raise ProtocolError(f"RTDE: a sample of {len(wrong[0])} bytes; {self.layout.itemsize} were agreed on")
        return np.frombuffer(b"".join(own), self.layout)


def input_recipe(names: Sequence[str], answer: bytes) -> int:
    """The id of agreed inputs.

    Raises:
        RefusedError: another client, or a fieldbus, writes one of them; or the controller has none.
    """
    types = _types(names, answer)
    for name, kind in zip(names, types, strict=True):
        if kind == "IN_USE":
            raise RefusedError(
                f"{name} is in use: another program drives this robot, or a fieldbus adapter is enabled there; end it, "
                "then run the command again"
            )
        if kind != "INT32":
            raise RefusedError(f"the controller has no {name} (it says {printable(kind, NAME)!r})")
    return answer[0]


def input_package(recipe: int, *values: int) -> bytes:
    """Writes integers (int32) into the inputs of a recipe."""
    return package(DATA, struct.pack(f">B{len(values)}i", recipe, *values))


def _types(names: Sequence[str], answer: bytes) -> list[str]:
    types = answer[1:].decode("latin-1").rstrip(",").split(",")
    if len(types) != len(names):
        raise ProtocolError(f"RTDE: the controller answered {len(names)} fields with {len(types)} types")
    return types
