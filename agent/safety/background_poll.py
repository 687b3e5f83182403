"""Polls of the controller's state in a thread of its own, so that samples do not wait for them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

from agent.core import AgentError

#: The samples wait for an answer so long [s]; one that comes later counts when it comes.
PROMPT = 0.05


class BackgroundPoll:
    """Asks in a thread of its own, one question at a time.

    Args:
        ask: with the controller's time [s]; says why the arm has to stop, if it has to.
        blame: takes that reason; called in that thread.
    """

    def __init__(self, ask: Callable[[float], AgentError | None], blame: Callable[[AgentError], object]) -> None:
        self._ask = ask
        self._blame = blame
        self._thread = ThreadPoolExecutor(1, "poll")
        self._last: Future[None] = self._thread.submit(lambda: None)

    def poll(self, now: float) -> None:
        """Ask, unless an answer is still to come; raises what was raised by the last question."""
        if self._last.done():
            self._last.result()
            self._last = self._thread.submit(self._run, now)
            wait([self._last], PROMPT)

    def result(self) -> None:
        """Wait for the last answer; raises what was raised by that question."""
        self._last.result()

    def _run(self, now: float) -> None:
        reason = self._ask(now)
        if reason is not None:
            self._blame(reason)
