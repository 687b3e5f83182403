"""One run at a time per robot: a lock for all users and folders of this machine.

Every run makes a file that only its user can write to, and holds the system's exclusive lock on it (`fcntl`), which the
system releases when the process ends, however it ends. A robot is busy while somebody else holds one of its files.
Shared locks, for which read access is enough, are ignored, so no user can block another; neither can a file that
somebody else put there.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import random
import secrets
import stat
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from agent.core import AgentError, BusyError
from drivers.endpoints import endpoints
from drivers.texts import place_of

#: Where every user may leave a file; the first that is there. Not the temporary folder: each user may have its own.
FOLDERS = (Path("/run/lock"), Path("/tmp"))
_NAME = "calibration-agent-{}-{}-{}.lock"  # robot, process, any
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
_LEFT = 3600.0  # s old at least are files that count as left behind
_PATIENCE = 0.1  # s, for two runs that begin at once

#: How often this process holds a lock, by process and robot; a forked one holds none.
_held: Counter[tuple[int, str]] = Counter()
#: Files of this process: closing one releases its lock.
_own: set[tuple[int, Path]] = set()


@contextlib.contextmanager
def robot_lock(driver: str, address: str) -> Iterator[None]:
    """Hold the lock of one controller, however its address is spelt. A process may take its own lock again.

    Raises:
        BusyError: another run holds it.
        AgentError: no lock can be made.
    """
    with contextlib.ExitStack() as held:
        for endpoint in endpoints(driver, address):
            held.enter_context(_locked(endpoint, f"{driver} {place_of(address)}"))
        yield


@contextlib.contextmanager
def _locked(endpoint: str, robot: str) -> Iterator[None]:
    key = os.getpid(), _digest(endpoint)
    taken = None
    if not _held[key]:
        try:
            taken = _take(key[1], robot)
        except OSError as error:
            raise AgentError(f"{_folder()}: the robot's lock cannot be made there: {error.strerror}; rights?") from None
    _held[key] += 1
    try:
        yield
    finally:
        _held[key] -= 1
        if taken is not None:
            _let_go(*taken)
            _take_leftovers_away()


def lock_files(driver: str, address: str) -> list[Path]:
    """Lock files of a controller, held or left behind."""
    return [path for one in endpoints(driver, address) for path in _folder().glob(_NAME.format(_digest(one), "*", "*"))]


def _digest(endpoint: str) -> str:
    return hashlib.sha256(endpoint.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _folder() -> Path:
    return next((folder for folder in FOLDERS if _for_all(folder)), FOLDERS[-1])


def _for_all(folder: Path) -> bool:
    """Whether every user may write there, so that all users choose the same folder."""
    try:
        mode = folder.stat().st_mode
    except OSError:
        return False
    return stat.S_ISDIR(mode) and bool(mode & stat.S_IWOTH)


def _take(name: str, robot: str) -> tuple[Path, int]:
    """A file of this process, and a descriptor that holds it.

    Each process holds its file before it looks for others, so of two that begin at once at least one sees the other.
    """
    until = time.monotonic() + _PATIENCE
    while True:
        path, descriptor = _made(name)
        holder = next(filter(None, (_holder(other) for other in path.parent.glob(_NAME.format(name, "*", "*")))), None)
        if holder is None:
            return path, descriptor
        _let_go(path, descriptor)
        if time.monotonic() > until:
            raise BusyError(f"{robot}: another run holds this robot ({holder}); wait for it to end, or stop it")
        time.sleep(random.uniform(0, _PATIENCE / 4))


def _made(name: str) -> tuple[Path, int]:
    """A new file, held; nobody else can open it before it is."""
    path = _folder() / _NAME.format(name, os.getpid(), secrets.token_hex(4))
    _own.add((os.getpid(), path))
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.fchmod(descriptor, 0o644)  # whatever the mask of this user says
    except BaseException:
        _let_go(path, descriptor)
        raise
    return path, descriptor


def _let_go(path: Path, descriptor: int) -> None:
    with contextlib.suppress(OSError):  # somebody else has taken it away
        path.unlink()
    os.close(descriptor)
    _own.discard((os.getpid(), path))


def _holder(path: Path) -> str | None:
    """Who holds a file of another process; None for nobody."""
    if (os.getpid(), path) in _own:
        return None
    try:
        descriptor = os.open(path, _READ)
    except OSError:  # gone by now, or its owner has not held it yet and will look for ours
        return None
    try:
        about = os.fstat(descriptor)
        if stat.S_ISREG(about.st_mode):
            fcntl.lockf(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # not refused by others that only read
        return None
    except OSError:
        return f"process {path.name.split('-')[-2]} of user {about.st_uid}"
    finally:
        os.close(descriptor)


def _take_leftovers_away() -> None:
    for path in (path for folder in FOLDERS for path in folder.glob(_NAME.format("*", "*", "*"))):
        with contextlib.suppress(OSError):  # another user's, or gone by now
            old = time.time() - path.lstat().st_mtime > _LEFT
            if old and _holder(path) is None and (os.getpid(), path) not in _own:
                path.unlink()
