"""A program of joint trajectories as the driver runs it: goals in turn, each from rest to rest.

`agent.motion.joint_trajectory` writes these texts and checks limits; this module takes nothing for granted that keeps
the arm safe while nobody is there: a stationary end, a path tolerance, a bounded duration, a lead to the first point.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from drivers.errors import RefusedError

#: Longest goal [s]: the arm goes on to its end when nobody is there any more.
LONGEST = 20.0
#: Time [s] from a trajectory's stamp to its first point, at least: a controller jumps to a point that is due.
LEAD = 0.2
#: Largest path tolerance [rad, m].
WIDEST = 0.2
_SHORTEST = 0.5  # s, of a move from where the arm rests
_SETTLED = 0.5  # s, between two points and the durations that are allowed, for rounding and the lead
_STEPS = 100_000
# A quintic from rest to rest over e in T seconds: peak speed 15/8 e/T, peak acceleration 10/√3 e/T².
_SPEED, _ACCELERATION = 15 / 8, 10 / math.sqrt(3)


@dataclass(frozen=True, eq=False)
class Points:
    """Points of one trajectory: times (K,) [s] after its stamp, rows (K, 3, n) of position, velocity, acceleration."""

    times: np.ndarray
    rows: np.ndarray

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.times[-1])


@dataclass(frozen=True, eq=False)
class Step:
    """A goal that is run `cycles` times: `points`, or a move `to` (3, n) (position, and limits of velocity and
    acceleration) from where the arm rests, or a `rest` [s] before the next one. `tolerance` (n,) of the path."""

    cycles: int = 1
    points: Points | None = None
    to: np.ndarray | None = None
    rest: float = 0.0
    tolerance: np.ndarray | None = None
    goal_time: float = 1.0

    def from_(self, position: np.ndarray) -> Points:
        """The points for an arm that rests at `position` (n,).

        Raises:
            RefusedError: the move would take too long.
        """
        if self.points is not None:
            return self.points
        assert self.to is not None
        target, velocity, acceleration = self.to
        way = np.abs(target - position)
        seconds = max(
            _SHORTEST, float(np.max(_SPEED * way / velocity)), math.sqrt(np.max(_ACCELERATION * way / acceleration))
        )
        if seconds > LONGEST + _SETTLED:
            raise RefusedError(f"the way to the first point would take {seconds:.0f} s, {LONGEST:g} s are allowed")
        # A controller sets out for the first point at once, whatever the stamp: the first is where the arm rests.
        nothing = np.zeros((2, 2, len(target)))
        rows = np.concatenate([np.array([position, target])[:, None], nothing], axis=1)
        return Points(np.array([LEAD, LEAD + seconds]), rows)


@dataclass(frozen=True, eq=False)
class GoalProgram:
    """A program under its `name`: joints, and steps in order."""

    text: str
    name: str
    joints: tuple[str, ...]
    steps: tuple[Step, ...]

    @property
    def longest(self) -> float:
        """Duration [s] of its longest goal; that of a move to the first point is at most `LONGEST`."""
        known = [step.points.duration for step in self.steps if step.points is not None]
        return max([*known, *(LONGEST for step in self.steps if step.to is not None)], default=0.0)

    @property
    def fastest_change(self) -> np.ndarray:
        """(n,) largest acceleration of each joint in its goals [rad/s²]."""
        rows = [np.abs(step.points.rows[:, 2]).max(axis=0) for step in self.steps if step.points is not None]
        rows += [step.to[2] for step in self.steps if step.to is not None]
        return np.max(rows, axis=0)

    def run(self) -> Iterator[Step]:
        """Its steps, each as often as it is run."""
        for step in self.steps:
            for _ in range(step.cycles):
                yield step

    @classmethod
    def of(cls, text: str) -> GoalProgram:
        """Of a text.

        Raises:
            RefusedError: no program, or one whose goals could not be left alone.
        """
        header: tuple[str, tuple[str, ...]] | None = None
        steps: list[Step] = []
        for number, row in enumerate(text.splitlines(), 1):
            if not row.strip() or row.lstrip().startswith("#"):
                continue
            try:
                data = json.loads(row)
                if header is None:
                    header = str(data["program"]), tuple(str(name) for name in data["joint_names"])
                elif len(steps) < _STEPS:
                    steps.append(_step(data, header[1]))
                else:
                    raise ValueError(f"more than {_STEPS} lines")
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
                raise RefusedError(f"line {number} is no line of a program of joint trajectories: {error}") from None
        if header is None or not steps:
            raise RefusedError("this is no program of joint trajectories, or it moves nothing")
        return cls(text, header[0], header[1], tuple(steps))


def _step(data: dict[str, Any], joints: tuple[str, ...]) -> Step:
    if "rest" in data:
        seconds = float(data["rest"])
        if not 0.0 <= seconds <= 3600.0:
            raise ValueError(f"a rest of {seconds} s")
        return Step(rest=seconds)
    if "to" in data:
        to = np.array([_row(data[key], len(joints)) for key in ("to", "velocity", "acceleration")])
        if not np.all(to[1:] > 0.0):
            raise ValueError("limits of velocity and acceleration have to be above zero")
        return Step(to=to)
    goal, cycles = data["goal"], int(data["cycles"])
    if tuple(goal["trajectory"]["joint_names"]) != joints:
        raise ValueError("a goal is for other joints")
    tolerance = {entry["name"]: float(entry["position"]) for entry in goal["path_tolerance"]}
    values = np.array([tolerance[name] for name in joints])
    if not np.all((values > 0.0) & (values <= WIDEST)):
        raise ValueError(f"every joint needs a path tolerance above 0 and at most {WIDEST:g}")
    points = _points(goal["trajectory"]["points"], len(joints))
    if not 1 <= cycles <= 1_000_000:
        raise ValueError(f"{cycles} cycles")
    return Step(cycles, points, tolerance=values)


def _points(given: list[dict[str, Any]], count: int) -> Points:
    times = np.array([point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"] for point in given])
    rows = np.array(
        [[_row(point[key], count) for key in ("positions", "velocities", "accelerations")] for point in given]
    )
    if len(times) < 2 or not times[0] >= LEAD - 1e-9 or not all(b > a for a, b in pairwise(times)):
        raise ValueError(f"two points at least, at rising times from {LEAD} s on")
    if not times[-1] <= LONGEST + _SETTLED:
        raise ValueError(
            f"a goal of {times[-1]:.1f} s; {LONGEST:g} s are allowed, as the arm goes on to its end by itself"
        )
    if np.any(rows[[0, -1], 1:]):
        raise ValueError("a goal has to begin and end stationary")
    return Points(times, rows)


def _row(values: list[float], count: int) -> list[float]:
    row = [float(value) for value in values]
    if len(row) != count or not all(map(math.isfinite, row)):
        raise ValueError(f"{count} finite numbers are expected")
    return row
