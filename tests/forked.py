"""`pytest --forks 4`: tests in four processes that are forked once everything is imported and collected.

A process of its own that imports and collects everything takes six seconds of a processor for that. Each process takes
one file of tests after the other, from one folder if it can, so that what they prepare for their tests is prepared
once. Tests marked `alone` run when all others have ended.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import pytest

#: Tests of one file, by their indices among all.
_File = list[int]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--forks", type=int, default=0, help="run tests in this number of processes; 0: in this one")


def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """None where another plugin runs the tests, in this process."""
    count = session.config.getoption("forks")
    if not count or session.config.option.collectonly or session.testsfailed:
        return None
    others, alone = list[_File](), list[_File]()
    for (_, marked), items in itertools.groupby(enumerate(session.items), lambda each: _place(each[1])):
        (alone if marked else others).append([number for number, _ in items])
    _Forks(session, others).run(count)
    _Forks(session, alone).run(1)
    return True


def _place(item: pytest.Item) -> tuple[Path, bool]:
    return item.path, item.get_closest_marker("alone") is not None


class _Forks:
    """Processes that run files of tests, and tell this one what it would have heard from its own plugins."""

    def __init__(self, session: pytest.Session, files: list[_File]) -> None:
        self._session, self._hook, self._waiting = session, session.config.hook, files
        self._running: dict[Connection, _Fork] = {}

    def run(self, count: int) -> None:
        """
        Raises:
            Failed: as many tests failed as the options allow.
        """
        try:
            while self._waiting or self._running:
                while self._waiting and len(self._running) < count:
                    fork = _Fork(self._session, [each.link for each in self._running.values()])
                    self._running[fork.link] = fork
                for link in wait(self._running):
                    self._hear(self._running[link])
                if self._session.shouldfail:
                    raise self._session.Failed(self._session.shouldfail)
        finally:
            for fork in self._running.values():
                fork.end(signal.SIGKILL)

    def _hear(self, fork: _Fork) -> None:
        try:
            self._handle(fork, *fork.link.recv())
        except (EOFError, OSError):
            self._ended(fork)

    def _handle(self, fork: _Fork, name: str, arguments: Any) -> None:
        if name == "next":
            fork.file = self._next_file(fork) if self._waiting else []
            fork.link.send(fork.file)
        elif name == "ended":
            fork.file = fork.file[1:]
        elif name == "warning":
            self._session.config.pluginmanager.getplugin("terminalreporter").pytest_warning_recorded(*arguments)
        else:
            report = self._hook.pytest_report_from_serializable(config=self._session.config, data=arguments)
            self._hook.pytest_runtest_logreport(report=report)

    def _next_file(self, fork: _Fork) -> _File:
        """A file of the folder where a process is, else of one where none is, else any."""
        busy = {other.folder for other in self._running.values()}

        def folder(file: _File) -> Path:
            return self._session.items[file[0]].path.parent

        file = min(self._waiting, key=lambda file: (folder(file) != fork.folder, folder(file) in busy))
        self._waiting.remove(file)
        fork.folder = folder(file)
        return file

    def _ended(self, fork: _Fork) -> None:
        """What a process that crashed has not begun is for another one."""
        del self._running[fork.link]
        code = fork.end()
        if fork.file:
            item, rest = self._session.items[fork.file[0]], fork.file[1:]
            told = f"the process that ran this test ended with exit code {code}"
            report = pytest.TestReport(item.nodeid, item.location, {}, "failed", told, "call")
            self._hook.pytest_runtest_logreport(report=report)
            self._waiting.extend([rest] if rest else [])
        elif code:
            raise self._session.Failed(f"a process ended with exit code {code} after its tests")


class _Fork:
    """One process; `link` is the way to it, `file` what it has not ended yet, `folder` where that is."""

    _number = itertools.count()

    def __init__(self, session: pytest.Session, others: list[Connection]) -> None:
        self.file: _File = []
        self.folder: Path | None = None
        self.link, theirs = Pipe()
        number = next(self._number)
        sys.stdout.flush()
        self._pid = os.fork()
        if self._pid == 0:
            code = 1
            try:
                for link in (self.link, *others):
                    link.close()
                _prepare(session.config, number, theirs)
                _work(session, theirs)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        theirs.close()

    def end(self, number: int | None = None) -> int:
        """Its exit code once it has ended, by a signal if there is one."""
        if number is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, number)
        self.link.close()
        return os.waitstatus_to_exitcode(os.waitpid(self._pid, 0)[1])


def _prepare(config: pytest.Config, number: int, link: Connection) -> None:
    """A fork captures output, makes folders and reports for itself."""
    capture = config.pluginmanager.getplugin("capturemanager")
    capture.stop_global_capturing()
    capture.start_global_capturing()
    capture.suspend_global_capture()
    folders = config._tmp_path_factory
    folders._basetemp = folders.getbasetemp() / f"process{number}"
    folders._basetemp.mkdir(mode=0o700)
    config.pluginmanager.unregister(name="terminalreporter")
    config.pluginmanager.register(_Reporter(config, link))


class _Reporter:
    """Sends what plugins are told in a fork."""

    def __init__(self, config: pytest.Config, link: Connection) -> None:
        self._config, self._link = config, link

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._link.send(("report", data))

    def pytest_warning_recorded(self, warning_message: warnings.WarningMessage, when: str, nodeid: str) -> None:
        if when == "collect":
            return  # before the fork
        try:
            pickle.dumps(warning_message)
        except Exception:
            warning_message.message, warning_message.source = str(warning_message.message), None
        self._link.send(("warning", (warning_message, nodeid)))


def _work(session: pytest.Session, link: Connection) -> None:
    for file in _files(link):
        items = [session.items[number] for number in file]
        for item, following in itertools.pairwise([*items, session]):  # what is for the whole session stays
            session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            link.send(("ended", {}))
    session._setupstate.teardown_exact(None)


def _files(link: Connection) -> Iterator[_File]:
    while True:
        link.send(("next", {}))
        if not (file := link.recv()):
            return
        yield file
