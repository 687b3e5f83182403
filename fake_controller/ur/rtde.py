"""Port 30004: recipes of fields, samples out, inputs in; version 2 of the protocol."""

from __future__ import annotations

import socket
import struct
from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire.stream import PackageDecoder
from fake_controller.ur.cell import UrCell
from fake_controller.ur.fields import Cycles, input_type, output_type, packed, register_of
from fake_controller.ur.ports import UrConnection

_LONGEST_NAMES = 2048  # bytes
_VERSION = 2


class RtdeConnection(UrConnection):
    """One client; `owners` says which client may write which input."""

    def __init__(self, cell: UrCell, connection: socket.socket, owners: dict[str, RtdeConnection]) -> None:
        super().__init__(cell, connection)
        self._owners = owners
        self._packages = PackageDecoder(struct.Struct(">HB"), 0xFFFF, "RTDE")
        self._outputs: list[str] | None = None
        self._layout: np.dtype[Any] = packed([])  # of a sample
        self._every = 1
        self._started = False
        self._inputs: dict[int, tuple[list[str], np.dtype[Any]]] = {}
        self._counted = 0

    def greet(self) -> None:
        self.cell.listeners.append(self)

    def leave(self) -> None:
        if self in self.cell.listeners:
            self.cell.listeners.remove(self)
        for name in [name for name, owner in self._owners.items() if owner is self]:
            del self._owners[name]

    def on_message(self, message: bytes) -> None:
        """Those are the primary interface's."""

    def hear(self, data: bytes) -> None:
        try:
            for kind, payload in self._packages.feed(data):
                self._take(chr(kind), payload)
        except ProtocolError:
            self.close()

    def _take(self, kind: str, payload: bytes) -> None:
        try:
            self._answer(kind, payload)
        except (struct.error, UnicodeDecodeError, ValueError):
            self._reply("M", _text("a package that makes no sense", 1))

    def _answer(self, kind: str, payload: bytes) -> None:
        match kind:
            case "V":
                (version,) = struct.unpack(">H", payload)
                self._reply("V", bytes([version == _VERSION]))
                self.cell.reach("connect")
            case "v":
                self._reply("v", struct.pack(">4I", *self.cell.version))
            case "O":
                self._set_up_outputs(payload)
            case "I":
                self._set_up_inputs(payload)
            case "S":
                # the other way round, a cell in no hurry could run through a program before its samples are sent
                self._started = self._outputs is not None
                self._reply("S", bytes([self._started]))
            case "P":
                self._started = False
                self._reply("P", b"\1")
            case "U":
                self._take_inputs(payload)
            case "M":
                pass  # for the log
            case _:
                self._reply("M", _text(f"there is no package of type {kind!r}", 1))

    def _set_up_outputs(self, payload: bytes) -> None:
        (asked,) = struct.unpack_from(">d", payload)
        frequency = min(asked or np.inf, 1 / self.cell.period)
        if not frequency > 0 or len(payload) - 8 > _LONGEST_NAMES:
            raise ValueError
        names = _names(payload[8:])
        types = [output_type(name, self.cell.version) for name in names]
        self._every = int(1 / self.cell.period / frequency + 1e-9)
        known = "NOT_FOUND" not in types and bool(names)
        self._outputs = names if known else None
        self._started = False
        if known:
            self._layout = np.dtype([("size", ">u2"), ("kind", "u1"), ("recipe", "u1"), ("values", packed(types))])
        self._reply("O", bytes([known]) + ",".join(types).encode())

    def _set_up_inputs(self, payload: bytes) -> None:
        names = _names(payload)
        types = [
            "IN_USE" if self._owners.get(name, self) is not self else input_type(name, self.cell.version)
            for name in names
        ]
        recipe = 0
        if not {"IN_USE", "NOT_FOUND"} & set(types) and names:
            recipe = len(self._inputs) + 1
            self._inputs[recipe] = names, packed(types)
            self._owners.update(dict.fromkeys(names, self))
        self._reply("I", bytes([recipe]) + ",".join(types).encode())

    def _take_inputs(self, payload: bytes) -> None:
        names, layout = self._inputs.get(payload[0], ([], packed([]))) if payload else ([], packed([]))
        if not names or len(payload) != 1 + layout.itemsize:
            raise ValueError
        (row,) = np.frombuffer(payload[1:], layout)
        inputs = dict(zip(names, (row[k].tolist()[0] for k in range(len(names))), strict=True))
        for name, value in inputs.items():
            if (register := register_of(name)) is not None:
                self.cell.registers[register[0]][register[1]] = value
            elif name.startswith("input_bit_registers"):
                first = int(name[19:].partition("_")[0])
                self.cell.registers["input_bit"][first : first + 32] = [bool(value >> k & 1) for k in range(32)]
            self.cell.updated(name)
        if inputs.get("speed_slider_mask"):
            self.cell.state.override = min(max(float(inputs["speed_slider_fraction"]), 0.0), 1.0)

    def on_cycles(self, cycles: Cycles) -> None:
        first = -self._counted % self._every
        self._counted += len(cycles)
        if self.cell.mute or not self._started or self._outputs is None or first >= len(cycles):
            return
        chosen = cycles.part(slice(first, None, self._every))
        rows = np.zeros(len(chosen), self._layout)
        rows["size"], rows["kind"], rows["recipe"] = rows.itemsize, ord("U"), 1
        for k, name in enumerate(self._outputs):
            values = np.asarray(chosen.field(name))
            column = rows["values"][f"f{k}"]
            column[...] = values[:, None] if values.ndim == 1 and column.shape[1] == 1 else values
        if self.hurried:
            self.stream(rows.tobytes(), drops=True)
        else:
            self.say(rows.tobytes(), waits=True)

    def _reply(self, kind: str, payload: bytes) -> None:
        self.say(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)


def _names(payload: bytes) -> list[str]:
    """Names between commas; what ends with one has no name after it."""
    return [name for name in payload.decode("ascii").split(",") if name]


def _text(text: str, level: int) -> bytes:
    data, source = text.encode(), b"rtde"
    return bytes([len(data)]) + data + bytes([len(source)]) + source + bytes([level])
