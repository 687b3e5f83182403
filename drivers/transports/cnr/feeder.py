"""Via-points as the trajectory socket takes them, sent point by point."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from drivers.errors import DriverError, RefusedError
from drivers.protocol import ViaPoint
from drivers.transports.cnr.motion import CnrMotion
from drivers.transports.cnr.sockets import CommandReply, Sockets
from drivers.wire import cnr as wire
from drivers.wire.cnr import Feedback, MessageType, Point, QueueStatus

_ASK = 0.05  # s between two checks of a full queue for free space
_LINGER = 0.05  # s between two checks for the end of a trajectory


class Feeder:
    """Sends trajectories point by point, and knows when the last of them is over."""

    def __init__(self, sockets: Sockets, trajectories: tuple[tuple[Point, ...], ...]) -> None:
        self._sockets = sockets
        self._trajectories = trajectories
        self._at = 0  # trajectory
        self._sent = 0  # points of it
        self._finished = False  # the controller knows that this was the last
        self._running = False
        self._seen = False  # that the running trajectory has begun

    def is_over(self, feedback: Feedback) -> bool:
        """Whether the last trajectory is (in the reader thread)."""
        return self._at == len(self._trajectories) - 1 and self._is_done(feedback)

    def started(self) -> None:
        """The controller has taken the start."""
        self._seen, self._running = False, True

    def fill(self, motion: CnrMotion) -> None:
        """Send points until all are there or the queue is full.

        Raises:
            RefusedError: the controller does not take them.
            DriverError: it is unknown whether it did.
        """
        points = self._trajectories[self._at]
        while self._sent < len(points) and not motion.stopping:
            answer = self._send(points[self._sent])
            if answer.queue == QueueStatus.ERROR:
                raise RefusedError(
                    f"the controller refused point {self._sent + 1} of {len(points)}: its queue expects another "
                    "number; deactivate and activate the programs at the controller, then run the command again"
                )
            if not answer.success and answer.queue != QueueStatus.BUSY:
                raise RefusedError(f"the controller refused point {self._sent + 1} of {len(points)}")
            self._sent += answer.success
            if answer.queue == QueueStatus.BUSY:
                return
        if self._sent == len(points) and not self._finished:
            self._finished = True
            if self._sockets.command(MessageType.FINISHED) is None:
                raise DriverError("the controller does not answer that all points were sent; look at it")

    def go_on(self, motion: CnrMotion) -> bool:
        """See the running trajectory to its end; True where the next one is queued and waits for its start."""
        while not self._finished and not motion.stopping:
            if self._wait_for_room(motion):
                self.fill(motion)
        while not (motion.over or motion.stopping):
            if self._sockets.wait(lambda: self._is_done(self._sockets.feedback()), _LINGER):
                break
        if motion.over or motion.stopping or self._at == len(self._trajectories) - 1:
            return False
        motion.pause()
        self._at, self._sent, self._finished, self._running = self._at + 1, 0, False, False
        self.fill(motion)
        return not motion.stopping

    def _is_done(self, feedback: Feedback) -> bool:
        """Of a trajectory before, the controller may still report the same last point: it must have begun first."""
        if not self._running:
            return False
        last = len(self._trajectories[self._at])
        if feedback.is_moving or feedback.last_point_processed != last:
            self._seen = True
        return self._seen and not feedback.is_moving and feedback.last_point_processed == last

    def _send(self, point: Point) -> CommandReply:
        """The answer to a point, which is sent once."""
        answer = self._sockets.command(MessageType.POINT, point)
        if answer is None:
            answer = self._sockets.ask_again(MessageType.POINT)
        if answer is None:
            raise DriverError(
                f"the controller never said whether it took point {point.sequence_number}; it is not sent again. Look "
                "at the controller, then run the command again"
            )
        return answer

    def _wait_for_room(self, motion: CnrMotion) -> bool:
        while not (motion.over or motion.stopping):
            answer = self._sockets.command(MessageType.PING)
            if answer is None:
                raise DriverError("the controller does not answer a ping any more; look at it")
            if answer.queue == QueueStatus.READY:
                return True
            time.sleep(_ASK)
        return False


def trajectories(points: Sequence[ViaPoint], joints: int) -> tuple[tuple[Point, ...], ...]:
    """The points as the socket takes them, cut at stops.

    Raises:
        RefusedError: no points, no stop at the end, or positions of another arm.
    """
    if not points or points[-1].fly_tolerance != 0:
        raise RefusedError("points end with a stop (fly_tolerance 0)")
    made: list[tuple[Point, ...]] = []
    current: list[Point] = []
    for number, point in enumerate(points, start=1):
        position = np.asarray(point.position, dtype=float)
        if position.shape != (joints,) or not np.isfinite(position).all():
            raise RefusedError(f"point {number}: {joints} joint positions are expected, not {position}")
        if not (point.linear_speed > 0 and point.fly_tolerance >= 0):
            raise RefusedError(f"point {number}: speed {point.linear_speed}, fly_tolerance {point.fly_tolerance}")
        current.append(
            Point(
                sequence_number=len(current) + 1,
                fly_tolerance=1000.0 * point.fly_tolerance,
                linear_vel=point.linear_speed,
                joints=(*np.degrees(position).tolist(), *[0.0] * (wire.AXES - joints)),
            )
        )
        if point.fly_tolerance == 0:
            made.append(tuple(current))
            current = []
    return tuple(made)
