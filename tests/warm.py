"""Programs of ours as processes of their own, forked from one that has imported the libraries they use.

A fresh interpreter spends most of a second on imports, and the tests start hundreds. What runs is what
`python -m MODULE …` runs: arguments, environment, folder, files, signals and exit code are its own. Where the start
itself is what is tested, take `subprocess`.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: What ours import only where they need it.
_LIBRARIES = (
    "clarabel",
    "jinja2",
    "mcap_ros2.decoder",
    "rich.progress",
    "ruamel.yaml",
    "scipy.ndimage",
    "scipy.signal",
    "threadpoolctl",
)
_LONGEST = 1 << 20  # bytes of a request
_HEADER = 8  # bytes of its length
_DOOR = "CALIBRATION_NURSERY"  # in the environment: where a shared one is
#: A command that has a process forked, and ends as it does; one that becomes another program starts by itself.
_COMMAND = """\
#!{python} -IS
import json, os, socket, sys
if sys.argv[1] == "{other}":
    os.execv(sys.executable, [sys.executable, "-m", "{module}", *sys.argv[1:]])
asked = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
asked.connect("{door}")
socket.send_fds(asked, [json.dumps([sys.argv[1:], os.getcwd(), dict(os.environ)]).encode()], [1, 2])
sys.exit(int(asked.recv(8)))
"""


class WarmProcess:
    """`python -m MODULE ARGUMENTS` with standard output and errors to these files; input is empty, or a terminal.

    It leads the session of its `terminal`, if it is given one. `environment` is added to that of the tests.
    """

    def __init__(
        self,
        module: str,
        *arguments: object,
        cwd: Path = ROOT,
        stdout: int,
        stderr: int,
        terminal: int | None = None,
        **environment: str,
    ) -> None:
        self.returncode: int | None = None
        self._status, ended = os.pipe()
        with open(os.devnull) as nothing:
            files = [nothing.fileno() if terminal is None else terminal, stdout, stderr, ended]
            env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
            request = {"module": module, "arguments": list(map(str, arguments)), "cwd": str(cwd), "env": env}
            request["leads"] = terminal is not None
            self.pid = _nursery()(request, files)
        os.close(ended)

    def poll(self, patience: float | None = 0.0) -> int | None:
        """Its exit code, negative if a signal ended it; None if it still runs after a number of seconds."""
        if self.returncode is None and select.select([self._status], [], [], patience)[0]:
            told = os.read(self._status, _HEADER)  # nothing where the one that forked it was killed: so was it
            os.close(self._status)
            self.returncode = int(told) if told else -signal.SIGKILL
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code once it has ended.

        Raises:
            TimeoutExpired: it runs on.
        """
        code = self.poll(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        """Unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """End it as a power cut does."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)


class PipedProcess(WarmProcess):
    """The same with pipes, as far as `subprocess.Popen` goes here; it is killed as its context ends."""

    def __init__(self, module: str, *arguments: object, cwd: Path = ROOT) -> None:
        pipes = [os.pipe(), os.pipe()]
        super().__init__(module, *arguments, cwd=cwd, stdout=pipes[0][1], stderr=pipes[1][1])
        for _, end in pipes:
            os.close(end)
        self.stdout, self.stderr = (os.fdopen(end, encoding="utf-8") for end, _ in pipes)

    def communicate(self) -> tuple[str, str]:
        """What is left of output and errors, once it has ended."""
        with ThreadPoolExecutor(1) as aside:
            errors = aside.submit(self.stderr.read)
            output = self.stdout.read()
            self.wait()
            return output, errors.result()

    def __enter__(self) -> PipedProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self.wait()
        self.stdout.close()
        self.stderr.close()


def run(module: str, *arguments: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a module to its end."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        process = WarmProcess(module, *arguments, cwd=cwd, stdout=out.fileno(), stderr=err.fileno(), **environment)
        try:
            code = process.wait()
        finally:
            process.kill()
        out.seek(0), err.seek(0)
        text = (file.read().decode().replace("\r\n", "\n") for file in (out, err))
        return subprocess.CompletedProcess([sys.executable, "-m", module, *map(str, arguments)], code, *text)


@contextlib.contextmanager
def shell_command(file: Path, module: str, other: str) -> Iterator[None]:
    """Write a command for a shell that does what `python -m MODULE` does; where it begins with `other`, by itself."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as door:
        door.bind(f"{folder}/door")
        door.listen()
        file.write_text(_COMMAND.format(python=sys.executable, other=other, module=module, door=f"{folder}/door"))
        file.chmod(0o755)

        def serve() -> None:
            while True:
                with door.accept()[0] as asked:
                    request, files, _, _ = socket.recv_fds(asked, _LONGEST, 2)
                    arguments, cwd, environment = json.loads(request)
                    process = WarmProcess(module, *arguments, cwd=cwd, stdout=files[0], stderr=files[1], **environment)
                    for one in files:
                        os.close(one)
                    asked.send(str(process.wait() & 0xFF).encode())

        threading.Thread(target=serve, daemon=True).start()
        yield


@contextlib.contextmanager
def shared_nursery() -> Iterator[None]:
    """One for all processes of the tests that are started meanwhile: to import everything takes seconds in each."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as door:
        door.bind(f"{folder}/door")
        door.listen(64)
        with _started(door):
            os.environ[_DOOR] = f"{folder}/door"
            try:
                yield
            finally:
                del os.environ[_DOOR]


def _started(door: socket.socket | None = None) -> socket.socket:
    """A connection with a new one, which ends with it; others may come by the `door`."""
    ours, theirs = socket.socketpair()
    with theirs:
        files = [ends.fileno() for ends in (theirs, door) if ends is not None]
        command = [sys.executable, __file__, *map(str, files)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        subprocess.Popen(command, pass_fds=files, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL)
    return ours


@functools.cache
def _nursery() -> object:
    """What asks for a process: a function of a request and its four files that returns the number of the process."""
    if _DOOR in os.environ:
        ours = socket.socket(socket.AF_UNIX)
        ours.connect(os.environ[_DOOR])
    else:
        ours = _started()

    def ask(request: dict[str, object], files: list[int]) -> int:
        data = json.dumps(request).encode()
        socket.send_fds(ours, [f"{len(data):{_HEADER}}".encode()], files)
        ours.sendall(data)
        return int(ours.recv(_HEADER))

    return ask


class _Nursery:
    """Forks what is asked for, until the `owner` is gone.

    Others come by the `door`. What somebody asked for ends when he goes.
    """

    def __init__(self, owner: socket.socket, door: socket.socket | None = None) -> None:
        self._owner, self._door = owner, door
        self._sockets = [owner] if door is None else [owner, door]
        self._running: dict[int, tuple[int, socket.socket]] = {}  # where the exit code goes, and who asked
        self._ended, self._noticed = os.pipe()

    def serve(self) -> dict[str, object] | None:
        """Returns in every child what it has to run."""
        os.set_blocking(self._noticed, False)
        signal.set_wakeup_fd(self._noticed, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        while self._owner in self._sockets:
            ready = select.select([*self._sockets, self._ended], [], [])[0]
            if self._ended in ready:
                os.read(self._ended, _LONGEST)
            self._tell_ends()
            for asked in [connection for connection in self._sockets if connection in ready]:
                if asked is self._door:
                    self._sockets.append(asked.accept()[0])
                elif (request := self._answered(asked)) is not None:
                    return request
        return None

    def _tell_ends(self) -> None:
        for pid in list(self._running):
            gone, status = os.waitpid(pid, os.WNOHANG)
            if gone:
                file, _ = self._running.pop(pid)
                with contextlib.suppress(BrokenPipeError):
                    os.write(file, str(os.waitstatus_to_exitcode(status)).encode())
                os.close(file)

    def _answered(self, asked: socket.socket) -> dict[str, object] | None:
        """Fork what is asked for on a connection; None but in the child."""
        header, files = b"", list[int]()
        with contextlib.suppress(ConnectionError):
            header, files, _, _ = socket.recv_fds(asked, _HEADER, 4)
        if not header:
            for pid, (_, asker) in self._running.items():
                if asked in (asker, self._owner):
                    os.kill(pid, signal.SIGKILL)
            self._sockets.remove(asked)
            return None
        request = json.loads(asked.recv(int(header), socket.MSG_WAITALL))
        pid = os.fork()
        if pid == 0:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            for place, file in enumerate(files[:3]):
                os.dup2(file, place)
            others = [file for file, _ in self._running.values()]
            others += [connection.detach() for connection in self._sockets]
            for file in (*files, self._ended, self._noticed, *others):
                os.close(file)
            return request
        self._running[pid] = files[3], asked
        for file in files[:3]:
            os.close(file)
        with contextlib.suppress(ConnectionError):
            asked.sendall(f"{pid:{_HEADER}}".encode())
        return None


def _become(request: dict) -> None:
    """Steps of an interpreter before its module runs."""
    if request["leads"]:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    time.tzset()
    tempfile.tempdir = None
    sys.argv = [request["module"], *request["arguments"]]
    paths = [path for path in request["env"].get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:1] = [os.getcwd(), *(path for path in paths if path not in sys.path)]
    for name, place, mode in (("stdin", 0, "r"), ("stdout", 1, "w"), ("stderr", 2, "w")):
        stream = os.fdopen(
            place, mode, closefd=False, encoding="utf-8", errors=None if place < 2 else "backslashreplace"
        )
        stream.reconfigure(line_buffering=place == 2 or os.isatty(place))
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def _ran(module: str) -> int:
    """The exit code of a module that ran as the main one; all is done that an interpreter does at its end, but for
    taking apart what was imported."""
    code: object = 0
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        code = end.code
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    if code is not None and not isinstance(code, int):
        print(code, file=sys.stderr)
        code = 1
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    return int(code or 0)


def _import_all() -> None:
    """Ours too: tests/test_house.py finds no circle among them, so their order does not matter."""
    gc.disable()
    ours = [one.name for one in pkgutil.walk_packages([str(ROOT)]) if not one.name.endswith("__main__")]
    for name in (*_LIBRARIES, *ours):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    gc.freeze()
    gc.enable()


if __name__ == "__main__":
    _import_all()
    wanted = _Nursery(*(socket.socket(fileno=int(file)) for file in sys.argv[1:])).serve()
    if wanted is not None:
        _become(wanted)
        os._exit(_ran(wanted["module"]))
