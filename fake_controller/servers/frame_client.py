"""A client that speaks frames, whatever carries them, and what it asks for; the frames are in docs/wire-tcp.md."""

from __future__ import annotations

import hashlib
import time
from abc import ABC, abstractmethod
from typing import Any

from drivers.errors import ProtocolError
from drivers.wire import frames as wire
from drivers.wire.reasons import EndReason, Refusal
from fake_controller.controller import CONTROLLER, PERIOD, VERSION, Controller
from fake_controller.programs import RefusedRequest
from fake_controller.servers.base import stop_unheard

IDLE_LIMIT = 5.0  # s of silence after which nobody is taken to be at the other end


class Upload:
    """A program on its way in; `checksum` is the SHA-256 (hex) that was announced."""

    def __init__(self, name: str, size: int, checksum: str) -> None:
        self.name, self._size, self._checksum = name, size, checksum.lower()
        self._data = bytearray()

    def add(self, offset: int, data: bytes) -> None:
        """Take the next block.

        Raises:
            RefusedRequest: it is not the next, or too much.
        """
        if offset != len(self._data):
            raise RefusedRequest(Refusal.BAD_REQUEST, f"a block for byte {offset}, where {len(self._data)} comes next")
        if offset + len(data) > self._size:
            raise RefusedRequest(Refusal.TOO_LARGE, f"more than the {self._size} bytes that were announced")
        self._data += data

    def complete(self) -> bytes:
        """All of it.

        Raises:
            RefusedRequest: something is missing or damaged.
        """
        if len(self._data) != self._size:
            raise RefusedRequest(Refusal.BAD_REQUEST, f"{len(self._data)} of {self._size} bytes came")
        if hashlib.sha256(self._data).hexdigest() != self._checksum:
            raise RefusedRequest(Refusal.CHECKSUM, "the bytes that came are not those of the checksum; send them again")
        return bytes(self._data)


class FrameClient(ABC):
    """Requests of one client of one controller; a subclass has the wire, and is the motion's `Listener`."""

    def __init__(self, controller: Controller) -> None:
        self.controller = controller
        self._greeted = self._driving = False  # the second: this client's motion runs
        self._upload: Upload | None = None
        self._watchdog, self._silence = IDLE_LIMIT, 0.0  # s; the second since the last frame

    @abstractmethod
    def _reply(self, message: Any, request: int) -> None:
        """Send an answer."""

    @abstractmethod
    def _greet(self, hello: wire.Hello, request: int) -> None:
        """Take the client, if its version is spoken here, or refuse it."""

    def _begin(self) -> None:  # noqa: B027  # a wire may have nothing to do for it
        """A motion of this client is about to give samples."""

    @abstractmethod
    def _fetched(self, first: int, count: int) -> Any:
        """The message with samples that are asked for again, the first at or after `first`.

        Raises:
            RefusedRequest: there are none.
        """

    def _take(self, data: bytes, decoder: wire.FrameDecoder, began: float) -> None:
        """Answer what came since `began` [s, monotonic]; an arm whose client is silent for its watchdog stops."""
        # A stall of this process is not the client's silence: no turn counts for more than it should last.
        self._silence += min(time.monotonic() - began, self._watchdog / 4)
        for frame in decoder.feed(self.controller.faults.heard(data)):
            self._silence = 0.0
            self._answer(frame)
        if self._driving and self._silence >= self._watchdog:
            stop_unheard(self.controller, self._watchdog)

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
                reply = self._fetched(first, count)
            case _:
                raise RefusedRequest(Refusal.UNKNOWN_MESSAGE, f"{type(message).__name__} is not a request")
        self._reply(reply, request)

    def _check_version(self, hello: wire.Hello) -> None:
        if hello.version < wire.VERSION:
            raise RefusedRequest(Refusal.UNSUPPORTED_VERSION, f"version {wire.VERSION} of the link is spoken here")

    def _start(self, name: str, checksum: str, motion_id: bytes, request: int) -> None:
        self.controller.start(name, checksum, motion_id, self)  # type: ignore[arg-type]
        self._begin()
        self._driving = True
        try:
            self._reply(wire.Started(motion_id), request)
        finally:
            self.controller.go()

    def _current_upload(self) -> Upload:
        if self._upload is None:
            raise RefusedRequest(Refusal.BAD_REQUEST, "no upload has begun")
        return self._upload
