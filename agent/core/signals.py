"""How a program ends that may have an arm in motion: every signal that ends it is raised in the main thread, so that
the way out leads through a controlled stop, and none cuts that stop short.

Python alone turns only SIGINT into an exception; every other signal, such as SIGHUP (a closed terminal, a dropped ssh
session) or SIGXCPU (a limit of the shell), would end the process on the spot. Left alone are the signals of a program
that is broken itself (SIGSEGV, SIGBUS, SIGFPE, SIGILL): Python cannot go on after them, and the core file shows why. An
`abort()` in compiled code ends the process in the same way, although SIGABRT from outside is raised.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

#: What people send to end a program, and its message.
_WORDS: dict[int, str] = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "terminated",
    signal.SIGHUP: "hung up: the terminal or the session is gone",
    signal.SIGQUIT: "quit",
}
#: What ends no program by itself, cannot be caught, or is a fault of the program.
_OTHERS = (
    *("SIGKILL", "SIGSTOP", "SIGTSTP", "SIGTTIN", "SIGTTOU", "SIGCONT", "SIGCHLD", "SIGURG", "SIGWINCH", "SIGINFO"),
    *("SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL", "SIGEMT"),
)
#: What ends a program that does nothing about it.
ENDING = signal.valid_signals() - {getattr(signal, name, None) for name in _OTHERS}
#: What suspends a program: nobody would watch the arm.
_SUSPENDING = (signal.SIGTSTP, signal.SIGTTIN)
#: After a signal was raised, no other is raised for this time [s], on the way to the stop.
_WAY_TO_STOP = 1.0
#: After a signal was raised, others are ignored for this time [s], except those sent by hand: a terminal that closes
#: sends several, a limit of processor time one a second, and the log must still be closed.
_ONE_END = 10.0
#: File descriptors for the time after a motion.
_KEPT_BACK = 16
#: Levels of priority (`nice`) by which a process that watches an arm is ahead of others.
_AHEAD = 10
#: Linux: the name and the priority of the session's group of processes, like `/autogroup-7 nice 0`.
_SESSION = Path("/proc/self/autogroup")
_BY_HAND = (signal.SIGINT, signal.SIGQUIT)


class Ended(BaseException):
    """A signal other than SIGINT, which is a `KeyboardInterrupt` as everywhere."""

    def __init__(self, number: int):
        super().__init__(_WORDS.get(number) or f"ended by signal {number} ({signal.strsignal(number)})")
        self.exit_code = 128 + number


def words_of(error: BaseException) -> str:
    """Describe a signal or error for people."""
    return _WORDS[signal.SIGINT] if isinstance(error, KeyboardInterrupt) else str(error) or type(error).__name__


class _State:
    """Signal state of this process; changed by the main thread only."""

    catching = False
    raised = -float("inf")  # when a signal was, the last time
    moving = False  # whatever is raised now leads to a stop
    shields = 0
    held: int | None = None  # the first signal that came under a shield
    failure: BaseException | None = None  # of another thread


_state = _State()


@contextlib.contextmanager
def signals_raised() -> Iterator[None]:
    """Within it, signals that end a program are raised in the main thread; what the caller of the program has told it
    to ignore (`nohup`, a job in the background) stays ignored, and a handler of the caller's own stays.

    In another thread than the main one, or within itself, it changes nothing.
    """
    if _state.catching or threading.current_thread() is not threading.main_thread():
        yield
        return
    # A job in the background that writes to its terminal would be suspended, where the terminal is set to that.
    before = {number: signal.getsignal(number) for number in (*ENDING, signal.SIGTTOU)}
    previous = {number: handler for number, handler in before.items() if handler is not None}
    _state.catching, _state.raised = True, -float("inf")
    try:
        for number in ENDING:
            ours = before[number] is signal.SIG_DFL or (number in _WORDS and before[number] is not signal.SIG_IGN)
            if ours or number == signal.SIGTERM:
                signal.signal(number, _raise)
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        _state.catching = False


@contextlib.contextmanager
def stop_to_come() -> Iterator[None]:
    """For the time in which an arm may move: the first signal is raised and those right after it are not, so that they
    cannot keep it from the stop; an exception that ends another thread is raised here too; Ctrl-Z does nothing, for
    nobody would watch. Where the system allows it, this process runs before the other work of the computer.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with signals_raised(), _descriptors_kept_back(), _scheduled_first():
        suspend, hook = {number: signal.signal(number, signal.SIG_IGN) for number in _SUSPENDING}, threading.excepthook
        threading.excepthook = _reporting(hook)
        _state.moving, _state.failure = True, None
        try:
            yield
        finally:
            _state.moving, _state.failure = False, None
            threading.excepthook = hook
            for number, handler in suspend.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def _descriptors_kept_back() -> Iterator[None]:
    """What comes after a motion needs files: modules that are loaded only then, the list of programs that have run.
    Where none are left to the process by then, these are."""
    descriptors: list[int] = []
    with contextlib.suppress(OSError):
        while len(descriptors) < _KEPT_BACK:
            descriptors.append(os.open(os.devnull, os.O_RDONLY))
    try:
        yield
    finally:
        for descriptor in descriptors:
            os.close(descriptor)


@contextlib.contextmanager
def _scheduled_first() -> Iterator[None]:
    """Raise the priority of every thread, and that of the session: where Linux shares the processors out by session
    (autogroup), a thread's priority counts for nothing outside its own. Most users may do neither."""
    usual, session = os.getpriority(os.PRIO_PROCESS, 0), _session_priority()
    _set_priority(usual - _AHEAD, min(session, -_AHEAD))  # a session that was left like this is not raised further
    try:
        yield
    finally:
        _set_priority(usual, session)


def _session_priority() -> int:
    with contextlib.suppress(OSError, ValueError, IndexError):
        return int(_SESSION.read_text(encoding="ascii").split()[-1])
    return 0


def _set_priority(niceness: int, session: int) -> None:
    with contextlib.suppress(OSError):
        _SESSION.write_text(str(session), encoding="ascii")
    with contextlib.suppress(OSError):
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError):  # not allowed, or the thread is gone
                os.setpriority(os.PRIO_PROCESS, int(thread), niceness)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Hold signals back during the stop itself, which ends the motion anyway."""
    main = threading.current_thread() is threading.main_thread()
    with signals_raised():
        _state.shields += main
        try:
            yield
        finally:
            _state.shields -= main


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Hold signals back while something is brought to its end that is over soon, then raise the first of them."""
    main = threading.current_thread() is threading.main_thread()
    with signals_raised():
        _state.shields += main
        if _state.shields == main:
            _state.held = None
        try:
            yield
        finally:
            _state.shields -= main
        number, _state.held = _state.held, None
        if main and number is not None and not _state.shields:
            raise _exception(number)


def interrupted() -> bool:
    """Whether a signal waits for the end of `deferred`."""
    return _state.held is not None


def hang_up() -> None:
    """Raise the hang-up of a terminal that was found closed; callable from any thread."""
    if _state.catching:
        _wake(signal.SIGHUP)


def _raise(number: int, _: FrameType | None) -> None:
    since = time.monotonic() - _state.raised
    if _state.shields and _state.held is None:
        _state.held = number
    if _state.shields or (_state.moving and since < _WAY_TO_STOP) or (number not in _BY_HAND and since < _ONE_END):
        return
    _state.raised = time.monotonic()
    if _state.failure is not None:
        failure, _state.failure = _state.failure, None
        raise failure
    raise _exception(number)


def _exception(number: int) -> BaseException:
    return KeyboardInterrupt() if number == signal.SIGINT else Ended(number)


def _reporting(hook: Callable[[threading.ExceptHookArgs], Any]) -> Callable[[threading.ExceptHookArgs], Any]:
    def report(arguments: threading.ExceptHookArgs) -> None:
        _state.failure = arguments.exc_value
        _wake(signal.SIGTERM)
        hook(arguments)

    return report


def _wake(number: int) -> None:
    """Send a signal to the main thread, even while it waits."""
    main = threading.main_thread().ident
    if main is not None:
        signal.pthread_kill(main, number)
