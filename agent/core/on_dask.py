"""Tasks on Dask: processes of this machine, or the workers of a scheduler that somebody else runs.

Dask resubmits what a dead worker was doing, spills and limits memory. What it leaves to its clients is done here: a
window of tasks instead of all of them at once, so that memory does not grow with their number; a new connection, and
what was in flight again, where the scheduler was restarted; and a task that seems to kill workers is tried once more
with nobody beside it before it is given up, because Dask blames every task that was on a worker when it died.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from typing import Any

from agent.core.errors import AgentError, InputError
from agent.core.packages import needed
from agent.core.parallel import Answer, Task, TaskDone, available_cores

#: So long a scheduler may be gone before the run gives up [s]; what is done stays done.
PATIENCE = 300.0
#: So long one attempt to connect may take [s].
_CONNECT = 10.0
#: How often a quiet scheduler is looked at [s].
_LOOK = 2.0
#: Tasks in flight for each thread of the workers: one at work and one that waits beside it.
_AHEAD = 2
#: Run by every local worker as it starts: Ctrl-C reaches all processes of a terminal at once, and ours ends the others.
_WITHOUT_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
#: Protocols of Dask that let nobody in without a certificate.
_ENCRYPTED = ("tls://", "wss://")
#: How often Dask tries a task again whose worker died.
_TRIES = 2


class DaskEngine:
    """Processes of this machine, one a core, or the workers of a Dask scheduler.

    A context. Leaving it ends the processes it started; a scheduler of others is left as it is.

    Args:
        scheduler: address, `tcp://host:8786`; without one, processes of this machine are started.
        workers: how many of those; one a core if None.
        memory: of each of those, as in `2GiB`; their share of the machine's if None.
        say: called with what a person should know.
        warn: called where others can run code: a scheduler without TLS does what anybody who reaches it asks for.

    Raises:
        InputError: on entering it: Dask is not installed, or nobody answers at the address.
    """

    def __init__(
        self,
        scheduler: str | None = None,
        workers: int | None = None,
        memory: str | None = None,
        say: Callable[[str], None] = lambda text: None,
        warn: Callable[[str], None] = lambda text: None,
    ):
        self._scheduler = scheduler
        self._workers = workers or available_cores()
        self._memory = memory
        self._say = say
        self._warn = warn
        self._cluster: Any = None
        self._client: Any = None
        self._width = (-float("inf"), 1)

    def __enter__(self) -> DaskEngine:
        self._dask = needed("distributed", "work on many cores")
        # what Dask raises where a connection, or what depended on it, is gone
        self._lost = (CancelledError, self._dask.client.FuturesCancelledError)
        self._killed = self._dask.KilledWorker
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # it tells of every worker that dies; we do, once
        if self._scheduler is None:
            self._start_local()
        else:
            if not self._scheduler.startswith(_ENCRYPTED):
                self._warn(
                    f"{self._scheduler}: this link is neither encrypted nor authenticated. Whoever reaches the "
                    "scheduler can run code as the users of its workers; use a scheduler at tls://"
                )
            self._say(f"{self._scheduler}: connecting to the scheduler")
            try:
                # a client of an address that is none would keep a thread, and the process would not end
                self._dask.comm.get_address_host_port(self._scheduler)
                self._client = self._connect(3 * _CONNECT)  # it may be starting
            except (OSError, ValueError) as error:
                raise InputError(f"{self._scheduler}: no Dask scheduler answers there: {error or 'no time'}") from None
        return self

    def __exit__(self, *_: object) -> None:
        for one in (self._client, self._cluster):
            if one is not None:
                with contextlib.suppress(Exception):  # whatever is left of it
                    one.close()

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in the order in which they come.

        Raises:
            AgentError: the scheduler is gone and does not come back.
        """
        unconfirmed: list[tuple[int, Task]] = []
        yield from self._map(function, iter(enumerate(tasks)), unconfirmed, None)
        for number, task in unconfirmed:
            again: list[tuple[int, Task]] = []
            yield from self._map(function, iter([(number, task)]), again, 1)
            if again:
                limit = f" (limit: {self._memory or 'its share of the memory'})" if self._scheduler is None else ""
                yield TaskDone(
                    number, None, f"every worker that tried it was killed; memory is the likely reason{limit}"
                )

    def _map(
        self,
        function: Callable[[Task], Answer],
        tasks: Iterator[tuple[int, Task]],
        unconfirmed: list[tuple[int, Task]],
        width: int | None,
    ) -> Iterator[TaskDone[Answer]]:
        back: deque[tuple[int, Task]] = deque()  # to be sent again
        flying: dict[Any, tuple[int, Task]] = {}
        while True:
            try:
                while len(flying) < (width or self._threads() * _AHEAD):
                    one = back.popleft() if back else next(tasks, None)
                    if one is None:
                        break
                    flying[self._client.submit(function, one[1], pure=False)] = one
                if not flying:
                    return
                arrived = self._arrived(list(flying))
            except (OSError, *self._lost):
                back.extend(flying.values())
                flying.clear()
                self._reconnect()
                continue
            for future in arrived:
                one = flying.pop(future)
                if future.status == "error":
                    error = future.exception()
                    if not isinstance(error, self._killed):
                        raise error
                    unconfirmed.append(one)
                    continue
                try:
                    answer = future.result()
                except (OSError, *self._lost):  # it was lost with its scheduler, or on its way here
                    back.append(one)
                    continue
                yield TaskDone(one[0], answer)

    def _arrived(self, futures: list[Any]) -> list[Any]:
        """Those that are no longer pending, as soon as there is one; none where the connection has to be looked at.

        Raises:
            OSError: the scheduler is gone.
        """
        try:
            with self._client.as_current():
                self._dask.wait(futures, timeout=_LOOK, return_when="FIRST_COMPLETED")
        except TimeoutError:
            if self._client.status != "running":
                raise OSError("the scheduler does not answer") from None
            self._width = (-float("inf"), 1)  # workers may have come
        return [future for future in futures if future.status != "pending"]

    def _threads(self) -> int:
        """Of all workers there are now; asked for every few seconds."""
        asked, width = self._width
        if time.monotonic() - asked > _LOOK:
            width = max(1, sum(self._client.nthreads().values()))
            self._width = (time.monotonic(), width)
        return width

    def _reconnect(self) -> None:
        """
        Raises:
            AgentError: nobody answers for `PATIENCE`.
        """
        self._width = (-float("inf"), 1)
        with contextlib.suppress(Exception):
            self._client.close(timeout=1)
        if self._cluster is not None:  # its scheduler lives in this process
            raise AgentError("the local Dask cluster has ended; the same command goes on with what is not done")
        self._say(f"{self._scheduler}: the scheduler is gone; waiting for it")
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until:
            try:
                self._client = self._connect()
            except OSError:
                time.sleep(0.5)
                continue
            self._say(f"{self._scheduler}: the scheduler is back")
            return
        raise AgentError(
            f"{self._scheduler}: the scheduler did not come back within {PATIENCE:g} s. What is done is kept: the same "
            "command goes on"
        )

    def _connect(self, timeout: float = _CONNECT) -> Any:
        return self._dask.Client(self._scheduler, timeout=timeout, set_as_default=False)

    def _start_local(self) -> None:
        import dask

        needed("cryptography", "work on many cores")
        settings = {
            "distributed.scheduler.allowed-failures": _TRIES,
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.comm.timeouts.connect": "30s",
            "distributed.admin.log-format": "%(message)s",
            # looks at itself less often: 5 % of a core otherwise, beside one worker
            "distributed.worker.profile.enabled": False,
            "distributed.admin.system-monitor.interval": "5s",
            "distributed.admin.tick.interval": "1s",
            "distributed.admin.tick.limit": "60s",
        }
        dask.config.set(settings)
        try:
            self._cluster = self._dask.LocalCluster(
                n_workers=self._workers,
                threads_per_worker=1,
                processes=True,
                memory_limit="auto" if self._memory is None else self._memory,
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
        count = f"{self._workers} local worker{'' if self._workers == 1 else 's'}"
        self._say(f"{count}; dashboard {self._cluster.dashboard_link}")
