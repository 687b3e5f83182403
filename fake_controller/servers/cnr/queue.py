"""The point queue of the socket programs: 200 nodes, consecutive numbers, one trajectory at a time."""

from __future__ import annotations

import numpy as np

from agent.motion import FlyTrajectory, FlyType, JointTarget, Move, MoveType, Pdl2Settings, Termination, write_program
from agent.robot import RobotDescription
from drivers.wire.cnr import QUEUE_NODES, Point, QueueStatus

PROGRAM = "queued_points"
MAX_POINTS = 2000  # of one trajectory: the interpolator reads all of it before the arm moves
_KEPT_FREE = 2  # the queue is busy from here on


class PointQueue:
    """Takes points while they fit; once started, the interpolator reads them away as they come.

    `complete` says that the sender has sent its last, `started` that the trajectory is to run.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self.clear()

    def clear(self) -> None:
        """Forget the trajectory."""
        self._read: list[Point] = []
        self._queued: list[Point] = []
        self.last = 0
        self.complete = self.started = False

    @property
    def empty(self) -> bool:
        """Whether there is no point at all."""
        return not self._read and not self._queued

    @property
    def status(self) -> QueueStatus:
        """Whether the next point may come."""
        full = len(self._queued) >= QUEUE_NODES - _KEPT_FREE or len(self._read) >= MAX_POINTS
        return QueueStatus.BUSY if full else QueueStatus.READY

    def add(self, point: Point) -> QueueStatus:
        """Take a point; READY if it was taken, BUSY or ERROR (not the next number, or no place) if not."""
        if self.status is QueueStatus.BUSY:
            return QueueStatus.BUSY
        values = np.array([point.fly_tolerance, point.linear_vel, *point.joints])
        if self.complete and point.sequence_number == 1:
            self.clear()
        first = self.empty and point.sequence_number == 1
        if not (first or point.sequence_number == self.last + 1) or self.complete or not np.isfinite(values).all():
            return QueueStatus.ERROR
        self._queued.append(point)
        self.last = point.sequence_number
        self.read_ahead()
        return QueueStatus.READY

    def read_ahead(self) -> None:
        """What the interpolator does once the trajectory is started: nodes become free."""
        if self.started:
            self._read += self._queued
            self._queued = []

    def program(self) -> str:
        """The PDL2 text of the trajectory: FLY through every point, the last with a FINE stop.

        Raises:
            InputError: a value that PDL2 does not take.
        """
        points = self._read + self._queued
        moves = [self._move(point, point is not points[-1]) for point in points]
        return write_program(PROGRAM, moves, self._robot)

    def _move(self, point: Point, fly: bool) -> Move:
        settings = Pdl2Settings(
            fly_type=FlyType.FLY_CART,
            fly_trajectory=FlyTrajectory.FLY_TOL,
            fly_distance=point.fly_tolerance / 1000.0,
            linear_speed=point.linear_vel,
            termination=Termination.COARSE if fly else Termination.FINE,
        )
        target = JointTarget(np.radians(point.joints[: self._robot.dof]))
        return Move(MoveType.LINEAR, target, settings, fly=fly)
