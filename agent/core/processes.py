"""Tasks on processes of this machine, without Dask: they start in half a second and hold what they built.

What a task is worth does not depend on who does it, or when: results are the same for any number of processes.
"""

from __future__ import annotations

import multiprocessing
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any

from agent.core.errors import InputError
from agent.core.parallel import Answer, Task, TaskDone


class LocalProcesses:
    """A context: `map` hands tasks to `count` processes, one at a time each.

    Leaving it, also by an exception or Ctrl-C, ends the processes; they end by themselves when this one is killed.
    """

    def __init__(self, count: int):
        self._count = count
        self._processes: list[Any] = []
        self._connections: list[Connection] = []

    def __enter__(self) -> LocalProcesses:
        context = multiprocessing.get_context("spawn")  # a forked copy would share this process's signals and threads
        try:
            for _ in range(self._count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs,), daemon=True)
                process.start()
                theirs.close()
                self._processes.append(process)
                self._connections.append(ours)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for connection in self._connections:
            connection.close()
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in the order in which they come.

        Raises:
            InputError: that of the function, as one plain kind.
            RuntimeError: the function failed, or a process was killed.
        """
        packed = bytes(ForkingPickler.dumps(function))
        waiting = enumerate(tasks)
        working: dict[Connection, int] = {}

        def hand_out(connection: Connection) -> None:
            number, task = next(waiting, (None, None))
            if number is not None:
                with suppress(ConnectionError):  # one that is gone has left word why, or its end of file
                    connection.send((packed, task))
                working[connection] = number

        for connection in self._connections:
            hand_out(connection)
        while working:
            for ready in wait(list(working)):
                assert isinstance(ready, Connection)
                yield TaskDone(working.pop(ready), _answer(ready))
                hand_out(ready)


def _answer(connection: Connection) -> Any:
    try:
        done, answer = connection.recv()
    except (EOFError, ConnectionError):
        raise RuntimeError("a process that worked for this one was killed; is memory short?") from None
    if done:
        return answer
    if isinstance(answer, InputError):
        raise answer
    raise RuntimeError(f"a process that worked for this one failed:\n{answer}")


def _work(connection: Connection) -> None:
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # they reach every process of the terminal; ours ends us
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that what a task has started ends with it
    packed, function = b"", None
    try:
        while True:
            now, task = connection.recv()
            if now != packed:
                packed, function = now, ForkingPickler.loads(now)
            assert function is not None
            connection.send((True, function(task)))
    except (EOFError, ConnectionError):
        return
    except InputError as error:  # as one plain kind: its subclasses need not survive the journey
        with suppress(ConnectionError):
            connection.send((False, InputError(str(error))))
    except Exception:
        with suppress(ConnectionError):
            connection.send((False, traceback.format_exc()))
