"""The binary TCP server; the wire is in docs/wire-tcp.md."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
import time
from functools import partial
from typing import Any

import numpy as np

from drivers.errors import ProtocolError
from drivers.wire import tcp as wire
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.controller import CONTROLLER, PERIOD, VERSION, Controller
from fake_controller.execution import Slice
from fake_controller.program.memory import RefusedRequest, Upload
from fake_controller.servers.base import IDLE_LIMIT, RECEIVE, accepted, listening_socket, name_of, stop_unheard

MAX_CONNECTIONS = 8
WATCHDOG_RANGE = (0.05, 5.0)  # s
LINGER = 1.0  # s


class TcpServer:
    """Listens for clients of one controller. The first to greet holds it; others are refused until it leaves.

    Arguments and errors as of `open_server`.
    """

    def __init__(
        self,
        controller: Controller,
        address: str = "127.0.0.1",
        port: int = 0,
        watchdog: float = WATCHDOG_RANGE[0],
    ) -> None:
        self.controller, self.watchdog = controller, watchdog
        self._listener = listening_socket(address, port, controller.faults.refusing, MAX_CONNECTIONS)
        self.port, self.address = self._listener.getsockname()[1], name_of(self._listener.getsockname())
        self._lock, self._closing = threading.Lock(), threading.Event()
        self._sessions: set[Session] = set()
        self._holder: Session | None = None
        self._thread = threading.Thread(target=self._accept, name="accept", daemon=True)
        if not controller.faults.refusing:
            self._thread.start()
        controller.when_restarting.append(self.drop_clients)

    def close(self) -> None:
        """Bring the arm to rest, tell the clients, and stop listening."""
        self._closing.set()
        self.controller.shut_down()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for session in self.drop_clients():
            session.join()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def drop_clients(self) -> list[Session]:
        """Cut every connection, as a pulled cable does."""
        with self._lock:
            sessions = list(self._sessions)
        for session in sessions:
            session.close()
        return sessions

    def hold(self, session: Session) -> bool:
        """Give the controller to a session unless another has it."""
        with self._lock:
            if self._holder not in (None, session):
                return False
            self._holder = session
            return True

    def left(self, session: Session) -> None:
        """A session is over."""
        with self._lock:
            self._sessions.discard(session)
            if self._holder is session:
                self._holder = None

    def _accept(self) -> None:
        for connection in accepted(self._listener, self._closing):
            with self._lock:
                if len(self._sessions) >= MAX_CONNECTIONS:
                    connection.close()
                    continue
                session = Session(self, connection)
                self._sessions.add(session)
            self.controller.faults.heal()
            session.start()


class Session:
    """One client. Its reader thread carries out requests; another sends heartbeats; motion sends from its own."""

    def __init__(self, server: TcpServer, connection: socket.socket) -> None:
        self.controller, self._server, self._socket = server.controller, server, connection
        self._greeted = self._driving = False  # the second: this client's motion runs
        self._upload: Upload | None = None
        self._watchdog, self._silence = IDLE_LIMIT, 0.0  # s; the second since the last frame
        self._send_lock, self._closed = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._serve, name="session", daemon=True)
        self.start, self.join = self._thread.start, partial(self._thread.join, 2 * LINGER)

    def close(self, how: int = socket.SHUT_WR) -> None:
        """Say that nothing more will come; the reader thread does the rest."""
        self._closed.set()
        with contextlib.suppress(OSError):
            self._socket.shutdown(how)

    def on_samples(self, first: int, time_ns: np.ndarray, samples: Slice) -> None:
        """Stream what the arm just did; a client that is gone ends the motion."""
        for begin in range(0, len(samples), wire.MAX_BATCH):
            chosen = slice(begin, begin + wire.MAX_BATCH)
            self._send_or_close(wire.Samples(first + begin, time_ns[chosen], *samples.part(chosen).columns))

    def on_end(self, reason: EndReason, samples: int, message: str) -> None:
        """Tell that the arm rests."""
        self._driving = False
        self._send_or_close(wire.End(reason, samples, message))

    def _serve(self) -> None:
        try:
            self._read()
        except ProtocolError as error:
            with contextlib.suppress(OSError):
                self._reply(wire.Refused(Refusal.BAD_REQUEST, 0, 0, f"{error}; the connection is closed"))
        except OSError:
            pass
        finally:
            self.close()
            if self._driving:
                self.controller.stop(EndReason.WATCHDOG, "the client is gone")
            self._server.left(self)
            self._linger()
            self._socket.close()

    def _linger(self) -> None:
        """Read on until the client has closed too: closing on unread data would take back what it has not read yet."""
        until = time.monotonic() + LINGER
        with contextlib.suppress(OSError):
            while (remaining := until - time.monotonic()) > 0:
                self._socket.settimeout(remaining)
                if not self._socket.recv(RECEIVE):
                    return

    def _read(self) -> None:
        decoder = wire.FrameDecoder(wire.MAX_REQUEST_PAYLOAD)
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            while not self._closed.is_set():
                began, data = time.monotonic(), b""
                if selector.select(self._watchdog / 4):
                    data = self._socket.recv(RECEIVE)
                    if not data:
                        return
                # A stall of this process is not the client's silence: no turn counts for more than it should last.
                self._silence += min(time.monotonic() - began, self._watchdog / 4)
                for frame in decoder.feed(self.controller.faults.heard(data)):
                    self._silence = 0.0
                    self._answer(frame)
                if self._driving and self._silence >= self._watchdog:
                    stop_unheard(self.controller, self._watchdog)
                if self._silence >= IDLE_LIMIT:
                    return

    def _answer(self, frame: wire.Frame) -> None:
        try:
            message = wire.decode(frame)
            if not isinstance(message, wire.Heartbeat):
                self._carry_out(message, frame.request)
        except ProtocolError as error:
            self._reply(wire.Refused(Refusal.UNKNOWN_MESSAGE, 0, 0, str(error)), frame.request)
        except RefusedRequest as refused:
            self._reply(wire.Refused(refused.reason, refused.line, refused.column, str(refused)), frame.request)

    def _carry_out(self, message: Any, request: int) -> None:  # noqa: C901
        if isinstance(message, wire.Hello):
            self._greet(message, request)
            return
        if not self._greeted:
            raise RefusedRequest(Refusal.BAD_REQUEST, "the first message must be the greeting")
        controller = self.controller
        reply: Any = wire.Done()
        match message:
            case wire.Identify():
                names = controller.robot.joint_names
                reply = wire.IdentityReply(controller.name, controller.serial, CONTROLLER, VERSION, names, PERIOD)
            case wire.AskStatus():
                name, checksum = controller.stored
                about: dict[str, Any] = {"program": name, "checksum": checksum, "position": tuple(controller.position)}
                reply = wire.StatusReply(**vars(controller.state), moving=controller.moving, **about)
            case wire.AskTemperatures():
                reply = wire.TemperaturesReply(controller.temperatures)
            case wire.AskFrames():
                base, uframe, tool = controller.frames
                reply = wire.FramesReply(base, tool, uframe)
            case wire.UploadBegin(name, size, checksum):
                controller.check_upload(name, size)
                self._upload = Upload(name, size, checksum)
            case wire.UploadBlock(offset, data):
                self._current_upload().add(offset, data)
            case wire.UploadEnd():
                upload, self._upload = self._current_upload(), None
                reply = wire.Stored(upload.name, controller.store(upload.name, upload.complete()))
            case wire.Start(name, checksum, motion_id):
                self._start(name, checksum, motion_id, request)
                return
            case wire.Stop():
                controller.stop(EndReason.STOPPED, "stopped on command")
            case wire.Fetch(first, count):
                first, time_ns, samples = controller.fetch(first, min(count, wire.MAX_BATCH))
                reply = wire.Samples(first, time_ns, *samples.columns)
            case _:
                raise RefusedRequest(Refusal.UNKNOWN_MESSAGE, f"{type(message).__name__} is not a request")
        self._reply(reply, request)

    def _greet(self, hello: wire.Hello, request: int) -> None:
        if self._greeted:
            raise RefusedRequest(Refusal.BAD_REQUEST, "the greeting comes once")
        if hello.version < wire.VERSION:
            raise RefusedRequest(Refusal.UNSUPPORTED_VERSION, f"version {wire.VERSION} of the link is spoken here")
        if not self._server.hold(self):
            raise RefusedRequest(Refusal.BUSY, "another client holds the controller; close it first")
        self._watchdog = min(max(hello.watchdog_ms / 1000, self._server.watchdog), WATCHDOG_RANGE[1])
        self._greeted = True
        self.controller.reach("connect")
        self._reply(wire.Welcome(wire.VERSION, round(self._watchdog * 1000)), request)
        threading.Thread(target=self._beat, name="heartbeat", daemon=True).start()

    def _start(self, name: str, checksum: str, motion_id: bytes, request: int) -> None:
        self.controller.start(name, checksum, motion_id, self)
        self._driving = True
        try:
            self._reply(wire.Started(motion_id), request)
        finally:
            self.controller.go()

    def _current_upload(self) -> Upload:
        if self._upload is None:
            raise RefusedRequest(Refusal.BAD_REQUEST, "no upload has begun")
        return self._upload

    def _beat(self) -> None:
        while not self._closed.wait(self._watchdog / 4):
            self._send_or_close(wire.Heartbeat())

    def _send_or_close(self, message: Any) -> None:
        try:
            self._reply(message)
        except OSError:
            self.close()

    def _reply(self, message: Any, request: int = 0) -> None:
        frame = wire.encode(message, request)
        with self._send_lock:
            heartbeat = isinstance(message, wire.Heartbeat)
            self.controller.faults.send(frame, self._socket.sendall, partial(self.close, socket.SHUT_RDWR), heartbeat)
