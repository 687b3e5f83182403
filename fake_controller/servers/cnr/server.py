"""The link that CNR's open socket programs and C5G Open node give a COMAU controller; docs/real-robot.md has it."""

from __future__ import annotations

from contextlib import ExitStack

from drivers.wire.cnr import MessageType
from drivers.wire.reasons import EndReason
from fake_controller.controller import Controller
from fake_controller.servers.base import BROKER
from fake_controller.servers.cnr.commands import TrajectoryPort
from fake_controller.servers.cnr.ftp import FtpFolder
from fake_controller.servers.cnr.mqtt import JointPublisher, LoopingNode
from fake_controller.servers.cnr.reports import Reports
from fake_controller.servers.cnr.sockets import LockStep

SHORTEST_WATCHDOG = 0.5  # s


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
        cut = self.drop_clients
        trajectory, feedback, status, ftp = (port + k if port else 0 for k in range(4))
        node = None if node_period is None else LoopingNode(node_period)
        with ExitStack() as undo:
            self._publisher = JointPublisher(broker, controller.robot, controller.faults, cut, waits, node)
            undo.callback(self._publisher.close)
            self._folder = FtpFolder(controller, address, ftp, watchdog)
            undo.callback(self._folder.close)
            self._feedback = LockStep(MessageType.FEEDBACK, address, feedback, controller.faults, cut)
            undo.callback(self._feedback.close)
            self._status = LockStep(MessageType.STATUS, address, status, controller.faults, cut)
            undo.callback(self._status.close)
            self._reports = Reports(controller, self._feedback, self._status, self._publisher, cut, watchdog, waits)
            undo.callback(self._reports.close)
            self._trajectory = TrajectoryPort(
                controller, self._folder, self._reports, address, trajectory, cut, self._left
            )
            undo.callback(self._trajectory.close)
            undo.callback(controller.shut_down)
            self._undo = undo.pop_all()
        self.ports = (self._trajectory.port, self._feedback.port, self._status.port, self._folder.port)
        names = zip(("trajectory", "feedback", "status", "ftp"), self.ports, strict=True)
        host, port = broker
        self.address = ",".join([address, *(f"{name}={number}" for name, number in names), f"mqtt={host}:{port}"])
        controller.when_restarting.append(self._restart)

    def close(self) -> None:
        """Bring the arm to rest, tell so, and stop serving."""
        self._undo.close()

    def press_start(self) -> None:
        """As `TrajectoryPort.press_start`."""
        self._trajectory.press_start()

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
