"""One run at a time per robot: a lock for all users and folders of this machine.

Every run makes a file that only its user can write to, and holds an exclusive lock on it (`fcntl`). The system
releases the lock when the process ends, however it ends. A robot is busy while another process holds one of its files.
Shared locks, which need read access only, are ignored, so no user can block another with them or with foreign files.
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
from drivers.texts import public_address

#: Folders that every user may write to; the first that exists. The temporary folder may differ by user.
FOLDERS = (Path("/run/lock"), Path("/tmp"))
_NAME = "calibration-agent-{}-{}-{}.lock"  # robot, process, any
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
_PATIENCE = 0.1  # s, for two runs that start together

#: Number of times this process holds a lock, by process and robot; a forked process holds none.
_held: Counter[tuple[int, str]] = Counter()
#: Files of this process: closing one releases its lock.
_own: set[tuple[int, Path]] = set()


@contextlib.contextmanager
def robot_lock(driver: str, address: str) -> Iterator[None]:
    """Hold the lock of one controller, however its address is spelled. A process may take its own lock again.

    Raises:
        BusyError: another run holds it.
        AgentError: no lock can be made.
    """
    with contextlib.ExitStack() as locks:
        for endpoint in endpoints(driver, address):
            locks.enter_context(_locked(endpoint, f"{driver} {public_address(address)}"))
        yield


@contextlib.contextmanager
def _locked(endpoint: str, robot: str) -> Iterator[None]:
    key = os.getpid(), _digest(endpoint)
    lock = None
    if not _held[key]:
        try:
            lock = _take(key[1], robot)
        except OSError as error:
            raise AgentError(f"{_folder()}: the robot's lock cannot be made there: {error.strerror}; rights?") from None
    _held[key] += 1
    try:
        yield
    finally:
        _held[key] -= 1
        if lock is not None:
            _let_go(*lock)


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

    Each process holds its file before it looks for others, so one of two that start together sees the other.
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
    """A new file, locked before anybody else can open it."""
    path = _folder() / _NAME.format(name, os.getpid(), secrets.token_hex(4))
    _own.add((os.getpid(), path))
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.fchmod(descriptor, 0o644)  # regardless of the user's umask
    except BaseException:
        _let_go(path, descriptor)
        raise
    return path, descriptor


def _let_go(path: Path, descriptor: int) -> None:
    with contextlib.suppress(OSError):  # already removed
        path.unlink()
    os.close(descriptor)
    _own.discard((os.getpid(), path))


def _holder(path: Path) -> str | None:
    """Who holds a file of another process; None for nobody."""
    if (os.getpid(), path) in _own:
        return None
    try:
        descriptor = os.open(path, _READ)
    except OSError:  # gone, or not locked yet: its owner then looks for ours
        return None
    try:
        about = os.fstat(descriptor)
        if stat.S_ISREG(about.st_mode):
            fcntl.lockf(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # other readers do not refuse it
        return None
    except OSError:
        return f"process {path.name.split('-')[-2]} of user {about.st_uid}"
    finally:
        os.close(descriptor)
