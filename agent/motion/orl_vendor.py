"""The calls of the vendor's library: the names, structures and constants of its published header, declared anew.

The header is `eORL.h` of 2013; what of it public programs use, and what they leave open, is in
`docs/decisions/orl-adapter.md`.
"""

from __future__ import annotations

import atexit
import ctypes
import os
from functools import cache
from typing import Any

from agent.core import InputError
from agent.motion.orl_calls import ARM, CONTROLLER, MOST_JOINTS, OK, MoveCall, check_status, configuration_flags
from agent.motion.pdl2.settings import FlyTrajectory, FlyType, OrientationType, Pdl2Settings, SpeedOption, Termination
from agent.motion.program import CartesianTarget, JointTarget, MoveType

_SILENT, _FIRST_CONTROLLER = 0, 0
_LINK_DEGREE, _CARTESIAN = 3, 50
_INTEGER, _REAL = 1, 3
_FLY_PERCENT, _FLY_DISTANCE = 7, 8
_ROTATION = 1
_MOVES = {MoveType.JOINT: 1, MoveType.LINEAR: 2, MoveType.CIRCULAR: 4}
_FLY_CARTESIAN = {
    FlyTrajectory.FLY_AUTO: 3,
    FlyTrajectory.FLY_PASS: 4,
    FlyTrajectory.FLY_TOL: 5,
    FlyTrajectory.FLY_FROM: 6,
}
_SPEEDS = {SpeedOption.SPD_LIN: 1, SpeedOption.SPD_ROT: 2, SpeedOption.SPD_JNT: 3, SpeedOption.SPD_CONST: 4}
_ORIENTATIONS = {
    OrientationType.RS_WORLD: 2,
    OrientationType.EUL_WORLD: 3,
    OrientationType.WRIST_JNT: 4,
    OrientationType.RS_TRAJ: 6,
}
_ACCURACIES = {
    Termination.FINE: 0,
    Termination.COARSE: 1,
    Termination.NOSETTLE: 2,
    Termination.JNT_FINE: 3,
    Termination.JNT_COARSE: 4,
}


class CartesianPosition(ctypes.Structure):
    """A pose with its unit and its configuration string."""

    _fields_ = (
        ("unit_type", ctypes.c_int),
        *[(name, ctypes.c_double) for name in ("x", "y", "z", "a", "e", "r")],
        ("config_flags", ctypes.c_char * 80),
    )


class JointValue(ctypes.Structure):
    """Ten joint values with their unit."""

    _fields_ = (("unit_type", ctypes.c_int), ("value", ctypes.c_double * MOST_JOINTS))


class OrlSystemVariable(ctypes.Structure):
    """A system variable by name, with its type and the value of that type."""

    _fields_ = (
        ("ctype", ctypes.c_int),
        ("permission", ctypes.c_int),
        ("iv", ctypes.c_int),
        ("dv", ctypes.c_double),
        ("sv", ctypes.c_char * 255),
        ("sysvar_name", ctypes.c_char * 80),
    )


# Each call ends with verbose and controller, most with the arm as well.
_PLACE = [ctypes.c_int] * 3
_TARGETS = [ctypes.POINTER(CartesianPosition), ctypes.POINTER(JointValue)]
_CALLS: dict[str, list[Any]] = {
    "ORL_initialize_controller": [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_int],
    "ORL_terminate_controller": [ctypes.c_int, ctypes.c_int],
    "ORL_initialize_frames": [CartesianPosition, CartesianPosition, CartesianPosition, *_PLACE],
    "ORL_select_point_accuracy": [ctypes.c_int, *_PLACE],
    "ORL_set_interpolation_time": [ctypes.c_double, *_PLACE],
    "ORL_get_next_interpolation_step": [ctypes.POINTER(JointValue), *_PLACE],
    "ORL_set_position": [*_TARGETS, *_PLACE],
    "ORL_set_move_parameters": [*[ctypes.c_int] * 4, *_TARGETS, *_PLACE],
    "ORL_set_data": [OrlSystemVariable, ctypes.c_int, ctypes.c_int],
    "ORL_dominant_interpolation": [ctypes.c_int, ctypes.c_int, *_PLACE],
    "ORL_orientation_interpolation": [ctypes.c_int, *_PLACE],
    "ORL_cancel_motion": _PLACE,
    "ORL_set_fly_parameter": [ctypes.c_int, ctypes.c_double, *_PLACE],
}


# The library keeps one controller's state for the process: initialised once, however many interpolators there are.
@cache
def vendor_calls(path: str, controller: str, arm: str) -> VendorCalls:
    """The calls of the library at `path`, started from the controller's file, for one of its arms ("1" to "4").

    Raises:
        InputError: no such file or arm, or the library does not start from it.
        AttributeError: the library lacks a call.
    """
    library = ctypes.CDLL(path)
    for name, arguments in _CALLS.items():
        call = getattr(library, name)
        call.argtypes, call.restype = arguments, ctypes.c_int
    if not controller:
        raise InputError(f"the vendor's library starts from the controller's file: set {CONTROLLER} to it (*.c5g)")
    if not os.path.isfile(controller):
        raise InputError(f"{controller}: the controller's file is not there ({CONTROLLER})")
    if arm not in ("1", "2", "3", "4"):
        raise InputError(f"{ARM} is {arm!r}: the arm is 1 to 4")
    folder, name = os.path.split(os.path.abspath(controller))
    folder = os.path.join(folder, "")  # the separator at the end, as public programs give it
    status = library.ORL_initialize_controller(os.fsencode(name), os.fsencode(folder), _SILENT, _FIRST_CONTROLLER)
    if status != OK:
        raise InputError(f"ORL_initialize_controller refuses {controller}: status {status}")
    atexit.register(library.ORL_terminate_controller, _SILENT, _FIRST_CONTROLLER)
    return VendorCalls(library, int(arm))


class VendorCalls:
    """`agent.motion.orl_calls.Calls` by the vendor's own."""

    def __init__(self, library: ctypes.CDLL, arm: int):
        self._library = library
        self._arm = arm
        self._place = (_SILENT, _FIRST_CONTROLLER, arm - 1)

    def set_period(self, milliseconds: float) -> None:
        self._call("ORL_set_interpolation_time", milliseconds)

    def announce(self, call: MoveCall, first: bool) -> None:
        move, settings = call.move, Pdl2Settings.of(call.move.settings)
        if first:
            self._call("ORL_set_position", None, _joints(call.start))
        self._call("ORL_initialize_frames", *(_pose(frame) for frame in (call.base, call.tool, call.uframe)))
        self._call("ORL_select_point_accuracy", _ACCURACIES[settings.termination])
        self._call("ORL_orientation_interpolation", _ORIENTATIONS[settings.orientation])
        self._call("ORL_dominant_interpolation", _SPEEDS[settings.speed_option], _ROTATION)
        self._real("LIN_SPD", settings.linear_speed)
        self._real("ROT_SPD", settings.rotational_speed)
        self._percent("SPD_OVR", settings.speed_override)
        self._percent("ACC_OVR", settings.acceleration_override)
        self._percent("DEC_OVR", settings.deceleration_override)
        self._percent("ARM_OVR", settings.arm_override)
        fly_type = 0
        if move.fly and settings.fly_type is FlyType.FLY_CART:
            fly_type = _FLY_CARTESIAN[settings.fly_trajectory]
            self._percent("STRESS_PER", settings.stress_percent / 100.0)
            self._call("ORL_set_fly_parameter", _FLY_DISTANCE, 1e3 * settings.fly_distance)
        elif move.fly:
            self._call("ORL_set_fly_parameter", _FLY_PERCENT, settings.fly_percent)
        # A circle takes two calls: where it ends, then what it passes.
        for target, values in ((move.target, call.target), (move.via, call.via)):
            if target is None:
                continue
            pose = _pose(values, configuration_flags(target)) if isinstance(target, CartesianTarget) else None
            joints = _joints(values) if isinstance(target, JointTarget) else None
            # ORL_FLY with ORL_ADVANCE, ORL_NO_FLY with ORL_WAIT: both pairs are 1, 1 and 0, 0.
            self._call("ORL_set_move_parameters", move.fly, move.fly, fly_type, _MOVES[move.type], pose, joints)

    def step(self, count: int) -> tuple[int, list[float]]:
        joints = _joints(())
        status = self._library.ORL_get_next_interpolation_step(joints, *self._place)
        return status, list(joints.value[:count])

    def cancel(self) -> None:
        # Nothing to cancel is an error to the library, and none to us.
        self._library.ORL_cancel_motion(*self._place)

    def _call(self, name: str, *arguments: object) -> None:
        check_status(name, getattr(self._library, name)(*arguments, *self._place))

    def _percent(self, name: str, fraction: float) -> None:
        self._set(name, ctype=_INTEGER, iv=round(100.0 * fraction))

    def _real(self, name: str, value: float) -> None:
        self._set(name, ctype=_REAL, dv=value)

    def _set(self, name: str, **value: float) -> None:
        full = f"$ARM_DATA[{self._arm}].{name}"
        variable = OrlSystemVariable(sysvar_name=full.encode(), **value)
        check_status(f"ORL_set_data of {full}", self._library.ORL_set_data(variable, _SILENT, _FIRST_CONTROLLER))


def _pose(values: tuple[float, ...], flags: bytes = b"") -> CartesianPosition:
    return CartesianPosition(_CARTESIAN, *values, flags)


def _joints(values: tuple[float, ...]) -> JointValue:
    return JointValue(_LINK_DEGREE, values)
