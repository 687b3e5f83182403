"""Candidates of the search: from a genome to a motion and its score."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from agent.core import InputError, keep_freed_memory
from agent.excitation.criterion import Criterion
from agent.excitation.genetic import LoopScore, infeasible
from agent.motion import MotionError, MotionSettings, Move, Trajectory, ViaRegions, create_interpolator, loop_moves
from agent.robot import (
    Box,
    Cell,
    CellReport,
    Dynamics,
    Kinematics,
    KinematicsError,
    NumericalKinematics,
    RobotDescription,
    Tool,
    TorqueLimits,
    kinematics_for,
)

#: Joints of a loop end where they began within this [rad, m].
_CLOSED = 1e-3
#: [m] A clearance that is short by this much ranks like a limit exceeded by its own size.
CELL_SCALE = 0.1
#: Genes of a point by where it is in its region: in the middle, at the corners of its position (the orientation in the
#: middle of its own range), at the ends of its orientation.
MIDDLE = {"middle": np.full(6, 0.5)}
CORNERS = {
    f"corner {'-+'[x]}x {'-+'[y]}y {'-+'[z]}z": np.array([x, y, z, 0.5, 0.5, 0.5])
    for x, y, z in product((0, 1), repeat=3)
}
TURNED = {
    f"{'-+'[end]} end of orientation {axis - 2}": np.where(np.arange(6) == axis, end, 0.5)
    for axis, end in product((3, 4, 5), (0, 1))
}


@dataclass(frozen=True, eq=False)
class LoopProblem:
    """What is searched for: a loop of via-points in `regions` that this arm can run. Plain data, so that it travels.

    `settings` are those of the loop's moves, `period` [s] the controller's. The arm stays away from itself and from the
    boxes of `keep_out` by the FLY distance of the settings: the controller's blends may differ from ours by that.
    `joint_ranges`: by joint name, (lower, upper) [rad, m] where the joint may go less far than it can. `load` is a
    known mass at the flange in addition to the tool, which the drives have to bear.
    """

    robot: RobotDescription
    regions: ViaRegions
    settings: MotionSettings
    tool: Tool | None = None
    keep_out: tuple[Box, ...] = ()
    joint_ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    interpolator: str = "fly"
    period: float = 0.002
    load: Tool | None = None

    @property
    def genes(self) -> int:
        """Length of a genome: six for each via-point."""
        return self.regions.genes


@dataclass(frozen=True, eq=False)
class Loop:
    """One cycle: its genome (6 K,), via-points (K, 4, 4), joints (K, n) there, moves and set-points.

    The joints are on the branch that the cycle passes the via-points on.
    """

    genome: np.ndarray
    poses: np.ndarray
    joints: np.ndarray
    moves: tuple[Move, ...]
    trajectory: Trajectory = field(repr=False)

    @property
    def start(self) -> np.ndarray:
        """(n,) joints where it begins and ends."""
        return np.asarray(self.joints[0])


class Candidates:
    """Turns genomes into loops, and scores them. Built once a process: it holds robot, interpolator and criterion.

    Raises:
        InputError: a keep-out box that no motion of this arm can keep clear of.
    """

    def __init__(self, problem: LoopProblem):
        keep_freed_memory()
        self.problem = problem
        self.kinematics = kinematics_for(problem.robot, problem.tool)
        self.posture = posture(self.kinematics, problem.regions)
        self._redundant = isinstance(self.kinematics, NumericalKinematics) and self.kinematics.dof > 6
        self._interpolator = create_interpolator(
            problem.interpolator, problem.robot, problem.tool, period=problem.period
        )
        self._criterion = Criterion(problem.robot, problem.tool)
        self._dynamics = Dynamics(problem.robot, problem.tool)
        self._cell = Cell(problem.robot, problem.tool, problem.keep_out, problem.joint_ranges)
        self._cell.check_boxes(problem.settings.fly_distance)
        self._standard = self._dynamics.standard_parameters()
        self._limits = TorqueLimits(problem.robot, problem.tool, problem.load)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the parameters that the criterion counts."""
        return self._criterion.columns

    @property
    def joint_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) lower and upper [rad, m], where the cell allows less than the joint too."""
        return self._cell.lower, self._cell.upper

    def loop(self, genome: np.ndarray) -> Loop:
        """The loop of a genome (6 K,) in [0, 1], through the interpolator.

        Raises:
            MotionError, KinematicsError: it breaks a limit; names the point, the limit and by how much.
        """
        (loop,) = self.loops(np.asarray(genome)[None])
        if isinstance(loop, InputError):
            raise loop
        return loop

    def loops(self, genomes: np.ndarray) -> list[Loop | MotionError | KinematicsError]:
        """The loops of genomes (N, 6 K), worked out together, or the limits that they break; all are held at once."""
        poses = self.problem.regions.poses(genomes)
        joints, refused = self._joints(poses)
        loops: list[Loop | MotionError | KinematicsError] = []
        for genome, points, q, refusal in zip(genomes, poses, joints, refused, strict=True):
            if refusal is not None:
                loops.append(refusal)
                continue
            moves = loop_moves(points, self.problem.settings, q if self._redundant else None)
            try:
                loops.append(Loop(genome, points, q, moves, self._interpolator.plan(moves, q[0])))
            except (MotionError, KinematicsError) as error:
                loops.append(error)
        return loops if self._redundant else self._reaching(loops)

    def clear(self, trajectory: Trajectory) -> bool:
        """Whether a motion keeps clear of the arm, of the boxes and of the ends of joint ranges, within max_torque."""
        collision = self._cell.check(trajectory, self.problem.settings.fly_distance).collision
        return collision is None and self._overload(trajectory.thinned()) is None

    def _joints(self, poses: np.ndarray) -> tuple[np.ndarray, list[KinematicsError | None]]:
        """Joints at the beginning of loops through poses (N, K, 4, 4), and which have none.

        (N, 1, n); of a redundant arm (N, K, n) at all via-points, nearest to its posture, so that a loop ends where it
        began.
        """
        points = poses if self._redundant else poses[:, :1]
        flat = points.reshape(-1, 4, 4)
        seeds = np.tile(self.posture, (len(flat), 1))
        if isinstance(self.kinematics, NumericalKinematics) and self._redundant:
            q, reachable = self.kinematics.nearest(flat, seeds)
            q[~reachable], reachable[~reachable] = self.kinematics.find(flat[~reachable], seeds[~reachable])
        else:
            q, reachable = self.kinematics.find_on_branch(flat, seeds)
        reachable = reachable.reshape(points.shape[:2])
        refused = [
            None if reached.all() else self.kinematics.refusal(via_points[reached.argmin()], self.posture)
            for via_points, reached in zip(points, reachable, strict=True)
        ]
        return q.reshape(*points.shape[:2], -1), refused

    def _reaching(
        self, loops: list[Loop | MotionError | KinematicsError]
    ) -> list[Loop | MotionError | KinematicsError]:
        """The same loops with joints at all via-points, but for those with one where the arm itself cannot be.

        A blend may pass by such a point; no controller takes it as a target.
        """
        planned = [loop for loop in loops if isinstance(loop, Loop)]
        if not planned:
            return loops
        poses, seeds = (
            np.concatenate(parts) for parts in zip(*((loop.poses[1:], _passing(loop)) for loop in planned), strict=True)
        )
        joints, reachable = self.kinematics.find(poses, seeds)
        others = zip(np.split(joints, len(planned)), np.split(reachable, len(planned)), strict=True)

        def checked(loop: Loop) -> Loop | KinematicsError:
            q, reached = next(others)
            k = int(reached.argmin())
            if not reached[k]:
                return self.kinematics.refusal(loop.poses[k + 1], _passing(loop)[k])
            return replace(loop, joints=np.vstack([loop.joints, q]))

        return [checked(loop) if isinstance(loop, Loop) else loop for loop in loops]

    def score(self, genome: np.ndarray) -> LoopScore:
        """What the search takes: limits and cell at every sample, the regressor at every tenth."""
        return self.scores(np.asarray(genome)[None])[0]

    def scores(self, genomes: np.ndarray) -> list[LoopScore]:
        """The scores of genomes (N, 6 K), whose loops are worked out together and held at once."""
        return [self._score(loop, self._cell.check) for loop in self.loops(genomes)]

    def score_on_all(self, genome: np.ndarray) -> LoopScore:
        """What the result is judged by: the regressor at every sample too, and from each one the way to a stop."""
        (loop,) = self.loops(np.asarray(genome)[None])
        return self._score(loop, self._cell.check_with_stopping, on_all=True)

    def checked_loop(self, genome: np.ndarray) -> Loop | LoopScore:
        """The loop of a genome that keeps all limits, or what `score` says of one that does not: without a fitness."""
        (loop,) = self.loops(np.asarray(genome)[None])
        checked = self._checked(loop, self._cell.check)
        if isinstance(checked, LoopScore):
            return checked
        return self._overload(checked.trajectory.thinned()) or checked

    def _score(
        self,
        loop: Loop | MotionError | KinematicsError,
        check_cell: Callable[[Trajectory, float], CellReport],
        on_all: bool = False,
    ) -> LoopScore:
        checked = self._checked(loop, check_cell)
        if isinstance(checked, LoopScore):
            return checked
        trajectory = checked.trajectory
        tenth = trajectory.thinned()
        regressor = self._dynamics.regressor_by_joint(*tenth)
        overload = self._overload(tenth, regressor)
        if overload is not None:
            return overload
        if on_all:
            return LoopScore(self._criterion(trajectory.q, trajectory.qd, trajectory.qdd))
        return LoopScore(self._criterion(*tenth, regressor))

    def _checked(
        self, loop: Loop | MotionError | KinematicsError, check_cell: Callable[[Trajectory, float], CellReport]
    ) -> Loop | LoopScore:
        """The loop, or what it breaks other than the torques."""
        if not isinstance(loop, Loop):
            return infeasible(loop.excess, str(loop))
        trajectory = loop.trajectory
        wound = trajectory.q[-1] - trajectory.q[0]
        joint = int(np.argmax(np.abs(wound)))
        if abs(wound[joint]) > _CLOSED:
            name, degrees = self.problem.robot.joint_names[joint], np.degrees(wound[joint])
            complaint = f"{name} ends the loop {degrees:.0f} deg from where it began: cycles would wind it up"
            return infeasible(float(abs(wound[joint])), complaint)
        margin = self.problem.settings.fly_distance
        if check_cell == self._cell.check and self._cell.is_clear(trajectory, margin):
            return loop
        report = check_cell(trajectory, margin)
        if report.collision is not None:
            return infeasible(report.depth / CELL_SCALE, str(report.collision))
        return loop

    def _overload(
        self, tenth: tuple[np.ndarray, np.ndarray, np.ndarray], regressor: np.ndarray | None = None
    ) -> LoopScore | None:
        """The joint that the description's inertias ask most beyond its max_torque, at every tenth sample.

        `regressor` is that of the rigid bodies there, joint by joint, where it is known already.
        """
        overload = self._limits.overload(*tenth, None if regressor is None else (self._standard @ regressor).T)
        return None if overload is None else infeasible(*overload)


def _passing(loop: Loop) -> np.ndarray:
    """(K - 1, n) joints of a loop where it passes its via-points after the first."""
    samples = np.searchsorted(loop.trajectory.move, np.arange(len(loop.poses) - 1), side="right") - 1
    return loop.trajectory.q[samples]


def posture(kinematics: Kinematics, regions: ViaRegions) -> np.ndarray:
    """(n,) joint positions at the middle of the sub-region, from which loops choose their branch.

    Of all solutions there, the one from which most of the sub-region's edges are near at hand; among equals, the
    one nearest to the middle of the joint ranges. A redundant arm has infinitely many: the one furthest from the joint
    limits.

    Raises:
        KinematicsError: the middle cannot be reached; says by how much.
    """

    def at(places: Mapping[str, np.ndarray]) -> np.ndarray:
        return np.vstack([regions.poses(np.tile(genes, regions.count)) for genes in places.values()])

    edges, middle = at(CORNERS), at(MIDDLE)[0]
    solutions = kinematics.inverse(middle[None])
    if isinstance(kinematics, NumericalKinematics) and kinematics.dof > 6:
        turned = at(TURNED)[:: regions.count]
        if (roomiest := kinematics.roomiest(np.array([middle, *edges[:: regions.count], *turned]))) is not None:
            return roomiest
    if not solutions.within_limits[0].any():
        return kinematics.solve(middle, kinematics.middle)  # with its message if there is none
    options = solutions.q[0, solutions.within_limits[0]]
    around = kinematics.inverse(edges)
    reached = np.array([_reached(kinematics, around.q, around.within_limits, option) for option in options])
    from_middle = np.linalg.norm(options - kinematics.middle, axis=1)
    return options[np.lexsort((from_middle, -reached))[0]]


def _reached(kinematics: Kinematics, q: np.ndarray, allowed: np.ndarray, option: np.ndarray) -> int:
    turned = kinematics.nearest_turn(q, option)
    return int((allowed & (np.abs(turned - option) < np.pi / 2).all(axis=2)).any(axis=1).sum())
