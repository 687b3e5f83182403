"""The calls of a shim over the vendor's library: docs/orl_shim.h."""

from __future__ import annotations

import ctypes
from enum import Enum

from agent.motion.orl_calls import MOST_JOINTS, MoveCall, check_status, configuration_flags
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.program import CartesianTarget, JointTarget

#: Settings by their own names: words number from 0 in the order of our enumerations, overrides are in percent.
_WORDS = ("fly_type", "fly_trajectory", "speed_option", "orientation", "termination")
_NUMBERS = ("fly_percent", "stress_percent", "linear_speed", "rotational_speed")
_OVERRIDES = ("speed_override", "acceleration_override", "deceleration_override", "arm_override")
_POINTS, _FRAMES = ("start", "target", "via"), ("base", "tool", "uframe")


class ShimMove(ctypes.Structure):
    """`calibration_move` of docs/orl_shim.h."""

    _fields_ = (
        *[(name, ctypes.c_int) for name in ("size", "joints", "first", "fly", "movement", *_WORDS)],
        *[(name, ctypes.c_int) for name in ("target_is_joints", "via_is_joints")],
        *[(name, ctypes.c_double) for name in ("fly_distance", *_NUMBERS, *_OVERRIDES)],
        *[(name, ctypes.c_double * MOST_JOINTS) for name in _POINTS],
        *[(name, ctypes.c_double * 6) for name in _FRAMES],
        ("configuration", ctypes.c_char * 80),
    )


class ShimCalls:
    """`agent.motion.orl_calls.Calls` by our shim."""

    def __init__(self, library: ctypes.CDLL):
        self._library = library
        library.calibration_interpolator_period.argtypes = [ctypes.c_double]
        library.calibration_interpolator_move.argtypes = [ctypes.POINTER(ShimMove)]
        library.calibration_interpolator_step.argtypes = [ctypes.POINTER(ctypes.c_double)]
        library.calibration_interpolator_cancel.argtypes = []

    def set_period(self, milliseconds: float) -> None:
        check_status("calibration_interpolator_period", self._library.calibration_interpolator_period(milliseconds))

    def announce(self, call: MoveCall, first: bool) -> None:
        move, settings = call.move, Pdl2Settings.of(call.move.settings)
        data = ShimMove(
            size=ctypes.sizeof(ShimMove),
            joints=len(call.start),
            first=first,
            fly=move.fly,
            movement=_number(move.type),
            **{name: _number(getattr(settings, name)) for name in _WORDS},
            target_is_joints=isinstance(move.target, JointTarget),
            via_is_joints=isinstance(move.via, JointTarget),
            fly_distance=1e3 * settings.fly_distance,
            **{name: getattr(settings, name) for name in _NUMBERS},
            **{name: 100.0 * getattr(settings, name) for name in _OVERRIDES},
            **{name: getattr(call, name) for name in (*_POINTS, *_FRAMES)},
        )
        if isinstance(move.target, CartesianTarget):
            data.configuration = configuration_flags(move.target)
        status = self._library.calibration_interpolator_move(ctypes.byref(data))
        check_status("calibration_interpolator_move", status)

    def step(self, count: int) -> tuple[int, list[float]]:
        joints = (ctypes.c_double * MOST_JOINTS)()
        return self._library.calibration_interpolator_step(joints), list(joints[:count])

    def cancel(self) -> None:
        self._library.calibration_interpolator_cancel()


def _number(word: Enum) -> int:
    return list(type(word)).index(word)
