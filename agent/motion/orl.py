"""The vendor's own interpolator, for users who have its library: moves are announced, then stepped through.

The calls are those of the published header (`eORL.h` of 2013, `docs/decisions/orl-adapter.md`). They take millimetres,
degrees and percent.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from cffi import FFI

from agent.core import InputError
from agent.motion.interpolator import MotionError, Trajectory
from agent.motion.path_settings import FlyTrajectory, FlyType, OrientationType, SpeedOption
from agent.motion.pdl2.settings import Pdl2Settings, Termination
from agent.motion.pdl2.variables import pose_to_pos
from agent.motion.program import (
    Delay,
    JointTarget,
    Move,
    MoveType,
    Statement,
    matrix_of,
    pose_in_robot_base,
    tool_frame,
)
from agent.robot import RobotDescription, kinematics_for

if TYPE_CHECKING:
    from agent.robot import Tool

#: Environment variables: the library, the controller's file (*.c5g) and the arm in it (1 to 4).
LIBRARY, CONTROLLER, ARM = "CALIBRATION_ORL_LIBRARY", "CALIBRATION_ORL_CONTROLLER", "CALIBRATION_ORL_ARM"

#: Status of a step; any other is an error. NEED_DATA: the arm is moving and the next move may be announced.
_MOVING, _NEED_DATA, _FINAL, _IDLE = 0, 1, 2, -42
#: One move is active and one more is scheduled; a third waits for NEED_DATA.
_MOST_ANNOUNCED = 2
_MOST_JOINTS, _MOST_FLAGS = 10, 79  # of the header's arrays
#: [s] Longest chain of moves.
_LONGEST = 3600.0
#: [rad or m] A chain that ends further from its target than this was run by another arm or in other frames.
_ARRIVED = 5e-3

# Constants of the published header: units, kinds of fly parameters, and the words of each setting.
_SILENT, _FIRST_CONTROLLER, _LINK_DEGREE, _CARTESIAN, _FLY_PERCENT, _FLY_DISTANCE, _ROTATION = 0, 0, 3, 50, 7, 8, 1
_INTEGER, _REAL = 1, 3
_CODES: dict[Enum, int] = {
    **{MoveType.JOINT: 1, MoveType.LINEAR: 2, MoveType.CIRCULAR: 4},
    **{FlyTrajectory.FLY_AUTO: 3, FlyTrajectory.FLY_PASS: 4, FlyTrajectory.FLY_TOL: 5, FlyTrajectory.FLY_FROM: 6},
    **{SpeedOption.SPD_LIN: 1, SpeedOption.SPD_ROT: 2, SpeedOption.SPD_JNT: 3, SpeedOption.SPD_CONST: 4},
    **{OrientationType.RS_WORLD: 2, OrientationType.EUL_WORLD: 3, OrientationType.WRIST_JNT: 4},
    OrientationType.RS_TRAJ: 6,
    **{Termination.FINE: 0, Termination.COARSE: 1, Termination.NOSETTLE: 2},
    **{Termination.JNT_FINE: 3, Termination.JNT_COARSE: 4},
}


#: Declarations of the published header. Each call ends with verbose and controller, most with the arm as well.
_HEADER = """
typedef struct { int unit_type; double x, y, z, a, e, r; char config_flags[80]; } pose;
typedef struct { int unit_type; double value[10]; } joints;
typedef struct { int ctype, permission, iv; double dv; char sv[255], sysvar_name[80]; } variable;

int ORL_initialize_controller(const char *file, const char *folder, int verbose, int controller);
int ORL_terminate_controller(int verbose, int controller);
int ORL_initialize_frames(pose base, pose tool, pose uframe, int verbose, int controller, int arm);
int ORL_select_point_accuracy(int termination, int verbose, int controller, int arm);
int ORL_set_interpolation_time(double milliseconds, int verbose, int controller, int arm);
int ORL_get_next_interpolation_step(joints *step, int verbose, int controller, int arm);
int ORL_set_position(pose *, joints *, int verbose, int controller, int arm);
int ORL_set_move_parameters(int fly, int advance, int fly_type, int move, pose *, joints *,
                            int verbose, int controller, int arm);
int ORL_set_data(variable set, int verbose, int controller);
int ORL_dominant_interpolation(int speed, int rotation, int verbose, int controller, int arm);
int ORL_orientation_interpolation(int orientation, int verbose, int controller, int arm);
int ORL_cancel_motion(int verbose, int controller, int arm);
int ORL_set_fly_parameter(int kind, double value, int verbose, int controller, int arm);
"""
_FFI = FFI()
_FFI.cdef(_HEADER)


class _CallRefused(Exception):
    """A call with an error status; its text names the call."""


# The library keeps one controller's state for the process: initialised once, however many interpolators there are.
@cache
def _started(path: str, controller: str, arm: str) -> Any:
    """The library at `path`, started from the controller's file for one of its arms ("1" to "4").

    Raises:
        InputError: no such library, file or arm, a call is missing, or the library does not start.
    """
    try:
        library = _FFI.dlopen(path)
    except OSError as error:
        raise InputError(f"{path}: the ORL library does not load: {error}") from None
    try:
        for name in dir(library):
            getattr(library, name)
    except AttributeError as error:
        raise InputError(f"{path}: not an ORL library: {error}") from None
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
    return library


class OrlInterpolator:
    """Plans programs by stepping the vendor's interpolator. One at a time in a process: the library keeps the state.

    `library` is its path; by default the environment variable CALIBRATION_ORL_LIBRARY names it. The library starts
    from the controller's file (CALIBRATION_ORL_CONTROLLER), for its first arm or CALIBRATION_ORL_ARM.

    Raises:
        InputError: no library or controller file, a library that does not load or lacks a call, a refused period.
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
        path, arm = str(library or os.environ.get(LIBRARY) or ""), os.environ.get(ARM, "1")
        if not path:
            raise InputError(
                f"the orl interpolator needs the vendor's library: set {LIBRARY} to its path, or use the interpolator "
                "fly"
            )
        self._library, self._arm = _started(path, os.environ.get(CONTROLLER, ""), arm), int(arm)
        self._arm_identifiers = (_SILENT, _FIRST_CONTROLLER, self._arm - 1)
        self._set_period()

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) to rest; velocities by differences of positions.

        Raises:
            MotionError: the library refuses a move, its arm does not start at `start` or end at the target, or it ends
                a flying move before it asks for the next.
        """
        # The library is one for the process, and another interpolator may have set its own period.
        self._set_period()
        position = np.asarray(start, dtype=float)
        samples, owners = [position[None]], [np.zeros(1, dtype=int)]
        chain: list[tuple[int, Move]] = []
        for index, statement in enumerate(statements):
            if isinstance(statement, Delay):
                samples.append(np.tile(position, (round(statement.seconds / self.period), 1)))
                owners.append(np.full(len(samples[-1]), index))
                continue
            chain.append((index, statement))
            if statement.fly and isinstance([*statements[index + 1 :], None][0], Move):
                continue
            try:
                samples.append(self._steps(chain, position))
            except MotionError:
                # Nothing to cancel is an error to the library, and none to us.
                self._library.ORL_cancel_motion(*self._arm_identifiers)
                raise
            owners.append(self._owners(chain, samples[-1]))
            position, chain = samples[-1][-1], []
        return self._trajectory(np.concatenate(samples), np.concatenate(owners))

    def _set_period(self) -> None:
        try:
            self._call("ORL_set_interpolation_time", 1e3 * self.period)
        except _CallRefused as refused:
            raise InputError(f"the library refuses a period of {1e3 * self.period:g} ms: {refused}") from None

    def _call(self, name: str, *arguments: object) -> None:
        status = getattr(self._library, name)(*arguments, *self._arm_identifiers)
        if status != 0:
            raise _CallRefused(f"{name}: status {status}")

    def _set(self, name: str, value: float) -> None:
        """Set a system variable of the arm: an INTEGER where the value is one, else a REAL."""
        full = f"$ARM_DATA[{self._arm}].{name}"
        number = {"ctype": _INTEGER, "iv": value} if isinstance(value, int) else {"ctype": _REAL, "dv": value}
        variable = _FFI.new("variable *", {"sysvar_name": full.encode(), **number})
        status = self._library.ORL_set_data(variable[0], _SILENT, _FIRST_CONTROLLER)
        if status != 0:
            raise _CallRefused(f"ORL_set_data of {full}: status {status}")

    def _steps(self, chain: list[tuple[int, Move]], start: np.ndarray) -> np.ndarray:
        """Set-points (S, n) of moves from stop to stop."""
        announced = min(_MOST_ANNOUNCED, len(chain))
        for (index, move), standstill in zip(chain[:announced], (start, None), strict=False):
            self._announce(index, move, standstill)
        steps: list[np.ndarray] = []
        while len(steps) * self.period <= _LONGEST:
            joints = self._joints()
            status = self._library.ORL_get_next_interpolation_step(joints, *self._arm_identifiers)
            if status not in (_MOVING, _NEED_DATA, _FINAL):
                idle = "the library has nothing to move before the move has ended"
                raise _refusal(chain[announced - 1][0], idle if status == _IDLE else f"no next step: status {status}")
            q = np.array(list(joints.value)[: self.robot.dof])
            steps.append(np.where(self._sliding, 1e-3 * q, np.radians(q)))
            jump = np.abs(steps[0] - start)
            if len(steps) == 1 and np.any(jump > 2.0 * self.robot.max_velocity * self.period):
                degrees_off = np.degrees(jump.max())
                raise _refusal(
                    chain[0][0], f"the library's arm is {degrees_off:.3g} degrees away from where ours starts"
                )
            if status == _NEED_DATA and announced < len(chain):
                self._announce(*chain[announced], None)
                announced += 1
            if status == _FINAL:
                if announced < len(chain):
                    raise _refusal(chain[announced - 1][0], "the library ended the move before it asked for the next")
                self._check_arrival(*chain[-1], steps[-1])
                return np.array(steps)
        raise _refusal(chain[-1][0], f"the move has not ended after {_LONGEST:g} s")

    def _announce(self, index: int, move: Move, start: np.ndarray | None) -> None:
        """Announce a move; `start` (n,) is where the arm rests before it, None on the way."""
        settings = Pdl2Settings.of(move.settings)
        try:
            if start is not None:
                self._call("ORL_set_position", _FFI.NULL, self._joints(start))
            frames = (matrix_of(settings.base), self._tool_of(move), matrix_of(settings.uframe))
            self._call("ORL_initialize_frames", *(_pose(frame)[0] for frame in frames))
            self._call("ORL_select_point_accuracy", _CODES[settings.termination])
            self._call("ORL_orientation_interpolation", _CODES[settings.orientation])
            self._call("ORL_dominant_interpolation", _CODES[settings.speed_option], _ROTATION)
            self._set("LIN_SPD", float(settings.linear_speed))
            self._set("ROT_SPD", float(settings.rotational_speed))
            self._set("SPD_OVR", round(100.0 * settings.speed_override))
            self._set("ACC_OVR", round(100.0 * settings.acceleration_override))
            self._set("DEC_OVR", round(100.0 * settings.deceleration_override))
            self._set("ARM_OVR", round(100.0 * settings.arm_override))
            fly_type = 0
            if move.fly and settings.fly_type is FlyType.FLY_CART:
                fly_type = _CODES[settings.fly_trajectory]
                self._set("STRESS_PER", round(settings.stress_percent))
                self._call("ORL_set_fly_parameter", _FLY_DISTANCE, 1e3 * settings.fly_distance)
            elif move.fly:
                self._call("ORL_set_fly_parameter", _FLY_PERCENT, settings.fly_percent)
            # A circle takes two calls: its end, then its via-point.
            for target in (move.target,) if move.via is None else (move.target, move.via):
                pose = joints = _FFI.NULL
                if isinstance(target, JointTarget):
                    joints = self._joints(target.position)
                elif len(flags := target.configuration.encode()) <= _MOST_FLAGS:
                    pose = _pose(target.pose, flags)
                else:
                    long = f"a configuration of {len(flags)} characters"
                    raise _CallRefused(f"{long}: the library takes {_MOST_FLAGS}")
                # ORL_FLY with ORL_ADVANCE, ORL_NO_FLY with ORL_WAIT: both pairs are 1, 1 and 0, 0.
                self._call("ORL_set_move_parameters", move.fly, move.fly, fly_type, _CODES[move.type], pose, joints)
        except _CallRefused as refused:
            raise _refusal(index, f"the library refuses the move: {refused}") from None

    def _check_arrival(self, index: int, move: Move, q: np.ndarray) -> None:
        if (distance := float(self._distances(move, q[None])[0])) > _ARRIVED:
            far = (
                f"{np.degrees(distance):.3g} degrees"
                if isinstance(move.target, JointTarget)
                else f"{1e3 * distance:.3g} mm"
            )
            raise _refusal(index, f"the library ended {far} from the target: another arm or other frames?")

    def _distances(self, move: Move, q: np.ndarray) -> np.ndarray:
        """Distance (N,) [rad or m] of joint positions (N, n) from the move's target."""
        if isinstance(move.target, JointTarget):
            return np.asarray(np.abs(q - move.target.position).max(axis=1))
        flange = self._kinematics.forward(q) @ np.linalg.inv(self._tool)
        target = pose_in_robot_base(move.target, move.settings)[:3, 3]
        return np.asarray(np.linalg.norm((flange @ self._tool_of(move))[:, :3, 3] - target, axis=1))

    def _owners(self, chain: list[tuple[int, Move]], q: np.ndarray) -> np.ndarray:
        """Statement of each sample: a move ends where its target is nearest, as the library does not say."""
        owner = np.full(len(q), chain[-1][0])
        begin = 0
        for index, move in chain[:-1]:
            end = begin + int(np.argmin(self._distances(move, q[begin:]))) + 1
            owner[begin:end] = index
            begin = min(end, len(q) - 1)
        return owner

    def _tool_of(self, move: Move) -> np.ndarray:
        return self._tool if move.settings.tool is None else matrix_of(move.settings.tool)

    def _joints(self, q: np.ndarray | Sequence[float] = ()) -> Any:
        """Joint positions (n,) [rad, m] as the library takes them; without any, zeros that a step overwrites."""
        values = np.where(self._sliding, 1e3 * np.asarray(q), np.degrees(q)).tolist() if len(q) else ()
        return _FFI.new("joints *", (_LINK_DEGREE, values))

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


def _pose(pose: np.ndarray, flags: bytes = b"") -> Any:
    return _FFI.new("pose *", (_CARTESIAN, *pose_to_pos(pose).tolist(), flags))
