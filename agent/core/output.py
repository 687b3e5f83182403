"""Messages that never block the program: a frozen terminal, a full pipe or a closed reader delays only its own text.

The thread that watches a moving arm also reports its progress, and a library may print a warning in any thread.
Python's `sys.stderr` would block them while the far end does not read.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import io
import os
import queue
import select
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any, TextIO

from drivers.texts import hide, hide_all, printable

#: Texts that wait for a far end that does not read; further ones are dropped.
LIMIT = 10_000
#: How often a far end that is not written to is checked [s].
LOOK = 0.2
#: At the end of the program, a far end that has taken nothing for this time [s] gets no more.
PATIENCE = 2.0
_PIECE = 1024  # bytes of a write: a slow line shows that it goes on
_GONE = (errno.EPIPE, errno.EIO, errno.EBADF, errno.ENXIO)


def without_secrets(text: str, longest: int, lines: bool = False) -> str:
    """A text of others to be shown: without passwords and control characters, cut to `longest` characters.

    Args:
        text: whatever a file, a controller or a library says.
        longest: characters that are kept.
        lines: whether it may have several lines.
    """
    return printable(hide_all(text), longest, lines=lines)


class PatientStream(io.TextIOBase):
    """Text to a file descriptor through a thread: no method but `drain` ever waits or fails.

    Where the far end is gone (a reader that ended, a terminal that was closed), `on_gone` is called once, in the
    thread, and what is written from then on goes nowhere. In a forked process text is written directly.

    Args:
        descriptor: open for writing; it is left open.
        encoding: of the far end; characters that it lacks are escaped.
    """

    encoding = "utf-8"
    errors = "backslashreplace"

    def __init__(self, descriptor: int, encoding: str = "utf-8"):
        self.on_gone: Callable[[], None] | None = None
        self.encoding = encoding
        self._descriptor = descriptor
        self._queue: queue.SimpleQueue[Any] = queue.SimpleQueue()  # may be used where a signal or the collector strikes
        self._written = 0
        self._gone = False
        self._given_up = -1  # bytes that were through when the far end was given up
        self._process = os.getpid()
        self._starting = threading.Lock()
        self._thread: threading.Thread | None = None

    def fileno(self) -> int:
        """The descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Whether a terminal is there."""
        with contextlib.suppress(OSError):
            return os.isatty(self._descriptor)
        return False

    def writable(self) -> bool:
        """Yes."""
        return True

    def write(self, text: str) -> int:
        """Hand over a message."""
        if not isinstance(text, str):
            raise TypeError(f"a text is expected, not {type(text).__name__}")
        text = hide(text)
        if os.getpid() != self._process:
            self._put_out(text)
        elif not self._gone and self._queue.qsize() < LIMIT:
            self._queue.put(text)
            self.start()
        return len(text)

    def drain(self) -> bool:
        """Wait until all is written; False where the far end took nothing for `PATIENCE` seconds."""
        if self._thread is None or os.getpid() != self._process:
            return True
        through = threading.Event()
        self._queue.put(through)
        while not self._gone:
            before = self._written
            if through.wait(0.0 if self._given_up == before else PATIENCE):
                return not self._gone
            if self._written == before:
                self._given_up = before
                return False
        return False

    def start(self) -> None:
        """Begin to check whether the far end is still there, though nothing was written yet."""
        if self._thread is None and self._starting.acquire(blocking=False):
            try:
                thread = threading.Thread(target=self._work, name="messages", daemon=True)
                thread.start()
                self._thread = thread
            except (RuntimeError, MemoryError):  # no thread is available; the next message tries again
                self._starting.release()

    # The methods below run in the thread.

    def _work(self) -> None:
        while not self._gone:
            with contextlib.suppress(Exception):  # any error: the next message may succeed
                try:
                    item = self._queue.get(timeout=LOOK)
                except queue.Empty:
                    self._look()
                else:
                    item.set() if isinstance(item, threading.Event) else self._put_out(item)

    def _put_out(self, text: str) -> None:
        """By the system's call: a thread that waits in Python's stream holds its lock, and the program cannot end."""
        unwritten = memoryview(text.encode(self.encoding, "backslashreplace"))
        while unwritten and not self._gone:
            try:
                done = os.write(self._descriptor, unwritten[:_PIECE])
            except BlockingIOError:  # somebody else has told the system not to wait
                select.select([], [self._descriptor], [], LOOK)
                continue
            except OSError as error:
                if error.errno in _GONE:
                    self._end()
                return  # as on a full disk: this text is lost, the next may not be
            unwritten = unwritten[done:]
            self._written += done

    def _look(self) -> None:
        """Check whether the far end is still there: nothing was written for a while."""
        poll = select.poll()
        poll.register(self._descriptor, 0)
        if any(event & (select.POLLERR | select.POLLHUP | select.POLLNVAL) for _, event in poll.poll(0)):
            self._end()

    def _end(self) -> None:
        self._gone = True
        if self.on_gone is not None:
            self.on_gone()


_made: weakref.WeakKeyDictionary[TextIO, PatientStream] = weakref.WeakKeyDictionary()


def patient(stream: TextIO | None) -> Any:
    """A non-blocking stream in front of this one; a stream in memory is returned unchanged."""
    if stream is None:
        return io.StringIO()
    if isinstance(stream, PatientStream):
        return stream
    try:
        descriptor = stream.fileno()
    except (OSError, ValueError, AttributeError):
        return stream
    if stream not in _made:
        _made[stream] = PatientStream(descriptor, stream.encoding or "utf-8")
        atexit.register(_made[stream].drain)
    return _made[stream]


@contextlib.contextmanager
def patient_messages(on_gone: Callable[[], None]) -> Iterator[None]:
    """Make `sys.stderr` non-blocking for all writers: messages, warnings of libraries, their logging.
    At its end the texts that still wait are written, as far as somebody reads them."""
    before = sys.stderr
    with open(os.devnull, "w", encoding="utf-8") as nowhere:
        stream = sys.stderr = patient(before) if before is not None else nowhere  # print(file=None) is standard output
        if isinstance(stream, PatientStream):
            stream.on_gone = on_gone
            stream.start()
        try:
            yield
        finally:
            with contextlib.suppress(BaseException):  # a signal: what there was to say was said, or cannot be
                if isinstance(stream, PatientStream):
                    stream.drain()
            sys.stderr = before


def flush_results(text: str = "") -> None:
    """Hand over a text and what was printed on standard output before now, and not as the program ends.

    A reader that is gone wanted no more. Raises `OSError` for everything else.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())  # or Python would try again as it ends
        if error.errno not in _GONE:
            raise OSError(error.errno, error.strerror, "standard output") from None


def open_standard_descriptors() -> None:
    """Open those of 0 to 2 that the caller has closed: the next file or socket would get them, and messages into it."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdin, sys.stdout = sys.stdin or os.fdopen(0), sys.stdout or os.fdopen(1, "w")  # None where it was closed
