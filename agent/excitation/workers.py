"""Candidates evaluated on all cores.

Each worker is a process that builds the robot once and answers one candidate at a time. What a candidate is worth
does not depend on who evaluates it, or when: results are the same for any number of workers.
"""

from __future__ import annotations

import multiprocessing
import signal
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any

import numpy as np

from agent.core import InputError
from agent.excitation.criterion import one_blas_thread
from agent.excitation.scoring import LoopScore

#: Builds the function that scores one genome (genes,). Both travel to the workers, so both must pickle.
Build = Callable[[Any], Callable[[np.ndarray], LoopScore]]


class Workers:
    """A context: `evaluate` scores genomes on `count` processes (in this one where count is 1).

    Leaving it, also by an exception or Ctrl-C, ends the processes; they end by themselves when this one is killed.
    """

    def __init__(self, build: Build, problem: Any, count: int):
        self._build = build
        self._problem = problem
        self._count = count
        self._processes: list[Any] = []
        self._connections: list[Connection] = []
        self._score: Callable[[np.ndarray], LoopScore] | None = None

    def __enter__(self) -> Workers:
        if self._count == 1:
            self._score = self._build(self._problem)
            return self
        context = multiprocessing.get_context("spawn")  # a forked copy would share this process's signals and threads
        try:
            for _ in range(self._count):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs, self._build, self._problem), daemon=True)
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

    def evaluate(self, genomes: np.ndarray) -> list[LoopScore]:
        """Scores of genomes (N, genes), in their order.

        Raises:
            InputError: a candidate cannot be scored for a reason the user can act on.
            RuntimeError: a worker failed or was killed.
        """
        if self._score is not None:
            with one_blas_thread():
                return [self._score(genome) for genome in genomes]
        scores: dict[int, LoopScore] = {}
        waiting = iter(range(len(genomes)))
        working: dict[Connection, int] = {}
        for connection in self._connections:
            _hand_out(connection, waiting, genomes, working)
        while working:
            for ready in wait(list(working)):
                assert isinstance(ready, Connection)
                scores[working.pop(ready)] = _answer(ready)
                _hand_out(ready, waiting, genomes, working)
        return [scores[k] for k in range(len(genomes))]


def _hand_out(connection: Connection, waiting: Any, genomes: np.ndarray, working: dict[Connection, int]) -> None:
    candidate = next(waiting, None)
    if candidate is not None:
        with suppress(ConnectionError):  # a worker that is gone has left word why, or its end of file
            connection.send(genomes[candidate])
        working[connection] = candidate


def _answer(connection: Connection) -> LoopScore:
    try:
        answer = connection.recv()
    except (EOFError, ConnectionError):
        raise RuntimeError("a worker of the search was killed; is memory short?") from None
    if isinstance(answer, LoopScore):
        return answer
    if isinstance(answer, InputError):
        raise answer
    raise RuntimeError(f"a worker of the search failed:\n{answer}")


def _work(connection: Connection, build: Build, problem: Any) -> None:
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # they reach every process of the terminal; ours ends us
    try:
        score = build(problem)
        with one_blas_thread():
            while True:
                connection.send(score(connection.recv()))
    except (EOFError, ConnectionError):
        return
    except InputError as error:  # as one plain kind: its subclasses need not survive the journey
        with suppress(ConnectionError):
            connection.send(InputError(str(error)))
    except Exception:
        with suppress(ConnectionError):
            connection.send(traceback.format_exc())
