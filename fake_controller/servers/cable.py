"""A serial cable: two pseudo-terminals with a thread between them that is as slow as the baud rate says."""

from __future__ import annotations

import contextlib
import os
import selectors
import threading
import time
import tty
from collections.abc import Callable

from drivers.wire.serial import BITS_PER_BYTE

_TICK = 0.004  # s of the line in one piece


class Cable:
    """Whatever is written into one end comes out of the other, at `baud` bits per second and not faster.

    `near` and `far` are the ports at its ends. Where nobody reads the line waits, as with hardware flow control.
    `tamper(end, data)`, if set, is given what end "near" or "far" has said, and returns what the other end hears.
    """

    def __init__(self, baud: int) -> None:
        self._byte = BITS_PER_BYTE / baud
        self._piece = max(1, round(_TICK / self._byte))
        pairs = [os.openpty() for _ in range(2)]
        self._masters = [master for master, _ in pairs]
        self._slaves = [slave for _, slave in pairs]  # held open, so that an end may be opened and closed at will
        for slave in self._slaves:
            tty.setraw(slave)
        for master in self._masters:
            os.set_blocking(master, False)
        self.near, self.far = (os.ttyname(slave) for slave in self._slaves)
        self.tamper: Callable[[str, bytes], bytes] | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cable", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Pull it out; who has an end open meets a port that is gone."""
        self._closing.set()
        self._thread.join(5.0)
        for handle in (*self._masters, *self._slaves):
            with contextlib.suppress(OSError):
                os.close(handle)
        self._masters, self._slaves = [], []

    def _run(self) -> None:
        near, far = self._masters
        ways = {near: far, far: near}
        free_at = dict.fromkeys(ways, 0.0)  # when the line of this source can take the next piece
        left = dict.fromkeys(ways, b"")  # read, but not taken by the other end yet
        with selectors.DefaultSelector() as selector:
            waiting: set[int] = set()
            while not self._closing.is_set():
                now = time.monotonic()
                for source, target in ways.items():
                    if left[source]:
                        left[source] = self._write(target, left[source])
                    idle = not left[source] and free_at[source] <= now
                    if idle and source not in waiting:
                        selector.register(source, selectors.EVENT_READ)
                        waiting.add(source)
                    elif not idle and source in waiting:
                        selector.unregister(source)
                        waiting.discard(source)
                busy = [max(free_at[way] - now, 0.0) for way in ways if way not in waiting]
                for key, _ in selector.select(min([*(max(wait, 0.001) for wait in busy), 0.05])):
                    source = int(key.fd)
                    with contextlib.suppress(BlockingIOError):
                        data = os.read(source, self._piece)
                        free_at[source] = max(free_at[source], time.monotonic() - _TICK) + len(data) * self._byte
                        if self.tamper is not None:
                            data = self.tamper("near" if source == near else "far", data)
                        left[source] = self._write(ways[source], data)

    def _write(self, target: int, data: bytes) -> bytes:
        """Write bytes; returns those that could not be written."""
        try:
            return data[os.write(target, data) :]
        except BlockingIOError:
            return data
