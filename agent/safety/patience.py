"""Waiting that has an end."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import TypeVar

_Item = TypeVar("_Item")
_TURN = 0.25  # s


class Patience:
    """Takes items from somebody who may keep one waiting for ever.

    Args:
        limit: to wait for one item [s].
        clock: seconds.
        give_up: called once, in a thread of its own, when an item has not come within the limit; it has to make the
            items end.
    """

    def __init__(self, limit: float, clock: Callable[[], float], give_up: Callable[[], object]) -> None:
        self._limit = limit
        self._clock = clock
        self._give_up = give_up
        self._since: float | None = None
        self._over = threading.Event()
        #: Whether it gave up.
        self.lost = False

    def each(self, items: Iterator[_Item]) -> Iterator[_Item]:
        """The items; what the taker does with one does not count as waiting."""
        self._since = self._clock()
        watch = threading.Thread(target=self._watch, name="patience", daemon=True)
        watch.start()
        try:
            for item in items:
                self._since = None
                yield item
                self._since = self._clock()
        finally:
            self._over.set()
            watch.join()

    def _watch(self) -> None:
        while not self._over.wait(_TURN):
            since = self._since
            if since is not None and not self._clock() - since <= self._limit:
                self.lost = True
                self._give_up()
                return
