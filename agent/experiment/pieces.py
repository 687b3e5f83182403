"""The pieces that an experiment is put together from: loops, stops with rests, and slow reversals of single joints.

Every piece starts and ends at standstill in its own posture, keeps every limit and the recipe's tool speed, stays
clear of the cell, and lies in the recipe's sub-region. Positions are given as joint positions, so nothing is left to a
choice of posture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.diagnosis import LIMITS
from agent.excitation import Candidates, LoopProblem
from agent.motion import (
    Delay,
    JointTarget,
    MotionError,
    MotionSettings,
    Move,
    MoveType,
    Statement,
    create_interpolator,
    with_frames,
)
from agent.robot import KinematicsError, RobotDescription

#: Kinds of pieces, equally often drawn; loops alone are what an excitation is.
KINDS = ("loop", "stops", "reversals")
#: Speed of a loop or of stops, over the recipe's; of reversals, over the joint's highest, and their turn to either side
#: over half the joint's range, before it is cut to the sub-region.
_SHARES = (0.1, 0.3, 1.0)
_REST = 1.0  # s at every point: rows with a stationary joint do not count, so none tells more
PERIOD = 0.01  # numerical: s of the set-points that are weighed; the program is checked at the controller's own
SPEED_ROUND_OFF = 1.01  # numerical: largest ratio of the tool's speed to the commanded one, with this period
_VARY = 0.2  # numerical: standard deviation of a neighbour's genes, and of the logarithm of its speed and turn


@dataclass(frozen=True, eq=False)
class GridMotion:
    """A motion on an even grid: time (S,) [s], q, qd, qdd (S, n)."""

    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


@dataclass(frozen=True, eq=False)
class Draw:
    """The genome of a piece: its kind, numbers (6 K,), speed, and of reversals the joint and its turn [rad, m]."""

    kind: str
    genome: np.ndarray
    joint: int
    speed: float
    turn: float


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of motion: from `start` (n,), stationary, through `statements` back to it."""

    draw: Draw
    start: np.ndarray
    statements: tuple[Statement, ...]
    motion: GridMotion
    duration: float

    def text(self, robot: RobotDescription) -> str:
        """The piece in words."""
        draw = self.draw
        if draw.kind == "reversals":
            joint = robot.joints[draw.joint]
            travel = f"{1e3 * draw.turn:.3g} mm" if joint.prismatic else f"{np.degrees(draw.turn):.3g} deg"
            return (
                f"reversals of {joint.name} by up to {travel} at "
                f"{100 * draw.speed:.0f} % of its speed, resting {_REST:g} s"
            )
        rests = f", resting {_REST:g} s at every point" if draw.kind == "stops" else ""
        return f"a loop at {100 * draw.speed:.0f} % of the recipe's speed{rests}"


class Pieces:
    """Draws pieces in the sub-region of a problem, and varies them. `joints` are those worth turning by themselves,
    `kinds` the kinds that are drawn.

    Raises:
        InputError: as `agent.excitation.Candidates`.
    """

    def __init__(
        self,
        problem: LoopProblem,
        joints: Sequence[int],
        longest: float,
        rng: np.random.Generator,
        kinds: Sequence[str] = KINDS,
    ):
        self.problem = replace(problem, period=PERIOD)
        self._candidates = Candidates(self.problem)
        self._interpolator = create_interpolator(problem.interpolator, problem.robot, problem.tool, period=PERIOD)
        self._joints, self._longest, self._rng, self._kinds = list(joints), longest, rng, list(kinds)
        points = np.vstack([problem.regions.poses(rng.uniform(size=problem.genes))[:, :3, 3] for _ in range(50)])
        slack = problem.settings.fly_distance
        self._low, self._high = points.min(axis=0) - slack, points.max(axis=0) + slack

    def draw(self) -> Piece | None:
        """A piece at random; None where it breaks a limit."""
        rng = self._rng
        kind, joint = str(rng.choice(self._kinds)), int(rng.choice(self._joints))
        genome = rng.uniform(size=self.problem.genes)
        speed, share = rng.choice(_SHARES, size=2)
        lower, upper = self._candidates.joint_limits
        return self.make(Draw(kind, genome, joint, float(speed), float(share * (upper - lower)[joint] / 2)))

    def vary(self, piece: Piece) -> Piece | None:
        """A neighbour of a piece."""
        draw, rng = piece.draw, self._rng
        genome = np.clip(draw.genome + _VARY * rng.standard_normal(len(draw.genome)), 0.0, 1.0)
        factor = float(np.exp(_VARY * rng.standard_normal()))
        travel = draw.turn * float(np.exp(_VARY * rng.standard_normal()))
        return self.make(replace(draw, genome=genome, speed=min(draw.speed * factor, 1.0), turn=travel))

    def make(self, draw: Draw) -> Piece | None:
        """The piece, or None where a limit, the cell or the sub-region is in the way or it takes too long."""
        draw = replace(draw, speed=max(round(100 * draw.speed), 1) / 100)  # controllers take whole percents
        try:
            planned = self._reversals(draw) if draw.kind == "reversals" else self._loop(draw)
            if planned is None:
                return None
            draw, start, statements = planned
            trajectory = self._interpolator.plan(statements, start)
        except (MotionError, KinematicsError):
            return None
        over = float(trajectory.path_speed.max()) / self.problem.settings.linear_speed
        if over > SPEED_ROUND_OFF:
            slower = replace(draw, speed=int(100 * draw.speed / over) / 100)
            return self.make(slower) if draw.kind == "reversals" and slower.speed > 0 else None
        if trajectory.duration > self._longest or not self._candidates.clear(trajectory):
            return None
        motion = GridMotion(trajectory.t, trajectory.q, trajectory.qd, trajectory.qdd)
        return Piece(draw, start, tuple(statements), motion, trajectory.duration)

    def _settings(self, speed: float) -> MotionSettings:
        settings = self.problem.settings
        return with_frames(settings.changed(linear_speed=settings.linear_speed * speed), self.problem.tool)

    def _loop(self, draw: Draw) -> tuple[Draw, np.ndarray, list[Statement]]:
        """Through the via-points of the genome: flown, or with a rest at each."""
        poses = self.problem.regions.poses(draw.genome)
        kinematics = self._candidates.kinematics
        joints = [kinematics.solve(poses[0], self._candidates.posture, on_branch=True)]
        for pose in poses[1:]:
            joints.append(kinematics.solve(pose, joints[-1]))
        settings = self._settings(draw.speed)
        fine = settings.stopping()
        statements: list[Statement] = []
        for target in joints[1:]:
            if draw.kind == "stops":
                statements += [Move(MoveType.LINEAR, JointTarget(target), fine), Delay(_REST)]
            else:
                statements.append(Move(MoveType.LINEAR, JointTarget(target), settings, fly=True))
        statements.append(Move(MoveType.LINEAR, JointTarget(joints[0]), fine))
        return draw, joints[0], [*statements, Delay(_REST)]

    def _reversals(self, draw: Draw) -> tuple[Draw, np.ndarray, list[Statement]] | None:
        """One joint to and fro about a posture of the sub-region, with rests."""
        kinematics = self._candidates.kinematics
        middle = kinematics.solve(self.problem.regions.poses(draw.genome)[0], self._candidates.posture, on_branch=True)
        travel = draw.turn
        while not self._inside(middle, draw.joint, travel):
            travel /= 2
            if travel < LIMITS.least_travel:
                return None
        calm = self._settings(1.0).changed(speed_override=draw.speed).stopping()
        statements: list[Statement] = []
        for side in (1.0, -1.0):
            target = middle.copy()
            target[draw.joint] += side * travel
            statements += [Move(MoveType.JOINT, JointTarget(target), calm), Delay(_REST)]
        statements.append(Move(MoveType.JOINT, JointTarget(middle), calm))
        return replace(draw, turn=travel), middle, [*statements, Delay(_REST)]

    def _inside(self, middle: np.ndarray, joint: int, travel: float) -> bool:
        """Whether the tool stays within the box around the sub-region, and the joint within its range."""
        lower, upper = self._candidates.joint_limits
        if not lower[joint] <= middle[joint] - travel <= middle[joint] + travel <= upper[joint]:
            return False
        turns = travel * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
        postures = np.tile(middle, (len(turns), 1))
        postures[:, joint] += turns
        tips = self._candidates.kinematics.forward(postures)[:, :3, 3]
        return bool(np.all(tips >= self._low) and np.all(tips <= self._high))
