"""One run at a time on one robot: a lock for everybody on this machine, whatever folder and user the agent runs in.

It is the system's (`flock`), so the end of a process, however it comes, lets go of it. The file stands for nothing but
itself: whoever holds the lock takes it away at the end, and those that a killed process has left. Whoever got hold of
a file that was taken away tries again.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import stat
import time
from collections.abc import Iterator
from pathlib import Path

from agent.core import AgentError, BusyError

#: Where every user may leave a file; the first that is there. Not the temporary folder: each user may have its own.
FOLDERS = (Path("/run/lock"), Path("/tmp"))
_NAME = "calibration-agent-{}.lock"
_READ = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK
_LEFT = 3600.0  # s old at least are files that count as left behind
_SWEPT = 0.1  # s after which nobody who takes leftovers away still holds one

#: How often this process holds a lock, by process and file; a forked one holds none.
_held: dict[tuple[int, Path], int] = {}


@contextlib.contextmanager
def robot_lock(driver: str, address: str) -> Iterator[None]:
    """Hold the lock of one controller. A process that holds it may take it again.

    Raises:
        BusyError: another run holds it.
        AgentError: no lock can be made.
    """
    path = lock_file(driver, address)
    key = os.getpid(), path
    if key in _held:
        _held[key] += 1
        try:
            yield
        finally:
            _held[key] -= 1
        return
    try:
        descriptor = _take(path)
    except OSError as error:
        raise AgentError(f"{path}: the robot's lock cannot be made: {error.strerror}; rights?") from None
    if descriptor is None:
        raise BusyError(f"{driver} {address}: another run holds this robot; wait for it to end, or stop it")
    _held[key] = 1
    try:
        yield
    finally:
        del _held[key]
        with contextlib.suppress(OSError):  # another user's: it stays, and locks as well
            path.unlink()
        os.close(descriptor)
        _take_leftovers_away()


def lock_file(driver: str, address: str) -> Path:
    """The file of a controller's lock."""
    name = hashlib.sha256(f"{driver}|{address}".encode()).hexdigest()[:16]
    folder = next((folder for folder in FOLDERS if _for_all(folder)), FOLDERS[-1])
    return folder / _NAME.format(name)


def _for_all(folder: Path) -> bool:
    """Whether every user may write there, so that all come to the same answer."""
    try:
        mode = folder.stat().st_mode
    except OSError:
        return False
    return stat.S_ISDIR(mode) and bool(mode & stat.S_IWOTH)


def _take_leftovers_away() -> None:
    for path in (path for folder in FOLDERS for path in folder.glob(_NAME.format("*"))):
        with contextlib.suppress(OSError):  # held, another user's, or gone by now
            if time.time() - path.lstat().st_mtime < _LEFT:
                continue
            descriptor = os.open(path, _READ)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if _is_at(descriptor, path):
                    path.unlink()
            finally:
                os.close(descriptor)


def _take(path: Path) -> int | None:
    """A descriptor that holds the lock; None where another process does."""
    until = time.monotonic() + _SWEPT
    while True:
        descriptor = _open(path)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                return descriptor
        except BlockingIOError:
            if time.monotonic() > until:
                os.close(descriptor)
                return None
            time.sleep(_SWEPT / 4)
        except FileNotFoundError:
            pass
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    here, there = os.fstat(descriptor), os.stat(path)
    return (here.st_dev, here.st_ino) == (there.st_dev, there.st_ino)


def _open(path: Path) -> int:
    """Open, or make, the file. To read is enough for a lock, and a file of another user is not opened for more."""
    while True:
        try:
            return os.open(path, _READ)
        except FileNotFoundError:
            pass
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            continue
        os.fchmod(descriptor, 0o644)  # whatever the mask of this user says
        return descriptor
