"""The link that CNR's open socket programs and C5G Open node give a COMAU controller; docs/real-robot.md has it.

The trajectory port commands: its queue of points, start, stop. Two more ports, a broker and a folder report.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable
from contextlib import ExitStack, closing

import numpy as np

from agent.core import InputError
from agent.motion import FlyTrajectory, FlyType, JointTarget, Move, MoveType, Pdl2Settings, Termination
from agent.motion.pdl2 import write_program
from agent.robot import RobotDescription
from drivers.wire.cnr import QUEUE_NODES, CommType, Message, MessageType, Point, QueueStatus, ReplyCode
from drivers.wire.reasons import EndReason
from fake_controller.controller import Controller
from fake_controller.program.memory import RefusedRequest
from fake_controller.servers.base import BROKER
from fake_controller.servers.cnr.files import FtpFolder
from fake_controller.servers.cnr.node import JointPublisher, LoopingNode
from fake_controller.servers.cnr.reports import Reports
from fake_controller.servers.cnr.sockets import Client, LockStep, Port

PROGRAM = "queued_points"
MAX_POINTS = 2000  # of one trajectory: the interpolator reads all of it before the arm moves
_KEPT_FREE = 2  # the queue is busy from here on
SHORTEST_WATCHDOG = 0.5  # s


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
        """Take a point; READY if it was taken, BUSY or ERROR (not the next number, or a full queue) if not."""
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
        """Free nodes, as the interpolator does once the trajectory is started."""
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


class TrajectoryPort(Port):
    """Carries out what its client asks for; who is connected here holds the controller."""

    def __init__(self, server: CnrServer, address: str, port: int) -> None:
        self._server, self._controller = server, server.controller
        self._folder, self._reports = server._folder, server._reports
        self.queue = PointQueue(server.controller.robot)
        super().__init__(address, port, server.controller.faults, server.drop_clients)

    def left(self) -> None:
        self._server._left()

    def opened(self) -> None:
        self._controller.faults.heal()
        self._controller.reach("connect")
        self._folder.write_identity()
        self._reports.silence = 0.0

    def press_start(self) -> None:
        """Run the program that the folder names, as somebody who stands at the controller does.

        Raises:
            RefusedRequest, InputError: it cannot run.
        """
        name, text = self._folder.chosen()
        self._controller.start(name, hashlib.sha256(text).hexdigest(), secrets.token_bytes(16), self._reports)
        self._reports.begin(last_point=0, by_hand=True)
        self._controller.go()

    def heard(self, client: Client, message: Message) -> None:
        point = message.record
        assert isinstance(point, Point)
        match message.type:
            case _ if message.comm != CommType.REQUEST:
                self._answer(client, message, done=False)
            case MessageType.PING:
                self._answer(client, message, done=True)
            case MessageType.POINT:
                self._take(client, message, point)
            case MessageType.FINISHED:
                self.queue.complete = True
                self._run_points(client, message)
            case MessageType.START if self.queue.empty and point.sequence_number:
                self._run(client, message, lambda: self._start_program(point.sequence_number), point.sequence_number)
            case MessageType.START if not (self.queue.empty or self.queue.started or self._reports.moving):
                self.queue.started = True
                self.queue.read_ahead()
                self._run_points(client, message)
            case MessageType.STOP | MessageType.CANCEL if self._under_way():
                if message.type == MessageType.CANCEL:
                    self.queue.clear()
                self.queue.started = False  # held: the next start continues with it
                self._controller.stop(EndReason.STOPPED, "stopped on command")
                self._answer(client, message, done=True)
            case MessageType.SHUTDOWN:
                self._answer(client, message, done=True)
                self._cut()
            case _:
                self._answer(client, message, done=False)

    def _under_way(self) -> bool:
        """The arm moves, or will as soon as the last point is there."""
        return self._reports.flag or (self.queue.started and not self.queue.complete)

    def _take(self, client: Client, message: Message, point: Point) -> None:
        if self.queue.empty:
            self._controller.reach("upload")
        outcome = self._queue_status()
        if outcome is not QueueStatus.BUSY:
            wrong = self._controller.faults.acts("sequence_error")
            outcome = QueueStatus.ERROR if wrong else self.queue.add(point)
        accepted = outcome is QueueStatus.READY
        self._answer(client, message, accepted, self._queue_status() if accepted else outcome, point.sequence_number)

    def _run_points(self, client: Client, message: Message) -> None:
        """Once there is a start and an end."""
        if self.queue.complete and self.queue.started:
            self._run(client, message, self._start_points, self.queue.last)
        else:
            self._answer(client, message, done=True)

    def _run(self, client: Client, message: Message, start: Callable[[], None], last_point: int) -> None:
        try:
            start()
        except (RefusedRequest, InputError):
            self._reports.program_error = self._fit_to_move()
            self._answer(client, message, done=False)
            return
        self._reports.begin(last_point)
        try:
            self._answer(client, message, done=True)
        finally:
            self._controller.go()

    def _start_program(self, number: int) -> None:
        """The program that the folder names. The same number starts nothing twice."""
        name, text = self._folder.chosen()
        self._controller.start(name, hashlib.sha256(text).hexdigest(), f"program {number}".encode(), self._reports)

    def _start_points(self) -> None:
        checksum = self._controller.store(PROGRAM, self.queue.program().encode())
        self._controller.start(PROGRAM, checksum, secrets.token_bytes(16), self._reports)

    def _fit_to_move(self) -> bool:
        """Whether it can only be the program why nothing moves."""
        state = self._controller.state
        fit = state.drives_on and state.cell_closed and state.mode == "auto"
        return fit and not (state.emergency_stop or state.alarms or self._reports.moving)

    def _queue_status(self) -> QueueStatus:
        return QueueStatus.BUSY if self._controller.faults.acts("queue_full") else self.queue.status

    def _answer(
        self, client: Client, message: Message, done: bool, status: QueueStatus | None = None, number: int | None = None
    ) -> None:
        if number is None:
            number = 0 if message.type == MessageType.PING else self.queue.last
        code = ReplyCode.SUCCESS if done else ReplyCode.FAILURE
        record = Point(queue_status=status or self._queue_status(), sequence_number=number)
        client.send(Message(message.type, CommType.REPLY, code, record))


class CnrServer:
    """Three ports, a folder of programs over FTP, and a publisher at a broker that runs already.

    Arguments and errors as of `open_server`. `port` is the trajectory's, with feedback, status and FTP on the
    next three; a moving arm stops when for a watchdog, not below `SHORTEST_WATCHDOG`, no feedback was answered.
    """

    def __init__(
        self,
        controller: Controller,
        address: str = "127.0.0.1",
        port: int = 0,
        watchdog: float = 0.5,
        broker: tuple[str, int] = BROKER,
        waits: bool = False,
        node_period: float | None = None,
    ) -> None:
        self.controller = controller
        watchdog = max(watchdog, SHORTEST_WATCHDOG)
        faults, cut = controller.faults, self.drop_clients
        trajectory, feedback, status, ftp = (port + k if port else 0 for k in range(4))
        node = None if node_period is None else LoopingNode(node_period)
        with ExitStack() as undo:
            publisher = undo.enter_context(closing(JointPublisher(broker, controller.robot, faults, cut, waits, node)))
            self._folder = undo.enter_context(closing(FtpFolder(controller, address, ftp, watchdog)))
            self._feedback = undo.enter_context(closing(LockStep(MessageType.FEEDBACK, address, feedback, faults, cut)))
            self._status = undo.enter_context(closing(LockStep(MessageType.STATUS, address, status, faults, cut)))
            reports = Reports(controller, self._feedback, self._status, publisher, cut, watchdog, waits)
            self._reports = undo.enter_context(closing(reports))
            self._trajectory = undo.enter_context(closing(TrajectoryPort(self, address, trajectory)))
            undo.callback(controller.shut_down)
            self._undo = undo.pop_all()
        self.press_start = self._trajectory.press_start
        self.ports = (self._trajectory.port, self._feedback.port, self._status.port, self._folder.port)
        names = zip(("trajectory", "feedback", "status", "ftp"), self.ports, strict=True)
        host, port = broker
        self.address = ",".join([address, *(f"{name}={number}" for name, number in names), f"mqtt={host}:{port}"])
        controller.when_restarting.append(self._restart)

    def close(self) -> None:
        """Bring the arm to rest, tell so, and stop serving."""
        self._undo.close()

    def drop_clients(self) -> None:
        """Cut every connection, as a pulled cable does."""
        for part in (self._folder, self._feedback, self._status, self._trajectory):
            part.hang_up()

    def _left(self) -> None:
        self._feedback.drop()
        self._status.drop()
        self.controller.stop(EndReason.WATCHDOG, "the client is gone")

    def _restart(self) -> None:
        self._trajectory.queue.clear()
        self._folder.forget()
        self.drop_clients()
