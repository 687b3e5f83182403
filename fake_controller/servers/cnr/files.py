"""The folder of programs on the controller, over FTP: stored programs are translated at once."""

from __future__ import annotations

import json
import logging
import socket
import tempfile
import threading
import warnings
from contextlib import suppress
from pathlib import Path

from pyftpdlib.authorizers import DummyAuthorizer
from pyftpdlib.handlers import DTPHandler, FTPHandler
from pyftpdlib.ioloop import IOLoop
from pyftpdlib.servers import FTPServer

from drivers.wire.cnr import IDENTITY_FILE, PROGRAM_FILE
from drivers.wire.reasons import Refusal
from fake_controller.controller import CONTROLLER, PERIOD, VERSION, Controller
from fake_controller.faults import Faults
from fake_controller.program.memory import MAX_PROGRAM, MAX_PROGRAMS, RefusedRequest
from fake_controller.servers.base import listening_socket

MAX_CONNECTIONS = 8
_MAX_FILES = 4 * MAX_PROGRAMS
_PERMISSIONS = "elrwd"  # enter, list, retrieve, write, delete
_COMMANDS = ("USER", "PASS", "QUIT", "NOOP", "TYPE", "PASV", "EPSV", "STOR", "RETR", "DELE", "SIZE", "NLST", "LIST")
_CODES = {Refusal.MOVING: 450, Refusal.MEMORY_FULL: 552, Refusal.TOO_LARGE: 552, Refusal.BAD_REQUEST: 553}
_POLL = 0.05  # s between two looks whether to go on

# The library's own complaints about what clients send belong in no terminal.
logging.getLogger("pyftpdlib").addHandler(logging.NullHandler())
logging.getLogger("pyftpdlib").propagate = False


class FtpFolder:
    """Serves one folder of its own, which ends with it; a thread of its own does it.

    `NAME.pdl` is stored and translated: `NAME.cod` appears next to it, or `NAME.err` with "line column message".
    `PROGRAM_FILE` names the program that a start runs.

    Args:
        controller: who translates, and holds the programs.
        address, port: where to listen; port 0 takes a free one.
        watchdog: of the link [s], for the identity file.

    Raises:
        OSError: the port is taken, or the address is not this machine's.
    """

    def __init__(self, controller: Controller, address: str, port: int, watchdog: float) -> None:
        self._controller, self._watchdog = controller, watchdog
        self._socket = listening_socket(address, port, controller.faults.refusing)
        self.port = self._socket.getsockname()[1]
        self._folder = tempfile.TemporaryDirectory(prefix="fake_controller_")
        self.path = Path(self._folder.name).resolve()
        self._loop, self._ending = IOLoop(), threading.Event()
        self._thread = threading.Thread(target=self._serve, name="ftp", daemon=True)
        self.write_identity()
        if not controller.faults.refusing:
            self._thread.start()

    def close(self) -> None:
        """Cut every connection, stop listening, and take the folder away."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._socket.close()
        self._folder.cleanup()

    def hang_up(self) -> None:
        """Cut every connection, as a pulled cable does."""
        for connection in list(self._loop.socket_map.values()):
            if connection.socket is not self._socket:
                with suppress(OSError):
                    connection.socket.shutdown(socket.SHUT_RDWR)

    def delete(self, file: Path) -> None:
        """Take a program away, and what its translation left."""
        for ending in (".pdl", ".cod", ".err"):
            file.with_suffix(ending).unlink(missing_ok=True)

    def forget(self) -> None:
        """Delete all programs."""
        for file in self.path.iterdir():
            if file.name != IDENTITY_FILE:
                file.unlink(missing_ok=True)

    def write_identity(self) -> None:
        """The file that says whose controller this is, as things stand now."""
        controller = self._controller
        identity = {
            "robot": controller.name,
            "serial": controller.serial,
            "controller": CONTROLLER,
            "version": VERSION,
            "joint_names": controller.robot.joint_names,
            "period": PERIOD,
            "emulator": controller.state.emulator,
            "watchdog": self._watchdog,
        }
        (self.path / IDENTITY_FILE).write_text(json.dumps(identity), encoding="utf-8")

    def chosen(self) -> tuple[str, bytes]:
        """Name and text of the program that is to be run.

        Raises:
            RefusedRequest: none is chosen, or it is not here.
        """
        try:
            name = (self.path / PROGRAM_FILE).read_text(encoding="utf-8").split()[0]
            files = {file.stem.lower(): file for file in self.path.glob("*.pdl")}
            return name, files[name.lower()].read_bytes()
        except (OSError, UnicodeDecodeError, IndexError, KeyError):
            raise RefusedRequest(Refusal.UNKNOWN_PROGRAM, f"{PROGRAM_FILE} names no program that is here") from None

    def check(self, file: Path) -> None:
        """Raises:
        RefusedRequest: a file of this name cannot be stored now.
        """
        if file.parent != self.path or (file.suffix != ".pdl" and file.name != PROGRAM_FILE):
            raise RefusedRequest(Refusal.BAD_REQUEST, f"only programs are stored here, as NAME.pdl, and {PROGRAM_FILE}")
        if file.suffix == ".pdl":
            self._controller.check_upload(file.stem, 0)
        if sum(1 for _ in self.path.iterdir()) >= _MAX_FILES:
            raise RefusedRequest(Refusal.MEMORY_FULL, "the folder is full; delete files")

    def take(self, file: Path) -> None:
        """Translate what has come.

        Raises:
            RefusedRequest: the controller does not take it.
        """
        if file.name == PROGRAM_FILE:
            return
        for ending in (".cod", ".err"):
            file.with_suffix(ending).unlink(missing_ok=True)
        try:
            self._controller.store(file.stem, file.read_bytes())
        except FileNotFoundError:
            raise RefusedRequest(Refusal.BAD_REQUEST, "the file is gone: the controller was switched off") from None
        except RefusedRequest as refused:
            if refused.reason is not Refusal.SYNTAX:
                file.unlink(missing_ok=True)
                raise
            text = f"{refused.line} {refused.column} {refused}\n"
            file.with_suffix(".err").write_text(text, encoding="utf-8")
            return
        file.write_bytes(self._controller.text(file.stem))
        file.with_suffix(".cod").touch()

    def _serve(self) -> None:
        shared = {"folder": self, "faults": self._controller.faults, "authorizer": _anybody(self.path)}
        handler = type("Session", (_Session,), shared)
        server = FTPServer(self._socket, handler, ioloop=self._loop, backlog=MAX_CONNECTIONS)
        server.max_cons = MAX_CONNECTIONS
        while not self._ending.is_set():
            self._loop.loop(timeout=_POLL, blocking=False)
        server.close_all()


class _Transfer(DTPHandler):
    """One file on its way. A program is translated before its end is confirmed."""

    cmd_channel: _Session

    def handle_read(self) -> None:
        super().handle_read()
        if self.tot_bytes_received > MAX_PROGRAM and not self._closed:
            self._resp = (f"552 more than the {MAX_PROGRAM} bytes that a program may have", logging.debug)
            self.close()

    handle_read_event = handle_read

    def close(self) -> None:
        if self.receive and self.transfer_finished and not self._closed:
            self.file_obj.close()
            try:
                self.cmd_channel.folder.take(Path(self.file_obj.name))
            except RefusedRequest as refused:
                self._resp = (_answer(refused), logging.debug)
        super().close()


class _Session(FTPHandler):
    """One client; what it is sent and what it says goes through the faults of the wire."""

    folder: FtpFolder
    faults: Faults
    dtp_handler = _Transfer
    banner = f"{CONTROLLER} {VERSION}"
    use_sendfile = False
    proto_cmds = {name: what for name, what in FTPHandler.proto_cmds.items() if name in _COMMANDS}  # noqa: RUF012

    def push(self, data: str) -> None:
        with suppress(ConnectionResetError):
            self.faults.send(data.encode(), self._put, self.close_when_done, spare=False)

    def recv(self, buffer_size: int) -> bytes:
        return self.faults.heard(super().recv(buffer_size))

    def ftp_STOR(self, file: str, mode: str = "w") -> str | None:
        try:
            self.folder.check(Path(file))
        except RefusedRequest as refused:
            self.respond(_answer(refused))
            return None
        return super().ftp_STOR(file, mode)

    def ftp_DELE(self, path: str) -> None:
        file = Path(path)
        if file.suffix != ".pdl" or not file.exists():
            self.respond("550 there is no such program")
            return
        self.folder.delete(file)
        self.respond("250 deleted")

    def on_incomplete_file_received(self, file: str) -> None:
        Path(file).unlink(missing_ok=True)

    def _put(self, frame: bytes) -> None:
        super().push(frame.decode("utf-8", "replace"))


def _answer(refused: RefusedRequest) -> str:
    return f"{_CODES.get(refused.reason, 550)} {str(refused).splitlines()[0]}"


def _anybody(path: Path) -> DummyAuthorizer:
    """Everybody may read and store, as on a controller without passwords; it is in one folder that ends with us."""
    authorizer = DummyAuthorizer()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        authorizer.add_anonymous(str(path), perm=_PERMISSIONS)
    return authorizer
