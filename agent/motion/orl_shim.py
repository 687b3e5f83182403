"""The calls of a shim over the vendor's library: docs/orl_shim.h."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

from agent.motion.orl_calls import MOST_JOINTS, CallRefused, Told, configuration_flags
from agent.motion.program import (
    CartesianTarget,
    FlyTrajectory,
    FlyType,
    JointTarget,
    Move,
    MoveType,
    OrientationType,
    SpeedOption,
    Termination,
)

# Constants number from 0 in the order of our enumerations.
_ORDERS: tuple[tuple[str, Callable[[Move], object], type], ...] = (
    ("movement", lambda move: move.type, MoveType),
    ("fly_type", lambda move: move.settings.fly_type, FlyType),
    ("fly_trajectory", lambda move: move.settings.fly_trajectory, FlyTrajectory),
    ("speed_option", lambda move: move.settings.speed_option, SpeedOption),
    ("orientation", lambda move: move.settings.orientation, OrientationType),
    ("termination", lambda move: move.settings.termination, Termination),
)


class ShimMove(ctypes.Structure):
    """`calibration_move` of docs/orl_shim.h."""

    _fields_ = (
        *[(name, ctypes.c_int) for name in ("size", "joints", "first", "fly")],
        *[(name, ctypes.c_int) for name, _, _ in _ORDERS],
        *[(name, ctypes.c_int) for name in ("target_is_joints", "via_is_joints")],
        *[
            (name, ctypes.c_double)
            for name in (
                "fly_distance",
                "fly_percent",
                "stress_percent",
                "linear_speed",
                "rotational_speed",
                "speed_override",
                "acceleration_override",
                "deceleration_override",
                "arm_override",
            )
        ],
        *[(name, ctypes.c_double * MOST_JOINTS) for name in ("start", "target", "via")],
        *[(name, ctypes.c_double * 6) for name in ("base", "tool", "uframe")],
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
        self._check("calibration_interpolator_period", self._library.calibration_interpolator_period(milliseconds))

    def announce(self, told: Told, first: bool) -> None:
        move, settings = told.move, told.move.settings
        data = ShimMove(
            size=ctypes.sizeof(ShimMove),
            joints=len(told.start),
            first=first,
            fly=move.fly,
            **{name: list(kind).index(get(move)) for name, get, kind in _ORDERS},  # type: ignore[call-overload]
            target_is_joints=isinstance(move.target, JointTarget),
            via_is_joints=isinstance(move.via, JointTarget),
            fly_distance=1e3 * settings.fly_distance,
            fly_percent=settings.fly_percent,
            stress_percent=settings.stress_percent,
            linear_speed=settings.linear_speed,
            rotational_speed=settings.rotational_speed,
            speed_override=100.0 * settings.speed_override,
            acceleration_override=100.0 * settings.acceleration_override,
            deceleration_override=100.0 * settings.deceleration_override,
            arm_override=100.0 * settings.arm_override,
            **{name: getattr(told, name) for name in ("start", "target", "via", "base", "tool", "uframe")},
        )
        if isinstance(move.target, CartesianTarget):
            data.configuration = configuration_flags(move.target)
        status = self._library.calibration_interpolator_move(ctypes.byref(data))
        self._check("calibration_interpolator_move", status)

    def step(self, count: int) -> tuple[int, list[float]]:
        joints = (ctypes.c_double * MOST_JOINTS)()
        return self._library.calibration_interpolator_step(joints), list(joints[:count])

    def cancel(self) -> None:
        self._library.calibration_interpolator_cancel()

    @staticmethod
    def _check(name: str, status: int) -> None:
        if status != 0:
            raise CallRefused(f"{name}: status {status}")
