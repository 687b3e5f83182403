"""Atomic file writes, and checksums."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from agent.core.errors import AgentError, InputError
from drivers.texts import hide

#: A temporary folder younger than this [s] may have been made and not been held yet.
_YOUNG = 60.0


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a temporary path in the same folder; at the end of the block it is flushed to the disk and renamed.

    An error in the block, or at its end, leaves the old file unchanged.
    """
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.unlink(missing_ok=True)
        yield unfinished
        with open(unfinished, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(unfinished, path)
    finally:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)


def write_atomically(path: Path, text: str) -> Path:
    """Write a text, whole or not at all. A password that this process has read is left out.

    A device or a pipe is written to directly: a rename would replace it with a file.

    Raises:
        AgentError: disk full, read-only or no rights; the old file is untouched.
    """
    special = path.exists() and not path.is_file()
    try:
        with contextlib.nullcontext(path) if special else written_whole(path) as temporary:
            temporary.write_text(hide(text), encoding="utf-8")
    except OSError as error:
        raise AgentError(f"{path}: cannot be written: {error.strerror}; free space or rights?") from None
    return path


@contextmanager
def swept_folder(prefix: str) -> Iterator[Path]:
    """A folder among the system's temporary ones, for the time of the block. What processes that were killed have left
    there under the same prefix is cleared away first."""
    top = Path(tempfile.gettempdir())
    for old in top.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):  # in use, or somebody else's
            if time.time() - old.stat().st_mtime > _YOUNG:
                with _locked_folder(old):
                    shutil.rmtree(old)
    with tempfile.TemporaryDirectory(prefix=prefix, dir=top) as name, _locked_folder(Path(name)):
        yield Path(name)


@contextmanager
def _locked_folder(folder: Path) -> Iterator[None]:
    """Lock a file exclusively, or raise OSError; the system releases it when the process ends."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def open_regular(path: Path) -> BufferedReader:
    """Open a file to read its bytes; a pipe or a device, which may never end, is not waited for.

    Raises:
        InputError: no regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError(f"{path}: a folder, pipe or device, not a regular file; copy its content into one")
    return open(descriptor, "rb")


def sha256_text(text: str) -> str:
    """SHA-256 (hex) of the UTF-8 text."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def sha256_file(path: Path) -> str:
    """SHA-256 (hex) of a regular file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
