"""Many tasks at once: in this process, or on processes of this machine; `agent.core.on_dask` has a cluster's.

`TaskEngine.map` calls a function once for each task and returns the answers as they arrive, each with its task's
number: sorted, they are the same from any engine. Function and tasks are pickled; answers depend on the task alone.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from agent.core.errors import InputError

Task = TypeVar("Task")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class TaskDone(Generic[Answer]):
    """Result of task `number`: its `answer`, or why it has none (`lost`: it killed every worker that tried it)."""

    number: int
    answer: Answer | None
    lost: str = ""


class TaskEngine(Protocol):
    """Engine that runs tasks."""

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in the order in which they come; an error of `function` is raised here."""


class InProcess:
    """One task after the other, in this process."""

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *_: object) -> None: ...

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in order."""
        for number, task in enumerate(tasks):
            yield TaskDone(number, function(task))


class LocalProcesses:
    """A context: `map` hands tasks to `count` processes, which keep what they built between two calls.

    Leaving it, also by an exception or Ctrl-C, ends the processes; they end by themselves when this one is killed.
    """

    def __init__(self, count: int):
        # a forked copy would share this process's signals and threads
        self._pool = ProcessPoolExecutor(count, multiprocessing.get_context("spawn"), _end_with_parent)

    def __enter__(self) -> LocalProcesses:
        return self

    def __exit__(self, *_: object) -> None:
        working = list((self._pool._processes or {}).values())  # `terminate_workers` from Python 3.14 on
        while working := [process for process in working if process.is_alive()]:
            for process in working:
                process.terminate()
            for process in working:
                process.join(_PATIENCE)
        self._pool.shutdown(cancel_futures=True)

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in the order in which they come.

        Raises:
            InputError: that of the function, as one plain kind.
            RuntimeError: the function failed, or a process was killed.
        """
        try:
            numbers = {self._pool.submit(_answer, function, task): number for number, task in enumerate(tasks)}
            for future in as_completed(numbers):
                yield TaskDone(numbers[future], future.result())
        except BrokenProcessPool:
            raise RuntimeError("a process that worked for this one was killed; is memory short?") from None


#: Python acts on a signal once the main thread runs; one that comes just before it waits is repeated after this [s].
_PATIENCE = 5.0  # processes that a task started have as long to end
_working = threading.Event()


def _answer(function: Callable[[Task], Answer], task: Task) -> Answer:
    try:
        _working.set()
        try:
            return function(task)
        except InputError as error:  # as one plain kind: its subclasses need not survive the journey
            raise InputError(str(error)) from None
        except Exception:
            raise RuntimeError(f"a process that worked for this one failed:\n{traceback.format_exc()}") from None
        finally:
            _working.clear()
    except SystemExit:  # asked to end, and what the task started has ended; the pool would go on
        os._exit(1)


def _end(*_: object) -> None:
    if _working.is_set():
        sys.exit(1)  # so that what the task has started ends with it
    os._exit(1)  # between two tasks the pool would take an exception for a task's answer and go on


def _end_with_parent() -> None:
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # they reach every process of the terminal; ours ends us
    signal.signal(signal.SIGTERM, _end)
    threading.Thread(target=_end_after, args=(multiprocessing.parent_process(),), daemon=True).start()


def _end_after(parent: Any) -> None:
    parent.join()
    while True:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_PATIENCE)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
