"""What a script can call, as far as this controller carries it out; names, parameters and defaults of the manual."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from fake_controller.ur.arm import Unreachable, matrix_of, poses_of
from fake_controller.ur.law import UrMove
from fake_controller.ur.script import Go, Pose, Request, command, pause, question
from fake_controller.ur.state import UrState

#: Functions that change nothing of what is simulated.
_WITHOUT_CONSEQUENCE = (
    "enable_external_ft_sensor", "end_force_mode", "end_freedrive_mode", "end_teach_mode", "force_mode_set_damping",
    "force_mode_set_gain_scaling", "ft_rtde_input_enable", "popup", "set_analog_out", "set_configurable_digital_out",
    "set_digital_out", "set_standard_analog_out", "set_standard_digital_out", "set_tool_digital_out", "zero_ftsensor",
)  # fmt: skip
#: Functions that a script may name, and that this controller does not carry out.
_NOT_SIMULATED = (
    "direct_torque", "force_mode", "freedrive_mode", "get_freedrive_status", "get_actual_joint_positions_history",
    "get_coriolis_and_centrifugal_torques", "get_jacobian", "get_joint_torques", "get_jacobian_time_derivative",
    "get_mass_matrix", "get_target_tcp_speed", "get_target_waypoint", "optimovej", "optimovel", "servoc", "servoj",
    "socket_close", "socket_open", "socket_read_string", "socket_send_string", "speedj", "speedl", "teach_mode",
    "tool_contact",
)  # fmt: skip
_NO_INERTIA = (0.0,) * 6
#: What scripts call a kind of register, its name here, and the type of its values.
_REGISTERS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "integer": ("int", int),
    "float": ("double", float),
    "boolean": ("bit", bool),
}
_PURE: dict[str, Callable[..., Any]] = {
    **{name: getattr(math, name) for name in ("acos", "asin", "atan", "atan2", "ceil", "cos", "floor")},
    **{name: getattr(math, name) for name in ("log", "pow", "sin", "sqrt", "tan")},
    "abs": abs,
    "d2r": math.radians,
    "r2d": math.degrees,
    "length": len,
    "norm": lambda a: float(np.linalg.norm(a)),
    "integer_to_float": float,
    "point_dist": lambda a, b: float(np.linalg.norm(np.subtract(a[:3], b[:3]))),
    "pose_inv": lambda pose: _pose(np.linalg.inv(matrix_of(pose))),
    "pose_trans": lambda first, second: _pose(matrix_of(first) @ matrix_of(second)),
    "pose_sub": lambda a, b: Pose([*np.subtract(a[:3], b[:3]), *_pose(matrix_of(a) @ np.linalg.inv(matrix_of(b)))[3:]]),
    "str_cat": lambda a, b: _text_of(a) + _text_of(b),
    "to_str": lambda value: _text_of(value),
    "sleep": lambda t: pause(float(t)),
    "sync": lambda: pause(0.0),
    "stopj": lambda a=2.0: Request(lambda cell, thread: cell.brake(thread, a)),
    "stopl": lambda a=2.0, aRot=0.0: Request(lambda cell, thread: cell.brake(thread, a)),
}


def script_functions(cell: UrState) -> Mapping[str, Callable[..., Any]]:
    """Everything that a script on this controller may call, by name."""
    questions: dict[str, Callable[[], Any]] = {
        "get_actual_joint_positions": lambda: cell.position.tolist(),
        "get_target_joint_positions": lambda: cell.reference.tolist(),
        "get_actual_joint_speeds": lambda: cell.velocity.tolist(),
        "get_actual_tcp_pose": lambda: _pose(_tcp_at(cell, cell.position)),
        "get_target_tcp_pose": lambda: _pose(_tcp_at(cell, cell.reference)),
        "get_actual_tool_flange_pose": lambda: _pose(_tcp_at(cell, cell.position, np.eye(4))),
        "get_tcp_offset": lambda: _pose(cell.tcp),
        "get_target_payload": lambda: cell.payload[0],
        "get_target_payload_cog": lambda: cell.payload[1:4],
        "get_target_payload_inertia": lambda: cell.payload[4:],
        "get_steptime": lambda: cell.period,
        "is_steady": lambda: not cell.moving,
    }
    return {
        **dict.fromkeys(_NOT_SIMULATED, _missing),
        **dict.fromkeys(_WITHOUT_CONSEQUENCE, lambda *_, **__: None),
        **_PURE,
        **{name: lambda ask=ask: question(ask) for name, ask in questions.items()},
        **{name: getattr(_Functions(cell), name) for name in vars(_Functions) if not name.startswith("_")},
        **{f"write_output_{word}_register": partial(_write, cell, *kind) for word, kind in _REGISTERS.items()},
        **{f"read_input_{word}_register": partial(_read, cell, kind) for word, (kind, _) in _REGISTERS.items()},
    }


class _Functions:
    def __init__(self, cell: UrState) -> None:
        self._cell = cell

    def movej(self, q: Any, a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Go:
        return self._move("joint", q, a, v, t, r)

    def movel(self, pose: Any, a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Go:
        return self._move("line", pose, a, v, t, r)

    def movep(self, pose: Any, a: float = 1.2, v: float = 0.25, r: float = 0) -> Go:
        return self._move("process", pose, a, v, 0, r)

    def movec(self, pose_via: Any, pose_to: Any, a: float = 1.2, v: float = 0.25, r: float = 0, mode: int = 0) -> Go:
        return self._move("arc", pose_to, a, v, 0, r, self._pose_of(pose_via))

    def get_forward_kin(self, q: Any = None, tcp: Any = None) -> Request:
        tool = None if tcp is None else matrix_of(tcp)
        return question(lambda: _pose(_tcp_at(self._cell, self._cell.position if q is None else np.array(q), tool)))

    def get_inverse_kin(self, x: Any, qnear: Any = None, *_: Any, **__: Any) -> Request:
        return question(lambda: self._solved(x, qnear))

    def get_inverse_kin_has_solution(self, x: Any, qnear: Any = None, *_: Any, **__: Any) -> Request:
        def ask() -> bool:
            try:
                self._solved(x, qnear)
            except Unreachable:
                return False
            return True

        return question(ask)

    def is_within_safety_limits(self, pose: Any) -> Request:
        return question(lambda: True) if not isinstance(pose, Pose) else self.get_inverse_kin_has_solution(pose)

    def set_tcp(self, pose: Any, tcp_name: str = "") -> Request:
        return self._set("tcp", matrix_of(pose))

    def set_gravity(self, d: Any) -> Request:
        return self._set("gravity", np.array(d, float))

    def set_payload(self, m: float, cog: Any = None) -> Request:
        return self.set_target_payload(m, self._cell.tcp[:3, 3] if cog is None else cog)

    def set_target_payload(
        self, m: float, cog: Any, inertia: Sequence[float] = _NO_INERTIA, transition_time: float = 0
    ) -> Request:
        if len(cog) != 3 or len(inertia) != 6 or max(map(abs, inertia)) > 133 or min(inertia[:3]) < 0 or m < 0:
            raise ValueError("this cannot be a payload")
        return self._set("payload", [float(value) for value in (m, *cog, *inertia)])

    def rtde_set_watchdog(self, variable_name: str, min_frequency: float, action: str = "pause") -> Request:
        if action not in ("ignore", "pause", "stop"):
            raise ValueError(f"{action!r} is no action")
        return command(lambda cell: cell.watch(variable_name, min_frequency, action))

    def textmsg(self, s1: Any, s2: Any = "") -> Request:
        return command(lambda cell: cell.tell_text(_text_of(s1) + _text_of(s2)))

    def protective_stop(self) -> Request:
        return command(lambda cell: cell.protective_stop("the program asked for it"))

    def _move(self, kind: str, target: Any, a: float, v: float, t: float, r: float, via: Any = None) -> Go:
        if min(a, v) <= 0 or min(t, r) < 0 or len(target) != 6:
            raise ValueError(
                "acceleration and speed must be above 0, time and radius at least 0, targets have 6 numbers"
            )
        joints = np.array(target, float) if kind == "joint" and not isinstance(target, Pose) else None
        return Go(UrMove(kind, self._pose_of(target), self._cell.tcp, v, a, r, 0, joints, via, t))

    def _solved(self, x: Any, reference: Any) -> list[float]:
        flange = self._pose_of(x) @ np.linalg.inv(self._cell.tcp)
        return self._cell.kinematics.nearest(flange, np.array(reference or self._cell.reference, float)).tolist()

    def _pose_of(self, target: Any) -> np.ndarray:
        return matrix_of(target) if isinstance(target, Pose) else _tcp_at(self._cell, np.array(target, float))

    def _set(self, name: str, value: Any) -> Request:
        return question(lambda: setattr(self._cell, name, value))


def _write(cell: UrState, kind: str, type_: Callable[[Any], Any], address: int, value: Any) -> Request:
    registers, written = cell.registers[f"output_{kind}"], type_(value)
    if not 0 <= address < len(registers):
        raise ValueError(f"there is no register {address}")
    return command(lambda _: registers.__setitem__(address, written))


def _read(cell: UrState, kind: str, address: int) -> Request:
    return question(lambda: cell.registers[f"input_{kind}"][address])


def _missing(*_: Any, **__: Any) -> Any:
    raise ValueError("this emulated controller does not carry it out")


def _pose(matrix: np.ndarray) -> Pose:
    return Pose(poses_of(matrix[None])[0].tolist())


def _text_of(value: object) -> str:
    return f"p{list(value)}" if isinstance(value, Pose) else str(value)


def _tcp_at(cell: UrState, q: np.ndarray, tcp: np.ndarray | None = None) -> np.ndarray:
    return (cell.kinematics.forward(q[None]) @ (cell.tcp if tcp is None else tcp))[0]
