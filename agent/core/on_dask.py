"""Tasks on Dask: processes of this machine, or the workers of a scheduler that somebody else runs.

Dask tries a task again whose worker died, and spills and limits memory. Tasks are submitted in a window, so that memory
does not grow with their number.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from typing import Any

from agent.core.errors import AgentError, InputError
from agent.core.formats import counted
from agent.core.packages import needed
from agent.core.parallel import Answer, Task, TaskDone, available_cores

#: Longest time for connecting to a scheduler, which may be starting [s].
_CONNECT = 30.0
#: Tasks in flight for each thread of the workers: one at work and one that waits.
_AHEAD = 2
#: Run by every local worker as it starts: Ctrl-C reaches all processes of a terminal at once, and ours ends the others.
_WITHOUT_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
#: Protocols of Dask that let nobody in without a certificate.
_ENCRYPTED = ("tls://", "wss://")
_SETTINGS = {
    "distributed.scheduler.allowed-failures": 2,
    "distributed.scheduler.worker-saturation": 1.0,
    "distributed.comm.timeouts.connect": "30s",
    "distributed.admin.log-format": "%(message)s",
    # looks at itself less often: otherwise 5 % of a core for one worker
    "distributed.worker.profile.enabled": False,
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.limit": "60s",
}


@dataclass(eq=False)
class DaskEngine:
    """Processes of this machine, one a core, or the workers of a Dask scheduler.

    A context. Leaving it ends the processes it started; a scheduler of others is left as it is.

    Args:
        scheduler: address, `tcp://host:8786`; without one, processes of this machine are started.
        workers: how many of those; one a core if None.
        memory: of each of those, as in `2GiB`; their share of the machine's if None.
        say: called with messages for a person.
        warn: called if others can run code: a scheduler without TLS does what anybody who reaches it asks for.

    Raises:
        InputError: on entering it: Dask is not installed, or nobody answers at the address.
    """

    scheduler: str | None = None
    workers: int | None = None
    memory: str | None = None
    say: Callable[[str], None] = lambda text: None
    warn: Callable[[str], None] = lambda text: None
    _cluster: Any = field(default=None, init=False)
    _client: Any = field(default=None, init=False)

    def __enter__(self) -> DaskEngine:
        self._dask = needed("distributed", "work on many cores")
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it tells of every worker that dies; we do, once
        if self.scheduler is None:
            self._start_local()
            return self
        if not self.scheduler.startswith(_ENCRYPTED):
            self.warn(
                f"{self.scheduler}: this link is neither encrypted nor authenticated. Anyone who reaches the "
                "scheduler can run code as the users of its workers; use a scheduler at tls://"
            )
        self.say(f"{self.scheduler}: connecting to the scheduler")
        try:
            # a client of a malformed address would keep a thread, and the process would not end
            self._dask.comm.get_address_host_port(self.scheduler)
            self._client = self._dask.Client(self.scheduler, timeout=_CONNECT, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"{self.scheduler}: no Dask scheduler answers there: {error or 'no time'}") from None
        return self

    def __exit__(self, *_: object) -> None:
        for side in (self._client, self._cluster):
            if side is not None:
                with contextlib.suppress(Exception):  # whatever is left of it
                    side.close()

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in the order in which they come.

        Raises:
            AgentError: the scheduler is gone.
        """
        waiting = enumerate(tasks)
        flying: dict[Any, int] = {}
        arrived = self._dask.as_completed(loop=self._client.loop)
        while True:
            with self._connected():
                free = _AHEAD * max(1, sum(self._client.nthreads().values())) - len(flying)
                for number, task in itertools.islice(waiting, max(0, free)):
                    future = self._client.submit(function, task, pure=False)
                    flying[future] = number
                    arrived.add(future)
                if not flying:
                    return
                future = next(arrived)
            number = flying.pop(future)
            if future.status == "error":
                yield self._lost(number, future.exception())
            else:
                with self._connected():
                    answer = future.result()
                yield TaskDone(number, answer)

    @contextlib.contextmanager
    def _connected(self) -> Iterator[None]:
        try:
            yield
        except (OSError, CancelledError):
            where = self.scheduler or "local Dask cluster"
            raise AgentError(f"{where}: the scheduler is gone; run the same command again to do the rest") from None

    def _lost(self, number: int, error: BaseException) -> TaskDone[Any]:
        if not isinstance(error, self._dask.KilledWorker):
            raise error
        limit = f" (limit: {self.memory or 'its share of the memory'})" if self.scheduler is None else ""
        return TaskDone(number, None, f"every worker that tried it was killed; memory is the likely reason{limit}")

    def _start_local(self) -> None:
        import dask

        needed("cryptography", "work on many cores")
        dask.config.set(_SETTINGS)
        count = self.workers or available_cores()
        try:
            self._cluster = self._dask.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                memory_limit="auto" if self.memory is None else self.memory,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
                preload=[_WITHOUT_CTRL_C],
                security=self._dask.Security.temporary(),  # else every user of this machine could run code as this one
            )
        except ValueError as error:
            raise InputError(f"local workers cannot be started: {error}") from None
        except (RuntimeError, OSError) as error:
            raise AgentError(f"local workers cannot be started: {error}; is there enough memory?") from None
        self._client = self._dask.Client(self._cluster, set_as_default=False)
        self.say(f"{counted(count, 'local worker')}; dashboard {self._cluster.dashboard_link}")
