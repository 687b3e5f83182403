"""The fields of RTDE: their types, the versions that have them, and what they are in a stretch of cycles."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from typing import Any

import numpy as np

from fake_controller.ur.arm import poses_of, twist_between
from fake_controller.ur.state import UrState

#: NumPy's format of one value, big-endian, and how many a field has.
TYPES = {
    "BOOL": ("?", 1), "UINT8": ("u1", 1), "UINT32": (">u4", 1), "UINT64": (">u8", 1), "INT32": (">i4", 1),
    "DOUBLE": (">f8", 1), "VECTOR3D": (">f8", 3), "VECTOR6D": (">f8", 6), "VECTOR6INT32": (">i4", 6),
    "VECTOR6UINT32": (">u4", 6),
}  # fmt: skip
_OUTPUTS = """
DOUBLE timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage
DOUBLE actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0
DOUBLE standard_analog_output1 io_current euromap67_24V_voltage euromap67_24V_current tool_analog_input0
DOUBLE tool_analog_input1 tool_output_current tool_temperature tcp_force_scalar payload joint_position_deviation_ratio
DOUBLE collision_detection_ratio
VECTOR6D target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current
VECTOR6D actual_current_window joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose
VECTOR6D target_TCP_speed joint_temperatures actual_joint_voltage payload_inertia ft_raw_wrench tcp_offset
VECTOR6D actual_current_as_torque
VECTOR3D actual_tool_accelerometer elbow_position elbow_velocity payload_cog
VECTOR6INT32 joint_mode
UINT64 actual_digital_input_bits actual_digital_output_bits
INT32 robot_mode safety_mode safety_status tool_output_voltage time_scale_source
UINT32 runtime_state robot_status_bits safety_status_bits analog_io_types euromap67_input_bits euromap67_output_bits
UINT32 tool_mode tool_analog_input_types output_bit_registers0_to_31 output_bit_registers32_to_63
UINT32 input_bit_registers0_to_31 input_bit_registers32_to_63 script_control_line
UINT8 tool_output_mode tool_digital_output0_mode tool_digital_output1_mode
"""
_INPUTS = """
UINT32 speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63
DOUBLE speed_slider_fraction standard_analog_output_0 standard_analog_output_1
UINT8 standard_digital_output_mask configurable_digital_output_mask standard_digital_output configurable_digital_output
UINT8 standard_analog_output_mask standard_analog_output_type tool_digital_output_mask tool_digital_output
VECTOR6D external_force_torque
"""
#: First CB3 and e-Series versions with a field; (99,) if there is none.
_SINCE = {
    "payload": ((3, 11), (5, 5, 1)),
    "payload_cog": ((3, 11), (5, 5, 1)),
    "payload_inertia": ((3, 15), (5, 11)),
    "tcp_offset": ((3, 12, 3), (5, 5, 1)),
    "script_control_line": ((3, 14), (5, 9)),
    "ft_raw_wrench": ((99,), (5, 9)),
    "actual_current_as_torque": ((99,), (5, 23)),
}
_REGISTER = re.compile(r"(input|output)_(int|double|bit)_register_(\d+)")
_REGISTER_TYPES = {"int": ("INT32", 48), "double": ("DOUBLE", 48), "bit": ("BOOL", 128)}
_WORD = re.compile(r"(input|output)_bit_registers(0|32)_to_\d+")
_SAFETY_BITS = {1: 1, 3: 1 << 2, 5: 1 << 4, 7: 3 << 6, 9: 1 << 9}
_BITS = 1 << np.arange(32, dtype=np.uint64)


def _listed(text: str) -> dict[str, str]:
    return {name: line.split()[0] for line in text.split("\n") for name in line.split()[1:]}


OUTPUTS, INPUTS = _listed(_OUTPUTS), _listed(_INPUTS)


def output_type(name: str, version: tuple[int, ...]) -> str:
    """Type of an output of a controller of this version, or NOT_FOUND."""
    since = _SINCE.get(name, ((0,), (0,)))[version[0] >= 5]
    return _type(name, OUTPUTS, version) if version >= since else "NOT_FOUND"


def input_type(name: str, version: tuple[int, ...]) -> str:
    """Type of an input of a controller of this version, or NOT_FOUND."""
    return "NOT_FOUND" if name.startswith("output_") else _type(name, INPUTS, version)


def _type(name: str, table: dict[str, str], version: tuple[int, ...]) -> str:
    if (register := _REGISTER.fullmatch(name)) is None:
        return table.get(name, "NOT_FOUND")
    kind, count = _REGISTER_TYPES[register[2]]
    if version < ((5, 3) if version[0] >= 5 else (3, 9)):
        count //= 2
    return kind if int(register[3]) < count else "NOT_FOUND"


@cache
def register_of(name: str) -> tuple[str, int] | None:
    """The list of registers and the index in it that a field stands for, if any."""
    match = _REGISTER.fullmatch(name)
    return None if match is None else (f"{match[1]}_{match[2]}", int(match[3]))


def packed(types: list[str]) -> np.dtype[Any]:
    """The layout of values of these types, one after the other."""
    return np.dtype([(f"f{k}", TYPES[kind][0], (TYPES[kind][1],)) for k, kind in enumerate(types)])


@dataclass(frozen=True, eq=False)
class Cycles:
    """K cycles of a cell: times (K,) [s], set-points, and what was measured (K, 6); its state held all the while."""

    cell: UrState
    time: np.ndarray
    target_q: np.ndarray
    target_qd: np.ndarray
    target_qdd: np.ndarray
    actual_q: np.ndarray
    actual_qd: np.ndarray
    torque: np.ndarray

    def __len__(self) -> int:
        return len(self.time)

    def part(self, chosen: slice) -> Cycles:
        """Some of them."""
        return Cycles(self.cell, *(value[chosen] for value in vars(self).values() if value is not self.cell))

    def field(self, name: str) -> Any:
        """The values of an output: (K,), (K, m), or what all cycles have in common; 0 where nothing is simulated."""
        registers = self.cell.registers
        if name in _VALUES:
            return _VALUES[name](self)
        if (register := register_of(name)) is not None:
            return registers[register[0]][register[1]]
        if (word := _WORD.fullmatch(name)) is not None:
            first = int(word[2])
            return int(_BITS[np.array(registers[f"{word[1]}_bit"][first : first + 32], bool)].sum())
        return 0

    def tcp(self, which: str) -> np.ndarray:
        """(K, 4, 4) poses of the TCP, `actual` or `target`."""
        return self.cell.kinematics.forward(getattr(self, f"{which}_q")) @ self.cell.tcp

    def tcp_speed(self, which: str) -> np.ndarray:
        """(K, 6) of the TCP, `actual` or `target`."""
        q, qd = getattr(self, f"{which}_q"), getattr(self, f"{which}_qd")
        return twist_between(self.tcp(which), self.cell.kinematics.forward(q + 1e-6 * qd) @ self.cell.tcp) / 1e-6

    def modelled(self, moves: bool = True) -> np.ndarray:
        """(K, 6) joint torque by the controller's model and the payload it believes in, without friction."""
        target = self.target_q, self.target_qd, self.target_qdd
        q, qd, qdd = target if moves else (self.actual_q, 0 * self.actual_q, 0 * self.actual_q)
        return self.cell.believed_dynamics().inverse_dynamics(q, qd, qdd)


#: What the fields are that are simulated.
_VALUES: dict[str, Callable[[Cycles], Any]] = {
    "timestamp": lambda of: of.time,
    **{name: attrgetter(name) for name in ("target_q", "target_qd", "target_qdd", "actual_q", "actual_qd")},
    **dict.fromkeys(("actual_current", "joint_control_output"), lambda of: of.torque / of.cell.torque_constants),
    "target_moment": lambda of: of.modelled(),
    "target_current": lambda of: of.modelled() / of.cell.torque_constants,
    "actual_current_as_torque": lambda of: of.torque - of.modelled(moves=False),
    "actual_current_window": lambda of: 10.0 / of.cell.torque_constants,
    "actual_TCP_pose": lambda of: poses_of(of.tcp("actual")),
    "target_TCP_pose": lambda of: poses_of(of.tcp("target")),
    "actual_TCP_speed": lambda of: of.tcp_speed("actual"),
    "target_TCP_speed": lambda of: of.tcp_speed("target"),
    "actual_tool_accelerometer": lambda of: of.tcp("actual")[:, :3, :3].transpose(0, 2, 1) @ of.cell.gravity,
    **{name: attrgetter(f"cell.{name}") for name in ("robot_mode", "safety_mode", "runtime_state", "tcp_offset")},
    "safety_status": attrgetter("cell.safety_mode"),
    "safety_status_bits": lambda of: _SAFETY_BITS[of.cell.safety_mode] + ((of.cell.safety_mode != 1) << 10),
    "robot_status_bits": lambda of: int(of.cell.robot_mode >= 5) + 2 * (of.cell.runtime_state == 2),
    "joint_mode": lambda of: [{3: 239, 5: 255, 7: 253}[of.cell.robot_mode]] * 6,  # off, idle, running
    "target_speed_fraction": attrgetter("cell.state.override"),
    "payload": lambda of: of.cell.payload[0],
    "payload_cog": lambda of: of.cell.payload[1:4],
    "payload_inertia": lambda of: of.cell.payload[4:],
    "script_control_line": attrgetter("cell.control_line"),
    "joint_temperatures": lambda of: of.cell.machine.temperatures or (30.0,) * 6,
    "speed_scaling": lambda _: 1.0,
    "tool_temperature": lambda _: 30.0,
    **dict.fromkeys(("actual_main_voltage", "actual_robot_voltage", "actual_joint_voltage"), lambda _: 48.0),
}
