"""The vendor's own interpolator, where a user has its library: stepped through ctypes.

`docs/orl_shim.h` is the interface a library has to export, `docs/decisions/orl-adapter.md` says why it is that.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agent.core.errors import InputError
from agent.motion.interpolator import MotionError
from agent.motion.path import rotation
from agent.motion.program import (
    CartesianTarget,
    Delay,
    FlyTrajectory,
    FlyType,
    JointTarget,
    Move,
    MoveType,
    OrientationType,
    SpeedOption,
    Statement,
    Target,
    Termination,
)
from agent.motion.trajectory import Trajectory
from agent.robot.description import RobotDescription
from agent.robot.kinematics import kinematics_for

if TYPE_CHECKING:
    from agent.robot.dynamics import Tool

#: Environment variable that names the library.
LIBRARY = "CALIBRATION_ORL_LIBRARY"
_MOVING, _FINAL, _IDLE = 0, 2, -42
_MOST_JOINTS = 10
#: [s] no chain of moves may take longer.
_LONGEST = 3600.0


class _OrlMove(ctypes.Structure):
    _fields_ = (
        *[
            (name, ctypes.c_int)
            for name in (
                "size",
                "joints",
                "first",
                "movement",
                "fly",
                "fly_type",
                "fly_trajectory",
                "speed_option",
                "orientation",
                "termination",
                "target_is_joints",
                "reserved",
            )
        ],
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
        ("start", ctypes.c_double * _MOST_JOINTS),
        ("target", ctypes.c_double * _MOST_JOINTS),
        *[(name, ctypes.c_double * 6) for name in ("via", "base", "tool", "uframe")],
        ("configuration", ctypes.c_char * 64),
    )


class OrlInterpolator:
    """Plans programs by stepping the vendor's interpolator. One at a time in a process: the library keeps the state.

    `library` is its path; without one the environment variable CALIBRATION_ORL_LIBRARY names it.

    Raises:
        InputError: no library, one that does not load, or one that lacks a call.
    """

    def __init__(
        self,
        robot: RobotDescription,
        tool: Tool | None = None,
        period: float = 0.002,
        library: str | Path | None = None,
    ):
        self.robot = robot
        self.period = period
        self._kinematics = kinematics_for(robot, tool)
        self._tool = np.eye(4) if tool is None else np.asarray(tool.frame, dtype=float)
        self._sliding = np.array([joint.prismatic for joint in robot.joints])
        self._library = _loaded(library)
        status = self._library.ORL_set_interpolation_time(1e3 * period)
        if status != 0:
            raise InputError(f"ORL_set_interpolation_time refuses {1e3 * period:g} ms: status {status}")

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) to rest; velocities by differences of positions.

        Raises:
            MotionError: the library refuses a move, or its arm does not start where ours stands.
        """
        samples, moves = [np.asarray(start, dtype=float)[None]], [np.zeros(1, dtype=int)]
        chain: list[tuple[int, Move]] = []
        for index, statement in enumerate(statements):
            if isinstance(statement, Delay):
                count = round(statement.seconds / self.period)
                samples.append(np.tile(samples[-1][-1], (count, 1)) if count else samples[-1][:0])
                moves.append(np.full(count, index))
                continue
            chain.append((index, statement))
            following = statements[index + 1] if index + 1 < len(statements) else None
            if not statement.fly or not isinstance(following, Move):
                now = next(part[-1] for part in reversed(samples) if len(part))
                samples.append(self._stepped(chain, now))
                moves.append(self._statements(chain, samples[-1]))
                chain = []
        return self._trajectory(np.concatenate(samples), np.concatenate(moves))

    def _stepped(self, chain: list[tuple[int, Move]], start: np.ndarray) -> np.ndarray:
        for k, (index, move) in enumerate(chain):
            status = self._library.ORL_set_move_parameters(ctypes.byref(self._move(move, start, k == 0)))
            if status != 0:
                raise _refusal(index, f"ORL_set_move_parameters refuses the move: status {status}")
        steps: list[np.ndarray] = []
        joints = (ctypes.c_double * _MOST_JOINTS)()
        while len(steps) * self.period <= _LONGEST:
            status = self._library.ORL_get_next_interpolation_step(joints)
            if status not in (_MOVING, _FINAL):
                idle = "the library has nothing to move before the move has ended"
                raise _refusal(chain[-1][0], idle if status == _IDLE else f"no next step: status {status}")
            steps.append(self._from_controller(np.array(joints[: self.robot.dof])))
            if len(steps) == 1:
                self._check_first(chain[0][0], start, steps[0])
            if status == _FINAL:
                return np.array(steps)
        raise _refusal(chain[-1][0], f"the move has not ended after {_LONGEST:g} s")

    def _check_first(self, index: int, start: np.ndarray, step: np.ndarray) -> None:
        jump = np.abs(step - start)
        if np.any(jump > 2.0 * self.robot.max_velocity * self.period):
            away = np.degrees(jump.max())
            raise _refusal(index, f"the library's arm is {away:.3g} degrees away from where ours starts")

    def _statements(self, chain: list[tuple[int, Move]], q: np.ndarray) -> np.ndarray:
        """Statement of each sample: a move ends where its target is nearest, as the library does not say."""
        owner = np.full(len(q), chain[-1][0])
        points = self._kinematics.forward(q)[:, :3, 3]
        begin = 0
        for index, move in chain[:-1]:
            if isinstance(move.target, JointTarget):
                away = np.abs(q[begin:] - move.target.position).max(axis=1)
            else:
                base, _, uframe = self._frames(move)
                away = np.linalg.norm(points[begin:] - np.linalg.solve(base, uframe @ move.target.pose)[:3, 3], axis=1)
            end = begin + int(np.argmin(away)) + 1
            owner[begin:end] = index
            begin = min(end, len(q) - 1)
        return owner

    def _move(self, move: Move, start: np.ndarray, first: bool) -> _OrlMove:
        settings = move.settings
        base, tool, uframe = self._frames(move)
        target = move.target
        return _OrlMove(
            size=ctypes.sizeof(_OrlMove),
            joints=self.robot.dof,
            first=first,
            movement=_number(move.type, MoveType),
            fly=move.fly,
            fly_type=_number(settings.fly_type, FlyType),
            fly_trajectory=_number(settings.fly_trajectory, FlyTrajectory),
            speed_option=_number(settings.speed_option, SpeedOption),
            orientation=_number(settings.orientation, OrientationType),
            termination=_number(settings.termination, Termination),
            target_is_joints=isinstance(target, JointTarget),
            fly_distance=1e3 * settings.fly_distance,
            fly_percent=settings.fly_percent,
            stress_percent=settings.stress_percent,
            linear_speed=settings.linear_speed,
            rotational_speed=settings.rotational_speed,
            speed_override=100.0 * settings.speed_override,
            acceleration_override=100.0 * settings.acceleration_override,
            deceleration_override=100.0 * settings.deceleration_override,
            arm_override=100.0 * settings.arm_override,
            start=tuple(self._to_controller(start)),
            target=tuple(self._coordinates(target)),
            via=tuple(np.zeros(6) if move.via is None else self._coordinates(move.via)),
            base=tuple(_coordinates(base)),
            tool=tuple(_coordinates(tool)),
            uframe=tuple(_coordinates(uframe)),
            configuration=target.configuration.encode() if isinstance(target, CartesianTarget) else b"",
        )

    def _frames(self, move: Move) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        settings = move.settings
        base = np.eye(4) if settings.base is None else np.array(settings.base)
        tool = self._tool if settings.tool is None else np.array(settings.tool)
        return base, tool, np.eye(4) if settings.uframe is None else np.array(settings.uframe)

    def _coordinates(self, target: Target) -> np.ndarray:
        return self._to_controller(target.position) if isinstance(target, JointTarget) else _coordinates(target.pose)

    def _to_controller(self, q: np.ndarray) -> np.ndarray:
        return np.where(self._sliding, 1e3 * np.asarray(q), np.degrees(q))

    def _from_controller(self, q: np.ndarray) -> np.ndarray:
        return np.where(self._sliding, 1e-3 * q, np.radians(q))

    def _trajectory(self, q: np.ndarray, move: np.ndarray) -> Trajectory:
        padded = np.concatenate((q[:1], q, q[-1:]))
        qd = (padded[2:] - padded[:-2]) / (2.0 * self.period)
        qdd = (padded[2:] - 2.0 * q + padded[:-2]) / self.period**2
        tcp = self._kinematics.forward(q)
        points = np.concatenate((tcp[:1, :3, 3], tcp[:, :3, 3], tcp[-1:, :3, 3]))
        speed = np.linalg.norm(points[2:] - points[:-2], axis=1) / (2.0 * self.period)
        return Trajectory(np.arange(len(q)) * self.period, q, qd, qdd, tcp, speed, move)


def _loaded(library: str | Path | None) -> ctypes.CDLL:
    path = library or os.environ.get(LIBRARY)
    if not path:
        raise InputError(
            f"the orl interpolator needs the vendor's library: set {LIBRARY} to its path (docs/orl_shim.h), "
            "or use the interpolator fly"
        )
    try:
        loaded = ctypes.CDLL(str(path))
    except OSError as error:
        raise InputError(f"{path}: the ORL library does not load: {error}") from None
    try:
        loaded.ORL_set_interpolation_time.argtypes = [ctypes.c_double]
        loaded.ORL_set_move_parameters.argtypes = [ctypes.POINTER(_OrlMove)]
        loaded.ORL_get_next_interpolation_step.argtypes = [ctypes.POINTER(ctypes.c_double)]
    except AttributeError as error:
        raise InputError(f"{path}: not an ORL library for docs/orl_shim.h: {error}") from None
    return loaded


def _refusal(index: int, message: str) -> MotionError:
    return MotionError(f"statement {index + 1}: {message}", index, "orl", 1.0)


def _number(value: Enum, kind: type[Enum]) -> int:
    return list(kind).index(value)


def _coordinates(pose: np.ndarray) -> np.ndarray:
    return np.concatenate((1e3 * pose[:3, 3], np.degrees(rotation.to_euler(pose[:3, :3]))))
