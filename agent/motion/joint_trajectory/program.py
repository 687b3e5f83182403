"""A program of joint trajectories as statements: written from a plan, and read (`drivers.joint_trajectory`)."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import InputError
from agent.motion.joint_trajectory.interpolator import JointTrajectoryLaw
from agent.motion.joint_trajectory.settings import PaceSettings, PointSettings
from agent.motion.program import Delay, JointTarget, Move, MoveType, Statement, stop_to_stop
from drivers.errors import RefusedError
from drivers.joint_trajectory import LEAD, GoalProgram, JointSpline, Step

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: How far a joint may be off [rad, m] before the controller itself stops the arm: a little more than the guard's 0.07
#: (`agent.safety`), so that the guard brakes first, and smoothly.
PATH_TOLERANCE = 0.1
_GOAL_TIME = 1.0  # s, after the last point
_DECIMALS = 9
_CLOSED = 1e-6  # rad, m: a loop that ends so near to its start ends there


class TrajectoryError(InputError):
    """A text that is no program of joint trajectories; names path and line."""


@dataclass(frozen=True, eq=False)
class TrajectoryProgram:
    """A program that was read: `lines` of statements, and how often each is run."""

    name: str
    lines: tuple[tuple[int, tuple[Statement, ...]], ...]

    def run(self) -> Iterator[Statement]:
        """Its moves and delays in order."""
        for cycles, statements in self.lines:
            for _ in range(cycles):
                yield from statements


class TrajectoryWriter:
    """Plans what is added from where the last of it ended, and writes its points.

    Raises:
        InputError: no robot to plan for.
    """

    def __init__(self, name: str, robot: RobotDescription | None) -> None:
        if robot is None:
            raise InputError(f"program {name}: joint trajectories are planned for one robot; name it")
        self._name, self._robot = name, robot
        self._law = JointTrajectoryLaw(robot)
        self._q: np.ndarray | None = None
        self._lines: list[dict[str, Any]] = [{"program": name, "joint_names": list(robot.joint_names)}]

    def add(self, statements: Sequence[Statement], cycles: int = 1) -> None:
        """Append statements; those of more than one cycle end where they begin.

        Raises:
            InputError: the first of all is no joint move, or what `JointTrajectoryLaw.plan` refuses.
        """
        number = 0
        while number < len(statements):
            statement = statements[number]
            if isinstance(statement, Delay):
                self._lines.append({"rest": statement.seconds})
                number += 1
                continue
            moves = next(stop_to_stop(statements[number:]))
            self._move(moves, number, cycles)
            number += len(moves)

    def text(self) -> str:
        """The program, which was read back."""
        text = "".join(f"{json.dumps(line, ensure_ascii=False)}\n" for line in self._lines)
        read_program(text, "the program to be written", self._robot)
        return text

    def _move(self, moves: Sequence[Move], number: int, cycles: int) -> None:
        move, target = moves[0], moves[0].target
        timed = isinstance(move.settings, PointSettings)
        if len(moves) == 1 and move.type is MoveType.JOINT and isinstance(target, JointTarget) and not timed:
            velocity, acceleration = self._law.pace(move)
            self._q = target.position
            self._lines.append(
                {"to": _rounded(self._q), "velocity": _rounded(velocity), "acceleration": _rounded(acceleration)}
            )
            return
        if self._q is None:
            raise InputError(f"program {self._name}: a joint move to where the arm begins has to come first")
        spline, *_ = self._law.spline(moves, self._q, number)
        if not np.ptp(spline.q, axis=0).any():
            return
        if np.abs(spline.q[-1] - spline.q[0]).max() < _CLOSED:
            spline.q[-1] = spline.q[0]
        self._q = spline.q[-1]
        self._lines.append({"cycles": cycles, "goal": _goal(self._robot.joint_names, spline)})


def _goal(names: Sequence[str], spline: JointSpline) -> dict[str, Any]:
    points = [
        {
            "positions": _rounded(q),
            "velocities": _rounded(qd),
            "accelerations": _rounded(qdd),
            "time_from_start": _time(t),
        }
        for t, q, qd, qdd in zip(spline.t + LEAD, spline.q, spline.qd, spline.qdd, strict=True)
    ]
    return {
        "trajectory": {"joint_names": list(names), "points": points},
        "path_tolerance": [{"name": name, "position": PATH_TOLERANCE} for name in names],
        "goal_time_tolerance": _time(_GOAL_TIME),
    }


def _rounded(values: np.ndarray) -> list[float]:
    rounded: list[float] = (np.round(values, _DECIMALS) + 0.0).tolist()
    return rounded


def _time(seconds: float) -> dict[str, int]:
    whole, nano = divmod(round(seconds * 1e9), 10**9)
    return {"sec": whole, "nanosec": nano}


def goals_of(text: str) -> list[str]:
    """The goals of a program as JSON, each once."""
    lines = [json.loads(row) for row in text.splitlines() if row.strip() and not row.lstrip().startswith("#")]
    return [json.dumps(line["goal"], indent=1) + "\n" for line in lines if "goal" in line]


def read_program(text: str, path: str = "", robot: RobotDescription | None = None) -> TrajectoryProgram:
    """Read and check a program.

    Raises:
        TrajectoryError: not one, or not for this robot; names path and line.
    """
    try:
        program = GoalProgram.of(text, path)
    except RefusedError as error:
        raise TrajectoryError(str(error)) from None
    if robot is not None and program.joints != tuple(robot.joint_names):
        ours, theirs = ", ".join(robot.joint_names), ", ".join(program.joints)
        raise TrajectoryError(f"{path}:1: it is for {theirs}; {robot.name} has {ours}")
    return TrajectoryProgram(program.name, tuple((step.cycles, tuple(_statements(step))) for step in program.steps))


def _statements(step: Step) -> Iterator[Statement]:
    if step.points is not None:
        points, before = step.points, 0.0
        for t, q, qd, qdd in zip(points.t.tolist(), points.q, points.qd, points.qdd, strict=True):
            settings = PointSettings(seconds=t - before, velocity=tuple(qd.tolist()), acceleration=tuple(qdd.tolist()))
            moving = bool(qd.any() or qdd.any())
            yield Move(MoveType.JOINT, JointTarget(q), settings, moving, line=step.line)
            before = t
    elif step.to is not None:
        target, *limits = step.to
        velocity, acceleration = (tuple(row.tolist()) for row in limits)
        pace = PaceSettings(velocity=velocity, acceleration=acceleration)
        yield Move(MoveType.JOINT, JointTarget(target), pace, line=step.line)
    else:
        yield Delay(step.rest)
