"""The vendor's own interpolator, where a user has its library: moves announced and stepped through.

`agent.motion.orl_calls` holds the library's calls, `docs/decisions/orl-adapter.md` says what of them is known.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion.frames import pose_in_robot_base, tool_frame
from agent.motion.interpolator import MotionError
from agent.motion.orl_calls import (
    ARM,
    CONTROLLER,
    FINAL,
    IDLE,
    LIBRARY,
    MOST_ANNOUNCED,
    MOST_JOINTS,
    MOVING,
    NEED_DATA,
    CallRefused,
    Calls,
    MoveCall,
)
from agent.motion.orl_shim import ShimCalls
from agent.motion.orl_vendor import vendor_calls
from agent.motion.pdl2.frames import pose_to_pos
from agent.motion.program import Delay, JointTarget, Move, Statement, Target, matrix_of
from agent.motion.trajectory import Trajectory
from agent.robot import RobotDescription, kinematics_for

if TYPE_CHECKING:
    from agent.robot import Tool

#: [s] no chain of moves may take longer.
_LONGEST = 3600.0
#: [rad or m] A chain that ends further from its target than this was not the one we announced.
_ARRIVED = 5e-3


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
        self.robot = robot
        self.period = period
        self._kinematics = kinematics_for(robot, tool)
        self._tool = tool_frame(tool)
        self._sliding = np.array([joint.prismatic for joint in robot.joints])
        if robot.dof > MOST_JOINTS:
            raise InputError(f"the robot has {robot.dof} joints, the ORL library takes {MOST_JOINTS}")
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

    def _set_period(self) -> None:
        try:
            self._library.set_period(1e3 * self.period)
        except CallRefused as refused:
            raise InputError(f"the library refuses a period of {1e3 * self.period:g} ms: {refused}") from None

    def _stepped(self, chain: list[tuple[int, Move]], start: np.ndarray) -> np.ndarray:
        try:
            return self._chain(chain, start)
        except MotionError:
            self._library.cancel()
            raise

    def _chain(self, chain: list[tuple[int, Move]], start: np.ndarray) -> np.ndarray:
        announced = 0
        for _ in chain[:MOST_ANNOUNCED]:
            self._announce(*chain[announced], start, first=announced == 0)
            announced += 1
        steps: list[np.ndarray] = []
        while len(steps) * self.period <= _LONGEST:
            status, joints = self._library.step(self.robot.dof)
            if status not in (MOVING, NEED_DATA, FINAL):
                idle = "the library has nothing to move before the move has ended"
                raise _refusal(chain[announced - 1][0], idle if status == IDLE else f"no next step: status {status}")
            steps.append(self._from_controller(np.array(joints)))
            if len(steps) == 1:
                self._check_first(chain[0][0], start, steps[0])
            if status == NEED_DATA and announced < len(chain):
                self._announce(*chain[announced], start, first=False)
                announced += 1
            if status == FINAL:
                self._check_last(chain, announced, steps[-1])
                return np.array(steps)
        raise _refusal(chain[-1][0], f"the move has not ended after {_LONGEST:g} s")

    def _announce(self, index: int, move: Move, start: np.ndarray, first: bool) -> None:
        base, tool, uframe = (tuple(pose_to_pos(frame).tolist()) for frame in self._frames(move))
        via = () if move.via is None else self._coordinates(move.via)
        call = MoveCall(move, self._to_controller(start), self._coordinates(move.target), via, base, tool, uframe)
        try:
            self._library.announce(call, first)
        except CallRefused as refused:
            raise _refusal(index, f"the library refuses the move: {refused}") from None

    def _check_first(self, index: int, start: np.ndarray, step: np.ndarray) -> None:
        jump = np.abs(step - start)
        if np.any(jump > 2.0 * self.robot.max_velocity * self.period):
            away = np.degrees(jump.max())
            raise _refusal(index, f"the library's arm is {away:.3g} degrees away from where ours starts")

    def _check_last(self, chain: list[tuple[int, Move]], announced: int, step: np.ndarray) -> None:
        if announced < len(chain):
            raise _refusal(chain[announced - 1][0], "the library ended the move before it asked for the next")
        index, move = chain[-1]
        away = float(self._away(move, step[None])[0])
        if away > _ARRIVED:
            unit = "degrees" if isinstance(move.target, JointTarget) else "mm"
            far = np.degrees(away) if unit == "degrees" else 1e3 * away
            raise _refusal(index, f"the library ended {far:.3g} {unit} from the target: another arm or other frames?")

    def _away(self, move: Move, q: np.ndarray) -> np.ndarray:
        """How far (N,) [rad or m] joint positions (N, n) are from the move's target."""
        if isinstance(move.target, JointTarget):
            return np.asarray(np.abs(q - move.target.position).max(axis=1))
        tool = self._frames(move)[1]
        flange = self._kinematics.forward(q) @ np.linalg.inv(self._tool)
        target = pose_in_robot_base(move.target, move.settings)[:3, 3]
        return np.asarray(np.linalg.norm((flange @ tool)[:, :3, 3] - target, axis=1))

    def _statements(self, chain: list[tuple[int, Move]], q: np.ndarray) -> np.ndarray:
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
            return self._to_controller(target.position)
        return tuple(pose_to_pos(target.pose).tolist())

    def _to_controller(self, q: np.ndarray) -> tuple[float, ...]:
        return tuple(np.where(self._sliding, 1e3 * np.asarray(q), np.degrees(q)).tolist())

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


def _loaded(library: str | Path | None) -> Calls:
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
            return ShimCalls(loaded)
        return vendor_calls(path, os.environ.get(CONTROLLER, ""), os.environ.get(ARM, "1"))
    except AttributeError as error:
        raise InputError(f"{path}: not an ORL library, nor one of docs/orl_shim.h: {error}") from None


def _refusal(index: int, message: str) -> MotionError:
    return MotionError(f"statement {index + 1}: {message}", index, "orl", 1.0)
