"""Via-points through the trajectory socket, for a controller that has CNR's programs as they are published.

Its queue has 200 nodes and wants consecutive sequence numbers from 1 on. The last point of a trajectory is a stop, the
others are flown by; so a motion with stops in it is several trajectories, each with a start of its own, one after the
other. A point is sent again only where the controller has said that it did not take it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers.errors import DriverError, RefusedError
from drivers.protocol import ViaPoint
from drivers.transports.cnr.address import parse_address
from drivers.transports.cnr.driver import CnrDriver
from drivers.transports.cnr.motion import CnrMotion
from drivers.transports.cnr.sockets import CommandReply, Sockets
from drivers.wire import cnr as wire
from drivers.wire.cnr import Feedback, MessageType, Point, QueueStatus

_ASK = 0.05  # s between two checks of a full queue for free space
_LINGER = 0.05  # s between two checks for the end of a trajectory


def create(address: str, **options: Any) -> CnrDriver:
    """The driver for an address of `drivers.transports.cnr.address`; a `PointDriver` where it says `mode=points`.

    Raises:
        ConfigurationError: not an address.
    """
    parsed = parse_address(address)
    return (PointDriver if parsed.points else CnrDriver)(parsed, **options)


class PointDriver(CnrDriver):
    """`drivers.protocol.Driver` and `AcceptsViaPoints` on CNR's open programs, nearly as they are published.

    A *stop* only holds the trajectory there, and the next start would go on with it; *cancel* ends it.
    """

    STOP = MessageType.CANCEL
    _trajectories: tuple[tuple[Point, ...], ...] = ()

    def upload(self, name: str, text: str) -> str:
        """Refused: this link takes points.

        Raises:
            RefusedError: always.
        """
        raise RefusedError("this link takes via-points, no programs; leave mode=points out of the address to send one")

    def load(self, name: str, checksum: str, points: Sequence[ViaPoint]) -> None:
        """Keep the points for `start`; the controller hears nothing of them yet.

        Raises:
            RefusedError: the arm moves, or points that this link cannot take.
        """
        if self._moves(self._connected().feedback()):
            raise RefusedError("no points are taken while the arm moves; stop it first")
        assert self._machine is not None
        self._trajectories = trajectories(points, len(self._machine.identity.joint_names))
        self._stored = name, checksum

    def start(self, name: str, checksum: str) -> None:
        """Queue the first trajectory and start it; the others follow by themselves."""
        sockets = self._connected()
        self._check_idle(sockets)
        if self._stored != (name, checksum) or not self._trajectories:
            raise RefusedError(f"the points that were sent are not those of {name!r}; nothing was started")
        feeder = _Feeder(sockets, self._trajectories)
        with self._start_of(self._new_motion(feeder.is_over)) as motion:
            sockets.guarded = True
            feeder.fill(motion)
            self._command_start(sockets, motion, f"the start of {name}")
            feeder.started()
        thread = threading.Thread(target=self._feed, args=(feeder, sockets, motion), name="points", daemon=True)
        thread.start()

    def _read_stored(self) -> tuple[str, str]:
        return self._stored

    def _feed(self, feeder: _Feeder, sockets: Sockets, motion: CnrMotion) -> None:
        """The rest of the first trajectory and all others (in a separate thread)."""
        try:
            while feeder.go_on(motion):
                with self._starting:
                    if motion.stopping:
                        return
                    self._command_start(sockets, motion, "the start of the next trajectory")
                feeder.started()
                motion.resume()
        except Exception as error:  # any error: no other thread would send the rest
            if not (motion.over or motion.stopping):
                known = error if isinstance(error, DriverError) else DriverError(f"no points can be sent: {error!r}")
                self._end_with(sockets, motion, known)


class _Feeder:
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
