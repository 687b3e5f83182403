"""A program of joint trajectories: its text, and the statements it is read to.

The text has one JSON object a line; lines that begin with # are comments:

    {"program": "excite", "joint_names": ["joint_1", …]}
    {"to": [0.0, …], "velocity": [0.3, …], "acceleration": [1.0, …]}     from where the arm rests; limits of each joint
    {"rest": 0.5}                                                         [s]
    {"cycles": 10, "goal": {"trajectory": …, "path_tolerance": …}}        FollowJointTrajectory goals, sent in turn

A goal is the message itself: rest to rest, positions, velocities and accelerations at 20 points a second. Its first
point is where the arm stands, `LEAD` after the start, and every joint has a path tolerance.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import InputError
from agent.motion.joint_trajectory.interpolator import JointTrajectoryLaw
from agent.motion.joint_trajectory.settings import PaceSettings, PointSettings
from agent.motion.joint_trajectory.spline import JointSpline
from agent.motion.program import Delay, JointTarget, Move, MoveType, Statement, stop_to_stop

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Time [s] from the stamp of a trajectory to its first point: a controller jumps to a point that is due already.
LEAD = 0.2
#: How far a joint may be off [rad, m] before the controller itself stops the arm: a little more than the guard's 0.07
#: (`agent.safety`), so that the guard brakes first, and smoothly.
PATH_TOLERANCE = 0.1
_GOAL_TIME = 1.0  # s, after the last point
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*", re.ASCII)
_MOST = 10_000  # points of a goal, and lines
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
        InputError: no name of a program, or no robot to plan for.
    """

    def __init__(self, name: str, robot: RobotDescription | None) -> None:
        if _NAME.fullmatch(name) is None:
            raise InputError(f"program name {name!r}: a letter, then letters, digits and _")
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
    name, joints = "", tuple[str, ...]()
    lines: list[tuple[int, tuple[Statement, ...]]] = []
    for number, row in enumerate(text.splitlines(), 1):
        if not row.strip() or row.lstrip().startswith("#"):
            continue
        try:
            data = json.loads(row)
            if not isinstance(data, dict):
                raise ValueError("an object is expected")
            if not joints:
                name, joints = _header(data, robot)
            elif len(lines) >= _MOST:
                raise ValueError(f"more than {_MOST} lines")
            else:
                lines.append(_line(data, joints, number))
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise TrajectoryError(f"{path}:{number}: not a line of a program of joint trajectories: {what}") from None
    if not joints:
        raise TrajectoryError(f"{path}: no program of joint trajectories; its first line names program and joint_names")
    return TrajectoryProgram(name, tuple(lines))


def _header(data: dict[str, Any], robot: RobotDescription | None) -> tuple[str, tuple[str, ...]]:
    name, joints = data["program"], tuple(data["joint_names"])
    if not (isinstance(name, str) and _NAME.fullmatch(name)):
        raise ValueError("the name of a program is a letter, then letters, digits and _")
    if not joints or not all(isinstance(joint, str) for joint in joints) or len(set(joints)) != len(joints):
        raise ValueError("joint_names has to name every joint once")
    if robot is not None and joints != tuple(robot.joint_names):
        raise ValueError(f"it is for {', '.join(joints)}; {robot.name} has {', '.join(robot.joint_names)}")
    return name, joints


def _line(data: dict[str, Any], joints: tuple[str, ...], number: int) -> tuple[int, tuple[Statement, ...]]:
    if "rest" in data:
        seconds = float(data["rest"])
        if not 0.0 <= seconds <= 3600.0:
            raise ValueError(f"a rest of {seconds} s; 0 to 3600 s are allowed")
        return 1, (Delay(seconds),)
    if "to" in data:
        to, velocity, acceleration = (_numbers(data[key], len(joints)) for key in ("to", "velocity", "acceleration"))
        if not (min(velocity) > 0.0 and min(acceleration) > 0.0):
            raise ValueError("velocity and acceleration have to be above zero")
        return 1, (
            Move(
                MoveType.JOINT,
                JointTarget(np.array(to)),
                PaceSettings(velocity=velocity, acceleration=acceleration),
                line=number,
            ),
        )
    cycles = data["cycles"]
    if type(cycles) is not int or not 1 <= cycles <= 1_000_000:
        raise ValueError(f"cycles is {cycles!r}; 1 to 1000000 are allowed")
    return cycles, tuple(_points(data["goal"], joints, number))


def _points(goal: dict[str, Any], joints: tuple[str, ...], number: int) -> Iterator[Move]:
    trajectory = goal["trajectory"]
    if tuple(trajectory["joint_names"]) != joints:
        raise ValueError("the joints of a goal have to be those of the program, in its order")
    limits = {tolerance["name"]: float(tolerance["position"]) for tolerance in goal["path_tolerance"]}
    if set(limits) != set(joints) or not all(0.0 < limit <= 2 * PATH_TOLERANCE for limit in limits.values()):
        raise ValueError(
            f"path_tolerance has to give every joint a position above 0 and at most {2 * PATH_TOLERANCE:g}"
        )
    points = trajectory["points"]
    if not 2 <= len(points) <= _MOST:
        raise ValueError(f"{len(points)} points; 2 to {_MOST} are allowed")
    times = [0.0, *(_seconds(point["time_from_start"]) for point in points)]
    if not (times[1] >= LEAD - 1e-9 and all(b > a for a, b in pairwise(times))):
        raise ValueError(f"times have to rise, from {LEAD} s on")
    for k, (point, (before, now)) in enumerate(zip(points, pairwise(times), strict=True)):
        q, qd, qdd = (_numbers(point[key], len(joints)) for key in ("positions", "velocities", "accelerations"))
        still = not (any(qd) or any(qdd))
        if not still and k in (0, len(points) - 1):
            raise ValueError("a goal has to begin and end stationary")
        settings = PointSettings(seconds=now - before, velocity=qd, acceleration=qdd)
        yield Move(MoveType.JOINT, JointTarget(np.array(q)), settings, not still, line=number)


def _numbers(values: Sequence[float], count: int) -> tuple[float, ...]:
    numbers = tuple(float(value) for value in values)
    if len(numbers) != count or not all(math.isfinite(value) for value in numbers):
        raise ValueError(f"{count} finite numbers are expected, one a joint")
    return numbers


def _seconds(time: dict[str, int]) -> float:
    whole, nano = time["sec"], time["nanosec"]
    if type(whole) is not int or type(nano) is not int or not (0 <= whole < 2**31 and 0 <= nano < 10**9):
        raise ValueError("a time has whole sec and nanosec")
    return whole + 1e-9 * nano
