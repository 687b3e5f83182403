"""The vendor's own interpolator, where a user has its library: moves announced and stepped through.

The library exports either the calls of its published header (`eORL.h` of 2013; `docs/decisions/orl-adapter.md` says
what is known of them) or the four of a shim over it (docs/orl_shim.h). Calls are in millimetres, degrees and percent.
"""

from __future__ import annotations

import atexit
import ctypes
import os
from collections.abc import Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from agent.core import InputError
from agent.motion.frames import pose_in_robot_base, tool_frame
from agent.motion.interpolator import MotionError
from agent.motion.pdl2.pos import pose_to_pos
from agent.motion.pdl2.settings import FlyTrajectory, FlyType, OrientationType, Pdl2Settings, SpeedOption, Termination
from agent.motion.program import CartesianTarget, Delay, JointTarget, Move, MoveType, Statement, Target, matrix_of
from agent.motion.trajectory import Trajectory
from agent.robot import RobotDescription, kinematics_for

if TYPE_CHECKING:
    from agent.robot import Tool

#: Environment variables: the library, and for the vendor's own the controller's file (*.c5g) and the arm in it (1..4).
LIBRARY = "CALIBRATION_ORL_LIBRARY"
CONTROLLER = "CALIBRATION_ORL_CONTROLLER"
ARM = "CALIBRATION_ORL_ARM"

#: What a step answers; anything else below zero is an error. NEED_DATA: on the way, and the next move may be announced.
_MOVING, _NEED_DATA, _FINAL, _IDLE = 0, 1, 2, -42
#: One move is active and one more is scheduled; a third has to wait for NEED_DATA.
_MOST_ANNOUNCED = 2
_MOST_JOINTS = 10
#: [s] no chain of moves may take longer.
_LONGEST = 3600.0
#: [rad or m] A chain that ends further from its target than this was not the one we announced.
_ARRIVED = 5e-3


class _MoveCall(NamedTuple):
    """A move as the controller writes it: joints in degrees (mm where they slide), poses x y z a e r in mm, degrees."""

    move: Move
    settings: Pdl2Settings
    start: tuple[float, ...]
    target: tuple[float, ...]
    via: tuple[float, ...]
    base: tuple[float, ...]
    tool: tuple[float, ...]
    uframe: tuple[float, ...]


class _CallRefused(Exception):
    """A call with an error status; its text names the call."""


class OrlInterpolator:
    """Plans programs by stepping the vendor's interpolator. One at a time in a process: the library keeps the state.

    `library` is its path; without one the environment variable CALIBRATION_ORL_LIBRARY names it. The vendor's own
    starts from the controller's file (CALIBRATION_ORL_CONTROLLER), for its first arm or CALIBRATION_ORL_ARM.

    Raises:
        InputError: no library or controller file, one that does not load or lacks a call, a period it does not take.
    """

    def __init__(
        self,
        robot: RobotDescription,
        tool: Tool | None = None,
        period: float = 0.002,
        library: str | Path | None = None,
    ):
        self.robot, self.period = robot, period
        self._kinematics, self._tool = kinematics_for(robot, tool), tool_frame(tool)
        self._sliding = np.array([joint.prismatic for joint in robot.joints])
        if robot.dof > _MOST_JOINTS:
            raise InputError(f"the robot has {robot.dof} joints, the ORL library takes {_MOST_JOINTS}")
        self._library = _loaded(library)
        self._set_period()

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) to rest; velocities by differences of positions.

        Raises:
            MotionError: the library refuses a move, its arm does not start where ours stands or end at the target, or
                it ends a move that flies before it has asked for the next.
        """
        # Set again: the library is one for the process, and another interpolator may have set its own.
        self._set_period()
        here = np.asarray(start, dtype=float)
        samples, moves = [here[None]], [np.zeros(1, dtype=int)]
        chain: list[tuple[int, Move]] = []
        for index, statement in enumerate(statements):
            if isinstance(statement, Delay):
                count = round(statement.seconds / self.period)
                samples.append(np.tile(here, (count, 1)))
                moves.append(np.full(count, index))
                continue
            chain.append((index, statement))
            following = statements[index + 1] if index + 1 < len(statements) else None
            if not statement.fly or not isinstance(following, Move):
                samples.append(self._stepped(chain, here))
                moves.append(self._owners(chain, samples[-1]))
                here, chain = samples[-1][-1], []
        return self._trajectory(np.concatenate(samples), np.concatenate(moves))

    def _set_period(self) -> None:
        try:
            self._library.set_period(1e3 * self.period)
        except _CallRefused as refused:
            raise InputError(f"the library refuses a period of {1e3 * self.period:g} ms: {refused}") from None

    def _stepped(self, chain: list[tuple[int, Move]], start: np.ndarray) -> np.ndarray:
        """(S, n) set-points of moves from stop to stop."""
        try:
            return np.array(self._steps(chain, start))
        except MotionError:
            self._library.cancel()
            raise

    def _steps(self, chain: list[tuple[int, Move]], start: np.ndarray) -> list[np.ndarray]:
        announced = 0
        for index, move in chain[:_MOST_ANNOUNCED]:
            self._announce(index, move, start, first=announced == 0)
            announced += 1
        steps: list[np.ndarray] = []
        while len(steps) * self.period <= _LONGEST:
            status, joints = self._library.step(self.robot.dof)
            if status not in (_MOVING, _NEED_DATA, _FINAL):
                idle = "the library has nothing to move before the move has ended"
                raise _refusal(chain[announced - 1][0], idle if status == _IDLE else f"no next step: status {status}")
            steps.append(np.where(self._sliding, 1e-3 * np.array(joints), np.radians(joints)))
            jump = np.abs(steps[0] - start)
            if len(steps) == 1 and np.any(jump > 2.0 * self.robot.max_velocity * self.period):
                away = np.degrees(jump.max())
                raise _refusal(chain[0][0], f"the library's arm is {away:.3g} degrees away from where ours starts")
            if status == _NEED_DATA and announced < len(chain):
                self._announce(*chain[announced], start, first=False)
                announced += 1
            if status == _FINAL:
                if announced < len(chain):
                    raise _refusal(chain[announced - 1][0], "the library ended the move before it asked for the next")
                self._check_arrived(*chain[-1], steps[-1])
                return steps
        raise _refusal(chain[-1][0], f"the move has not ended after {_LONGEST:g} s")

    def _announce(self, index: int, move: Move, start: np.ndarray, first: bool) -> None:
        frames = (tuple(pose_to_pos(frame).tolist()) for frame in self._frames(move))
        via = () if move.via is None else self._coordinates(move.via)
        points = self._joints(start), self._coordinates(move.target), via
        try:
            self._library.announce(_MoveCall(move, Pdl2Settings.of(move.settings), *points, *frames), first)
        except _CallRefused as refused:
            raise _refusal(index, f"the library refuses the move: {refused}") from None

    def _check_arrived(self, index: int, move: Move, step: np.ndarray) -> None:
        away = float(self._away(move, step[None])[0])
        if away > _ARRIVED:
            degrees = isinstance(move.target, JointTarget)
            far = f"{np.degrees(away):.3g} degrees" if degrees else f"{1e3 * away:.3g} mm"
            raise _refusal(index, f"the library ended {far} from the target: another arm or other frames?")

    def _away(self, move: Move, q: np.ndarray) -> np.ndarray:
        """How far (N,) [rad or m] joint positions (N, n) are from the move's target."""
        if isinstance(move.target, JointTarget):
            return np.asarray(np.abs(q - move.target.position).max(axis=1))
        tool = self._frames(move)[1]
        flange = self._kinematics.forward(q) @ np.linalg.inv(self._tool)
        target = pose_in_robot_base(move.target, move.settings)[:3, 3]
        return np.asarray(np.linalg.norm((flange @ tool)[:, :3, 3] - target, axis=1))

    def _owners(self, chain: list[tuple[int, Move]], q: np.ndarray) -> np.ndarray:
        """Statement of each sample: a move ends where its target is nearest, as the library does not say."""
        owner = np.full(len(q), chain[-1][0])
        begin = 0
        for index, move in chain[:-1]:
            end = begin + int(np.argmin(self._away(move, q[begin:]))) + 1
            owner[begin:end] = index
            begin = min(end, len(q) - 1)
        return owner

    def _frames(self, move: Move) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        settings = move.settings
        tool = self._tool if settings.tool is None else matrix_of(settings.tool)
        return matrix_of(settings.base), tool, matrix_of(settings.uframe)

    def _coordinates(self, target: Target) -> tuple[float, ...]:
        if isinstance(target, JointTarget):
            return self._joints(target.position)
        return tuple(pose_to_pos(target.pose).tolist())

    def _joints(self, q: np.ndarray) -> tuple[float, ...]:
        return tuple(np.where(self._sliding, 1e3 * np.asarray(q), np.degrees(q)).tolist())

    def _trajectory(self, q: np.ndarray, move: np.ndarray) -> Trajectory:
        padded = np.concatenate((q[:1], q, q[-1:]))
        qd = (padded[2:] - padded[:-2]) / (2.0 * self.period)
        qdd = (padded[2:] - 2.0 * q + padded[:-2]) / self.period**2
        tcp = self._kinematics.forward(q)
        points = np.concatenate((tcp[:1, :3, 3], tcp[:, :3, 3], tcp[-1:, :3, 3]))
        speed = np.linalg.norm(points[2:] - points[:-2], axis=1) / (2.0 * self.period)
        return Trajectory(np.arange(len(q)) * self.period, q, qd, qdd, tcp, speed, move)


def _refusal(index: int, message: str) -> MotionError:
    return MotionError(f"statement {index + 1}: {message}", index, "orl", 1.0)


def _loaded(library: str | Path | None) -> _VendorCalls | _ShimCalls:
    path = str(library or os.environ.get(LIBRARY) or "")
    if not path:
        raise InputError(
            f"the orl interpolator needs the vendor's library: set {LIBRARY} to its path, or use the interpolator fly"
        )
    try:
        loaded = ctypes.CDLL(path)
    except OSError as error:
        raise InputError(f"{path}: the ORL library does not load: {error}") from None
    try:
        if hasattr(loaded, "calibration_interpolator_period"):
            return _ShimCalls(loaded)
        return _vendor_calls(path, os.environ.get(CONTROLLER, ""), os.environ.get(ARM, "1"))
    except AttributeError as error:
        raise InputError(f"{path}: not an ORL library, nor one of docs/orl_shim.h: {error}") from None


def _check_status(call: str, status: int) -> None:
    if status != 0:
        raise _CallRefused(f"{call}: status {status}")


def _flags(target: Target | None) -> bytes:
    """The target's configuration string, which has 79 characters at most in either library."""
    flags = target.configuration.encode() if isinstance(target, CartesianTarget) else b""
    if len(flags) > 79:
        raise _CallRefused(f"a configuration of {len(flags)} characters: the library takes 79")
    return flags


_WORDS = ("fly_type", "fly_trajectory", "speed_option", "orientation", "termination")
_NUMBERS = ("fly_percent", "stress_percent", "linear_speed", "rotational_speed")
_OVERRIDES = ("speed_override", "acceleration_override", "deceleration_override", "arm_override")
_POINTS, _FRAMES = ("start", "target", "via"), ("base", "tool", "uframe")


def _number(word: Enum) -> int:
    """Words of the shim number from 0 in the order of our enumerations."""
    return list(type(word)).index(word)


class _ShimMove(ctypes.Structure):
    """`calibration_move` of docs/orl_shim.h: settings by their own names, overrides in percent."""

    _fields_ = (
        *[(name, ctypes.c_int) for name in ("size", "joints", "first", "fly", "movement", *_WORDS)],
        *[(name, ctypes.c_int) for name in ("target_is_joints", "via_is_joints")],
        *[(name, ctypes.c_double) for name in ("fly_distance", *_NUMBERS, *_OVERRIDES)],
        *[(name, ctypes.c_double * _MOST_JOINTS) for name in _POINTS],
        *[(name, ctypes.c_double * 6) for name in _FRAMES],
        ("configuration", ctypes.c_char * 80),
    )


class _ShimCalls:
    """The calls of a shim. All calls but `step` and `cancel` raise `_CallRefused` where the library refuses."""

    def __init__(self, library: ctypes.CDLL):
        self._library = library
        library.calibration_interpolator_period.argtypes = [ctypes.c_double]
        library.calibration_interpolator_move.argtypes = [ctypes.POINTER(_ShimMove)]
        library.calibration_interpolator_step.argtypes = [ctypes.POINTER(ctypes.c_double)]
        self.cancel = library.calibration_interpolator_cancel

    def set_period(self, milliseconds: float) -> None:
        _check_status("calibration_interpolator_period", self._library.calibration_interpolator_period(milliseconds))

    def announce(self, call: _MoveCall, first: bool) -> None:
        data = _ShimMove(
            size=ctypes.sizeof(_ShimMove),
            joints=len(call.start),
            first=first,
            fly=call.move.fly,
            movement=_number(call.move.type),
            **{name: _number(getattr(call.settings, name)) for name in _WORDS},
            target_is_joints=isinstance(call.move.target, JointTarget),
            via_is_joints=isinstance(call.move.via, JointTarget),
            fly_distance=1e3 * call.settings.fly_distance,
            **{name: getattr(call.settings, name) for name in _NUMBERS},
            **{name: 100.0 * getattr(call.settings, name) for name in _OVERRIDES},
            **{name: getattr(call, name) for name in (*_POINTS, *_FRAMES)},
            configuration=_flags(call.move.target),
        )
        _check_status("calibration_interpolator_move", self._library.calibration_interpolator_move(ctypes.byref(data)))

    def step(self, count: int) -> tuple[int, list[float]]:
        joints = (ctypes.c_double * _MOST_JOINTS)()
        return self._library.calibration_interpolator_step(joints), list(joints[:count])


class _CartesianPosition(ctypes.Structure):
    _fields_ = (
        ("unit_type", ctypes.c_int),
        *[(name, ctypes.c_double) for name in ("x", "y", "z", "a", "e", "r")],
        ("config_flags", ctypes.c_char * 80),
    )


class _JointValue(ctypes.Structure):
    _fields_ = (("unit_type", ctypes.c_int), ("value", ctypes.c_double * _MOST_JOINTS))


class _SystemVariable(ctypes.Structure):
    """A system variable by name, with its type (1 integer, 3 real) and the value of that type."""

    _fields_ = (
        *[(name, ctypes.c_int) for name in ("ctype", "permission", "iv")],
        ("dv", ctypes.c_double),
        ("sv", ctypes.c_char * 255),
        ("sysvar_name", ctypes.c_char * 80),
    )


# Constants of the published header: units, kinds of fly parameters, and the words of each setting.
_SILENT, _FIRST_CONTROLLER, _LINK_DEGREE, _CARTESIAN, _FLY_PERCENT, _FLY_DISTANCE, _ROTATION = 0, 0, 3, 50, 7, 8, 1
_CODES: dict[Enum, int] = {
    **{MoveType.JOINT: 1, MoveType.LINEAR: 2, MoveType.CIRCULAR: 4},
    **{FlyTrajectory.FLY_AUTO: 3, FlyTrajectory.FLY_PASS: 4, FlyTrajectory.FLY_TOL: 5, FlyTrajectory.FLY_FROM: 6},
    **{SpeedOption.SPD_LIN: 1, SpeedOption.SPD_ROT: 2, SpeedOption.SPD_JNT: 3, SpeedOption.SPD_CONST: 4},
    **{OrientationType.RS_WORLD: 2, OrientationType.EUL_WORLD: 3, OrientationType.WRIST_JNT: 4},
    OrientationType.RS_TRAJ: 6,
    **{Termination.FINE: 0, Termination.COARSE: 1, Termination.NOSETTLE: 2},
    **{Termination.JNT_FINE: 3, Termination.JNT_COARSE: 4},
}
# Each call ends with verbose and controller, most with the arm as well.
_PLACE = [ctypes.c_int] * 3
_TARGETS = [ctypes.POINTER(_CartesianPosition), ctypes.POINTER(_JointValue)]
_CALLS: dict[str, list[Any]] = {
    "ORL_initialize_controller": [ctypes.c_char_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_int],
    "ORL_terminate_controller": [ctypes.c_int, ctypes.c_int],
    "ORL_initialize_frames": [*[_CartesianPosition] * 3, *_PLACE],
    "ORL_select_point_accuracy": [ctypes.c_int, *_PLACE],
    "ORL_set_interpolation_time": [ctypes.c_double, *_PLACE],
    "ORL_get_next_interpolation_step": [ctypes.POINTER(_JointValue), *_PLACE],
    "ORL_set_position": [*_TARGETS, *_PLACE],
    "ORL_set_move_parameters": [*[ctypes.c_int] * 4, *_TARGETS, *_PLACE],
    "ORL_set_data": [_SystemVariable, ctypes.c_int, ctypes.c_int],
    "ORL_dominant_interpolation": [ctypes.c_int, ctypes.c_int, *_PLACE],
    "ORL_orientation_interpolation": [ctypes.c_int, *_PLACE],
    "ORL_cancel_motion": _PLACE,
    "ORL_set_fly_parameter": [ctypes.c_int, ctypes.c_double, *_PLACE],
}


# The library keeps one controller's state for the process: initialised once, however many interpolators there are.
@cache
def _vendor_calls(path: str, controller: str, arm: str) -> _VendorCalls:
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
    if status != 0:
        raise InputError(f"ORL_initialize_controller refuses {controller}: status {status}")
    atexit.register(library.ORL_terminate_controller, _SILENT, _FIRST_CONTROLLER)
    return _VendorCalls(library, int(arm))


class _VendorCalls:
    """The vendor's own calls, offered as those of the shim are."""

    def __init__(self, library: ctypes.CDLL, arm: int):
        self._library, self._arm = library, arm
        self._place = (_SILENT, _FIRST_CONTROLLER, arm - 1)

    def set_period(self, milliseconds: float) -> None:
        self._call("ORL_set_interpolation_time", milliseconds)

    def announce(self, call: _MoveCall, first: bool) -> None:
        move, settings = call.move, call.settings
        if first:
            self._call("ORL_set_position", None, _JointValue(_LINK_DEGREE, call.start))
        frames = (_CartesianPosition(_CARTESIAN, *frame) for frame in (call.base, call.tool, call.uframe))
        self._call("ORL_initialize_frames", *frames)
        self._call("ORL_select_point_accuracy", _CODES[settings.termination])
        self._call("ORL_orientation_interpolation", _CODES[settings.orientation])
        self._call("ORL_dominant_interpolation", _CODES[settings.speed_option], _ROTATION)
        self._set("LIN_SPD", ctype=3, dv=settings.linear_speed)
        self._set("ROT_SPD", ctype=3, dv=settings.rotational_speed)
        for name, override in zip(("SPD_OVR", "ACC_OVR", "DEC_OVR", "ARM_OVR"), _OVERRIDES, strict=True):
            self._set(name, ctype=1, iv=round(100.0 * getattr(settings, override)))
        fly_type = 0
        if move.fly and settings.fly_type is FlyType.FLY_CART:
            fly_type = _CODES[settings.fly_trajectory]
            self._set("STRESS_PER", ctype=1, iv=round(settings.stress_percent))
            self._call("ORL_set_fly_parameter", _FLY_DISTANCE, 1e3 * settings.fly_distance)
        elif move.fly:
            self._call("ORL_set_fly_parameter", _FLY_PERCENT, settings.fly_percent)
        # A circle takes two calls: where it ends, then what it passes.
        for target, values in ((move.target, call.target), (move.via, call.via)):
            if target is None:
                continue
            joints = isinstance(target, JointTarget)
            pair = (
                None if joints else _CartesianPosition(_CARTESIAN, *values, _flags(target)),
                _JointValue(_LINK_DEGREE, values) if joints else None,
            )
            # ORL_FLY with ORL_ADVANCE, ORL_NO_FLY with ORL_WAIT: both pairs are 1, 1 and 0, 0.
            self._call("ORL_set_move_parameters", move.fly, move.fly, fly_type, _CODES[move.type], *pair)

    def step(self, count: int) -> tuple[int, list[float]]:
        joints = _JointValue(_LINK_DEGREE)
        status = self._library.ORL_get_next_interpolation_step(joints, *self._place)
        return status, list(joints.value[:count])

    def cancel(self) -> None:
        # Nothing to cancel is an error to the library, and none to us.
        self._library.ORL_cancel_motion(*self._place)

    def _call(self, name: str, *arguments: object) -> None:
        _check_status(name, getattr(self._library, name)(*arguments, *self._place))

    def _set(self, name: str, **value: float) -> None:
        full = f"$ARM_DATA[{self._arm}].{name}"
        variable = _SystemVariable(sysvar_name=full.encode(), **value)
        _check_status(f"ORL_set_data of {full}", self._library.ORL_set_data(variable, _SILENT, _FIRST_CONTROLLER))
