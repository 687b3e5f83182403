"""Every way to end ends in a stop: signals, terminals frozen or closed, a reader that goes, a thread that fails."""

import contextlib
import os
import pty
import resource
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from agent.recording import read_log
from fake_controller.controller import Controller
from fake_controller.faults import Fault
from tests.conftest import DRAW, end_with_tests, environment
from tests.faults.conftest import LONG, MOMENT
from tests.warm import WarmProcess


@dataclass
class Terminal:
    """A pseudo-terminal with an agent in its foreground; `master` is the far end."""

    process: subprocess.Popen | WarmProcess
    master: int
    slave: int

    def read_until(self, text: str) -> str:
        said = ""
        while text not in said:
            said += os.read(self.master, 4096).decode()
        return said

    def read_to_the_end(self) -> str:
        said = b""
        with contextlib.suppress(OSError):  # EIO: nobody has it open any more
            while data := os.read(self.master, 4096):
                said += data
        return said.decode()

    def hang_up(self) -> None:
        os.close(self.master)
        self.master = -1


def _lead(slave: int) -> Callable[[], None]:
    def lead() -> None:
        end_with_tests()
        os.setsid()
        import fcntl

        fcntl.ioctl(slave, termios.TIOCSCTTY, 0)

    return lead


@pytest.fixture
def on_terminal(tmp_path: Path) -> Iterator[Callable[..., Terminal]]:
    """Starts `agent …` on a pseudo-terminal, as its session leader; `afresh` where imports or Python's end matter."""
    made: list[Terminal] = []

    def start(*arguments: object, afresh: bool = False) -> Terminal:
        master, slave = pty.openpty()
        if afresh:
            command, files = [sys.executable, "-m", "agent", *map(str, arguments)], {"stdin": slave}
            files |= {"stdout": slave, "stderr": slave, "preexec_fn": _lead(slave)}
            process = subprocess.Popen(command, cwd=tmp_path, env=environment(), **files)
        else:
            process = WarmProcess("agent", *arguments, cwd=tmp_path, stdout=slave, stderr=slave, terminal=slave)
        made.append(Terminal(process, master, slave))
        return made[-1]

    yield start
    for one in made:
        one.process.kill()
        one.process.wait()
        for descriptor in (one.master, one.slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)


@pytest.fixture
def on_pipes(bench, tmp_path: Path) -> Iterator[Callable[..., WarmProcess]]:
    """Starts `agent record …` off a terminal."""
    made: list[WarmProcess] = []

    def start(*options: str, output: int) -> WarmProcess:
        words = ("record", bench.recipe, "--program", bench.program, "-o", bench.log, *options)
        made.append(WarmProcess("agent", *words, cwd=tmp_path, stdout=output, stderr=output))
        return made[-1]

    yield start
    for process in made:
        process.kill()
        process.wait()


@pytest.fixture
def controller(bench) -> Controller:
    """A real-time controller, and a program of minutes for it."""
    controller = bench.serve(clock="real")
    bench.program.write_text(LONG, encoding="utf-8")
    return controller


@pytest.fixture
def moving(request, bench, controller, on_terminal):
    """A real-time controller and an agent on a terminal that moves it."""
    words = ("record", bench.recipe, "--program", bench.program, "-o", bench.log, "--yes")
    terminal = on_terminal(*words, afresh=getattr(request, "param", False))
    terminal.read_until("of motion")
    _wait_for(controller, controller.recorded + MOMENT)
    return controller, terminal


def _wait_for(controller: Controller, recorded: int, process: subprocess.Popen | WarmProcess | None = None) -> None:
    while controller.recorded < recorded:
        assert process is None or process.poll() is None
        time.sleep(0.001)


def _assert_nothing_lost(bench, controller) -> None:
    """The samples of the stop are in the log, to the last."""
    log = read_log(bench.log)
    assert len(log.t) == controller.recorded
    assert log.metadata["lost_samples"] == "0"


@pytest.mark.parametrize("moving", [True], ids=["afresh"], indirect=True)
def test_a_frozen_terminal_delays_no_stop_and_loses_nothing(bench, moving, assert_at_rest):
    controller, terminal = moving
    termios.tcflow(terminal.slave, termios.TCOOFF)
    frozen = controller.recorded
    _wait_for(controller, frozen + 1500)  # by now a line of progress waits for the terminal
    controller.state.override = 0.5
    assert controller.wait(30.0), "nobody watched"
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert terminal.process.wait(60) == 5
    assert_at_rest(controller, 1)
    _assert_nothing_lost(bench, controller)


@pytest.mark.verify
def test_a_pipe_that_nobody_reads_delays_no_stop(bench, controller, on_pipes, assert_at_rest):
    read, write = os.pipe()
    os.set_blocking(write, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(write, b"x" * 1024)
    os.set_blocking(write, True)
    process = on_pipes("-v", output=write)
    _wait_for(controller, 500, process)
    controller.state.override = 0.5
    assert process.wait(60) == 5
    os.close(read)
    os.close(write)
    assert_at_rest(controller, 1)
    _assert_nothing_lost(bench, controller)


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGHUP, 129, "hung up"),
        pytest.param(signal.SIGINT, 130, "interrupted", marks=pytest.mark.verify),
        (signal.SIGQUIT, 131, "quit"),
        pytest.param(signal.SIGTERM, 143, "terminated", marks=pytest.mark.verify),
        (signal.SIGUSR1, 138, "ended by signal 10"),
        pytest.param(signal.SIGABRT, 134, "ended by signal 6", marks=pytest.mark.verify),
        pytest.param(signal.SIGALRM, 142, "ended by signal 14", marks=pytest.mark.verify),
        pytest.param(signal.SIGXCPU, 152, "ended by signal 24", marks=pytest.mark.verify),
    ],
)
def test_every_signal_ends_in_a_stop_and_says_so(bench, moving, assert_at_rest, number, code, said):
    controller, terminal = moving
    terminal.process.send_signal(number)
    os.close(terminal.slave)
    assert f"agent: {said}" in terminal.read_to_the_end()
    assert terminal.process.wait(30) == code
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)
    _assert_nothing_lost(bench, controller)


SIGNALS = {signal.SIGHUP: 129, signal.SIGINT: 130, signal.SIGQUIT: 131, signal.SIGTERM: 143}


@pytest.mark.verify
@pytest.mark.parametrize("phase", ["connect", "upload", "start"])
@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_a_wait_for_an_answer(bench, on_terminal, assert_at_rest, phase: str, number: int):
    """One that never comes: of the connection, to the program, to the start, which is carried out."""
    controller = bench.serve([Fault("silent", phase)], clock="real")
    bench.program.write_text(LONG, encoding="utf-8")
    terminal = on_terminal("record", bench.recipe, "--program", bench.program, "-o", bench.log, "--yes")
    while controller.faults.waiting:
        time.sleep(0.001)
    terminal.process.send_signal(number)
    os.close(terminal.slave)
    said = terminal.read_to_the_end()
    assert terminal.process.wait(30) == SIGNALS[number], said
    assert "Traceback" not in said
    assert_at_rest(controller, int(phase == "start"))


def test_a_terminal_that_is_closed_ends_in_a_stop(bench, moving, assert_at_rest):
    controller, terminal = moving
    os.close(terminal.slave)
    terminal.hang_up()
    assert terminal.process.wait(30) == 129
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)
    _assert_nothing_lost(bench, controller)


def test_a_session_without_a_terminal_that_drops_ends_in_a_stop(controller, on_pipes, assert_at_rest):
    """`ssh host agent record …` has pipes; nothing but their far end tells that it is gone, and `-q` writes nothing."""
    read, write = os.pipe()
    process = on_pipes("-q", output=write)
    os.close(write)
    _wait_for(controller, 500 + MOMENT, process)
    os.close(read)
    assert process.wait(30) == 129
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)


def test_a_second_signal_does_not_cut_the_stop_short(bench, moving, assert_at_rest):
    controller, terminal = moving
    numbers = [signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGINT]
    for number in numbers[DRAW % 4 :] + numbers[: DRAW % 4]:
        terminal.process.send_signal(number)
    assert terminal.process.wait(30) in (129, 130, 143)
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)


def test_nohup_survives_a_hang_up(bench, controller, tmp_path: Path):
    """`nohup agent …`"""
    bench.program.write_text(LONG.replace("200", "1"), encoding="utf-8")

    def deaf() -> None:
        end_with_tests()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)

    command = [sys.executable, "-m", "agent", "record", bench.recipe, "--program", bench.program, "-o", bench.log]
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    with subprocess.Popen(command, cwd=tmp_path, env=environment(), preexec_fn=deaf, **quiet) as process:
        _wait_for(controller, 100, process)
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == 0
    assert [end.name for end in controller.ends] == ["DONE"]


@pytest.mark.parametrize("error", [MemoryError, RuntimeError])
def test_an_error_in_any_thread_ends_in_a_stop(bench, controller, assert_at_rest, monkeypatch, error):
    strike = controller.faults.strike

    def fail() -> None:
        raise error("no room")

    def once(phase: str, motion_time: float = 0.0):
        if phase == "streaming" and motion_time > 0.3 + MOMENT / 1000 and not failing.ident:
            failing.start()
        return strike(phase, motion_time)

    failing = threading.Thread(target=fail, name="failing")
    monkeypatch.setattr(threading, "excepthook", lambda _: None)
    monkeypatch.setattr(controller.faults, "strike", once)
    ended = bench.record()
    assert ended.code == 1
    assert "no room" in ended.errors
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)


def test_running_out_of_memory_ends_in_a_stop(bench, controller, assert_at_rest, monkeypatch):
    from agent.recording import LogWriter

    def write(self, block):
        raise MemoryError

    monkeypatch.setattr(LogWriter, "write", write)
    ended = bench.record()
    assert ended.code == 1
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)


def test_a_stuck_disk_ends_in_a_stop(bench, controller, assert_at_rest, monkeypatch):
    from agent.recording.mcap import writer as module

    awake = threading.Event()

    class Stuck(module.LogFile):
        def write(self, samples):
            awake.wait(60.0)
            super().write(samples)

    monkeypatch.setattr(module, "LogFile", Stuck)
    quick = {**module.LogWriter.__init__.__kwdefaults__, "stall_limit": 0.3}
    monkeypatch.setattr(module.LogWriter.__init__, "__kwdefaults__", quick)
    end = controller.stop

    def stop(*arguments):
        end(*arguments)
        awake.set()

    monkeypatch.setattr(controller, "stop", stop)
    ended = bench.record()
    assert ended.code == 1
    assert "the disk is too slow" in ended.errors
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)
    _assert_nothing_lost(bench, controller)


def _replace(log: Path) -> None:
    log.with_name("other").write_bytes(log.read_bytes())
    log.with_name("other").rename(log)


HARMS = {
    "delete": Path.unlink,
    "truncate": lambda log: os.truncate(log, 0),
    "replace": _replace,
    "take the folder": lambda log: log.parent.rename(log.parent.with_name("elsewhere")),
}


@pytest.mark.parametrize(
    "harm", [pytest.param(name, marks=() if name == "delete" else pytest.mark.verify) for name in HARMS]
)
def test_a_log_that_is_taken_away_in_motion_ends_in_a_stop(bench, controller, assert_at_rest, monkeypatch, harm):
    bench.log = bench.folder / "taken" / "swing.mcap"
    bench.log.parent.mkdir()
    strike, harmed = controller.faults.strike, []

    def once(phase: str, motion_time: float = 0.0):
        if phase == "streaming" and motion_time > 1.0 + MOMENT / 1000 and not harmed:
            harmed.append(controller.recorded)
            HARMS[harm](bench.log)
        return strike(phase, motion_time)

    monkeypatch.setattr(controller.faults, "strike", once)
    ended = bench.record()
    assert ended.code == 1, ended.errors
    assert "deleted, replaced or changed while it was recorded" in ended.errors
    assert [end.name for end in controller.ends] == ["STOPPED"]
    assert_at_rest(controller, 1)
    assert controller.recorded - harmed[0] < 2 * 500, "noticed within a second, and then the arm brakes"


def _leave_no_descriptors(process: int) -> None:
    """From now on the process can open nothing more."""
    used = {int(name) for name in os.listdir(f"/proc/{process}/fd")}
    _, most = resource.prlimit(process, resource.RLIMIT_NOFILE)
    resource.prlimit(process, resource.RLIMIT_NOFILE, (min(set(range(len(used) + 1)) - used), most))


@pytest.mark.parametrize(("number", "code"), [pytest.param(None, 0, marks=pytest.mark.verify), (signal.SIGTERM, 143)])
def test_a_motion_ends_normally_without_free_file_descriptors(bench, on_terminal, assert_at_rest, number, code: int):
    controller = bench.serve(clock="real")
    if number is not None:
        bench.program.write_text(LONG, encoding="utf-8")
    words = ("record", bench.recipe, "--program", bench.program, "-o", bench.log, "--yes")
    terminal = on_terminal(*words, afresh=True)
    terminal.read_until("of motion")
    _leave_no_descriptors(terminal.process.pid)
    _wait_for(controller, 500)
    if number is not None:
        terminal.process.send_signal(number)
    os.close(terminal.slave)
    said = terminal.read_to_the_end()
    assert terminal.process.wait(30) == code, said
    assert "Traceback" not in said
    assert [end.name for end in controller.ends] == ["DONE" if number is None else "STOPPED"]
    assert_at_rest(controller, 1)
    assert read_log(bench.log).metadata["lost_samples"] == "0"
