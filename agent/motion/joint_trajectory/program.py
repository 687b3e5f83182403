"""A program of joint trajectories as statements: written from a plan, and read (`drivers.joint_trajectory`)."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import InputError
from agent.motion.joint_trajectory.interpolator import JointTrajectoryLaw, joint_move_to
from agent.motion.joint_trajectory.settings import PaceSettings, PointSettings
from agent.motion.program import Delay, JointTarget, Move, MoveType, Statement, stop_to_stop
from drivers.errors import RefusedError
from drivers.joint_trajectory import LEAD, RATES, GoalProgram, JointSpline, Step

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: How far a joint may be off [rad, m] before the controller itself stops the arm: a little more than the guard's 0.07
#: (`agent.safety`), so that the guard brakes first, and smoothly.
PATH_TOLERANCE = 0.1
_GOAL_TIME = 1.0  # s, after the last point
_DECIMALS = 9
_CLOSED = 1e-6  # rad, m: a loop that ends so near to its start ends there


class TrajectoryProgram:
    """A program that was read."""

    def __init__(self, goals: GoalProgram) -> None:
        self.name, self._goals = goals.name, goals

    def run(self) -> Iterator[Statement]:
        """Its moves and delays in order."""
        once = functools.cache(lambda step: tuple(_statements(step)))
        for step in self._goals.run():
            yield from once(step)


def written(name: str, robot: RobotDescription | None, *parts: tuple[Sequence[Statement], int]) -> str:
    """A program of statements, and how often their goals are run; those of more than one cycle end where they begin.

    Raises:
        InputError: no robot to plan for, the first of all is no joint move, or what `JointTrajectoryLaw.plan` refuses.
    """
    if robot is None:
        raise InputError(f"program {name}: joint trajectories are planned for one robot; name it")
    law, at = JointTrajectoryLaw(robot), None
    lines: list[dict[str, Any]] = [{"program": name, "joint_names": list(robot.joint_names)}]
    for statements, cycles in parts:
        number = 0
        while number < len(statements):
            if isinstance(statement := statements[number], Delay):
                lines.append({"rest": statement.seconds})
                number += 1
                continue
            moves = next(stop_to_stop(statements[number:]))
            line, at = _line_of(name, law, moves, at, number)
            lines += [{"cycles": cycles, **line} if "goal" in line else line] if line else []
            number += len(moves)
    text = "".join(f"{json.dumps(line, ensure_ascii=False)}\n" for line in lines)
    read_program(text, "the program to be written", robot)
    return text


def _line_of(
    name: str, law: JointTrajectoryLaw, moves: Sequence[Move], at: np.ndarray | None, number: int
) -> tuple[dict[str, Any], np.ndarray]:
    """The line of moves from stop to stop, from `at` (n,) on, empty where they go nowhere; and where they end."""
    if (end := joint_move_to(moves)) is not None:
        rows = map(_rounded, (end, *law.pace(moves[0])))
        return dict(zip(("to", "velocity", "acceleration"), rows, strict=True)), end
    if at is None:
        raise InputError(f"program {name}: a joint move to where the arm begins has to come first")
    spline, *_ = law.spline(moves, at, number)
    if np.abs(spline.q[-1] - spline.q[0]).max() < _CLOSED:
        spline.q[-1] = spline.q[0]
    moved = np.ptp(spline.q, axis=0).any()
    return {"goal": _goal(law.robot.joint_names, spline)} if moved else {}, spline.q[-1]


def _goal(names: Sequence[str], spline: JointSpline) -> dict[str, Any]:
    rows = zip(spline.t + LEAD, spline.q, spline.qd, spline.qdd, strict=True)
    points = [{**dict(zip(RATES, map(_rounded, row), strict=True)), "time_from_start": _time(t)} for t, *row in rows]
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
        InputError: not one, or not for this robot; names path and line.
    """
    try:
        program = GoalProgram.of(text, path)
    except RefusedError as error:
        raise InputError(str(error)) from None
    if robot is not None and program.joints != tuple(robot.joint_names):
        ours, theirs = ", ".join(robot.joint_names), ", ".join(program.joints)
        raise InputError(f"{path}:1: it is for {theirs}; {robot.name} has {ours}")
    return TrajectoryProgram(program)


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
