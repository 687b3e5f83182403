"""Every signal that would end a program is raised instead, so that the way out leads through a stop."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from agent.core import Ended, signals_raised, stop_to_come, undisturbed
from tests.conftest import end_with_tests

#: Left to the system: what cannot be caught, what ends no program, and faults of the program itself.
LEFT = {
    *(signal.SIGKILL, signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU),
    *(signal.SIGCONT, signal.SIGCHLD, signal.SIGURG, signal.SIGWINCH),
    *(signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL),
}
#: Python itself ignores these: they come as an error of the call that they are about.
IGNORED = {signal.SIGPIPE, signal.SIGXFSZ}
ENDING = sorted(signal.valid_signals() - LEFT - IGNORED)


@pytest.mark.parametrize("number", ENDING)
def test_terminating_signals_raise_exceptions(number: int):
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with signals_raised(), pytest.raises((Ended, KeyboardInterrupt)) as end:
            os.kill(os.getpid(), number)
    finally:
        signal.signal(number, before)
    code = 130 if isinstance(end.value, KeyboardInterrupt) else end.value.exit_code
    assert code == 128 + number
    assert number == signal.SIGINT or str(end.value), "it is said what ended the program"


def _niceness() -> set[int]:
    found = set()
    for thread in os.listdir("/proc/self/task"):
        with contextlib.suppress(OSError):  # it has ended
            found.add(os.getpriority(os.PRIO_PROCESS, int(thread)))
    return found


def _session_niceness() -> int | None:
    """None where this system does not share its processors out by session."""
    with contextlib.suppress(OSError, IndexError):
        return int(Path("/proc/self/autogroup").read_text().split()[-1])
    return None


def test_watching_an_arm_raises_the_process_priority():
    if not _may_be_first():
        pytest.skip("this user may not raise a priority")
    (before,), over, session = _niceness(), threading.Event(), _session_niceness()
    threading.Thread(target=over.wait).start()
    try:
        with stop_to_come():
            assert _niceness() == {before - 10}
            assert _session_niceness() == (None if session is None else min(session, -10))
        assert _niceness() == {before}
        assert _session_niceness() == session
    finally:
        over.set()


def _may_be_first() -> bool:
    child = os.fork()
    if child == 0:
        with contextlib.suppress(OSError):
            os.nice(-1)
            os._exit(0)
        os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize("number", [signal.SIGUSR1, signal.SIGHUP])
def test_ignored_signals_stay_ignored(number: int):
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with signals_raised():
            os.kill(os.getpid(), number)
    finally:
        signal.signal(number, before)


def test_keeps_the_callers_signal_handler():
    """Of a program that uses the agent as a library."""
    came = []
    before = signal.signal(signal.SIGUSR2, lambda number, _: came.append(number))
    try:
        with signals_raised():
            os.kill(os.getpid(), signal.SIGUSR2)
        os.kill(os.getpid(), signal.SIGUSR2)
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert came == [signal.SIGUSR2] * 2


@pytest.mark.parametrize("number", [signal.SIGTSTP, signal.SIGTTIN])
def test_suspend_signals_are_ignored_in_motion(number: int):
    with stop_to_come():
        assert signal.getsignal(number) is signal.SIG_IGN
    assert signal.getsignal(number) is not signal.SIG_IGN


def test_a_cpu_time_limit_does_not_cut_a_stop_short():
    """It comes once a second, until the limit that kills."""
    with signals_raised():
        with stop_to_come():
            with pytest.raises(Ended):
                os.kill(os.getpid(), signal.SIGXCPU)
            with undisturbed():
                os.kill(os.getpid(), signal.SIGXCPU)
        os.kill(os.getpid(), signal.SIGXCPU)  # while the log is closed


@pytest.mark.parametrize(
    ("fault", "number"), [("os.abort()", signal.SIGABRT), ("import ctypes; ctypes.string_at(0)", signal.SIGSEGV)]
)
def test_a_crash_signal_is_not_caught(fault: str, number: int):
    """With the core file that its user has asked for, instead of a second life after memory was damaged."""
    text = f"import os\nfrom agent.core import signals_raised\nwith signals_raised():\n    {fault}"
    end = subprocess.run(
        [sys.executable, "-c", text], env={**os.environ, "PYTHONPATH": os.getcwd()}, preexec_fn=end_with_tests
    )
    assert end.returncode == -number


def test_a_reserved_descriptor_lets_files_open_after_motion():
    before, taken = resource.getrlimit(resource.RLIMIT_NOFILE), []
    try:
        with stop_to_come():
            most = max(int(name) for name in os.listdir("/proc/self/fd")) + 1
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, before[1]))
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.open(os.devnull, os.O_RDONLY))
        taken.append(os.open(os.devnull, os.O_RDONLY))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
        for descriptor in taken:
            os.close(descriptor)
