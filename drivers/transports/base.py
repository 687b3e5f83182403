"""What drivers have in common, whatever their wire: the thread of a link, and one motion at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from drivers.errors import DriverError, ProtocolError
from drivers.protocol import Gap, SampleBlock
from drivers.texts import place_of
from drivers.transports.motion import MotionStream

#: Silence [s] after which either end takes the other for gone, where the controller grants what is asked for. A busy
#: machine keeps a process waiting for up to 0.3 s.
WATCHDOG = 0.5
_LAST_CALL = 1.0  # s, at most, from the failure of a link to the end of its motion


def dropped(peer: str, error: OSError) -> DriverError:
    """What an error of the operating system says of a link."""
    return DriverError(f"the link to {peer} dropped: {error.strerror or error}")


class LinkThread:
    """A thread that alone reads a link and ends with an error, whatever the reason: `failure` from then on.

    `on_failure(error)` is its last call. A subclass starts it.
    """

    failure: DriverError | None = None

    def __init__(self, peer: str, on_failure: Callable[[DriverError], None]) -> None:
        self.peer = peer
        self._on_failure = on_failure
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"link {peer}", daemon=True)

    def check(self) -> None:
        """Raises:
        DriverError: the link is down.
        """
        if self.failure is not None:
            raise type(self.failure)(str(self.failure))

    def _join(self, timeout: float) -> None:
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def _run(self) -> None:
        try:
            self._work()
            failure = DriverError(f"the link to {self.peer} was closed by this end")
        except DriverError as error:
            failure = error
        except OSError as error:
            failure = dropped(self.peer, error)
        except Exception as error:  # whoever waits must hear of it, whatever it is
            failure = ProtocolError(f"what {self.peer} sent cannot be handled: {type(error).__name__}: {error}")
        self._end(failure)
        self._on_failure(failure)

    def _work(self) -> None:
        """Read until `_closing` is set."""
        raise NotImplementedError

    def _end(self, failure: DriverError) -> None:
        """Set `failure`, hang up, and let nobody wait any longer."""
        raise NotImplementedError


Link = TypeVar("Link", bound=LinkThread)
Motion = TypeVar("Motion", bound=MotionStream)


class LinkDriver(Generic[Link, Motion]):
    """The part of `drivers.protocol.Driver` that is the same on every wire.

    Args:
        address: the far end, for messages.
        timeout: how long [s] to wait for an answer.
        start_timeout: the same for `start`, where the controller plans first, and for the arm to rest after `stop`.
        buffer_limit: bytes of samples kept for a consumer that is behind (the default: over an hour at 500 Hz and six
            joints). Beyond it the motion is stopped; the link itself never waits for the consumer.
    """

    def __init__(
        self,
        address: str,
        timeout: float = 5.0,
        start_timeout: float = 60.0,
        buffer_limit: int = 512 * 1024 * 1024,
    ) -> None:
        self.address = place_of(address)
        self._timeout = timeout
        self._start_timeout = start_timeout
        self._buffer_limit = buffer_limit
        self._link: Link | None = None
        self._motion: Motion | None = None

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """What is missing from the samples of the last motion, once the driver has tried to get it again."""
        return () if self._motion is None else self._motion.sequencer.gaps

    def samples(self) -> Iterator[SampleBlock]:
        """Samples of the motion, in order, each once; what arrived before an error is yielded before it is raised."""
        if self._motion is None:
            raise DriverError("there are no samples: nothing was started")
        return self._motion.blocks()

    def _connected(self) -> Link:
        if self._link is None:
            raise DriverError(f"the link to {self.address} is not open; connect first")
        self._link.check()
        return self._link

    def _check_over(self) -> None:
        if self._motion is not None and not self._motion.over:
            raise DriverError("the last motion is not over yet; read its samples to the end, or stop it")

    def _nothing_to_stop(self, link: Link | None, motion: Motion | None) -> bool:
        """Whether there is nobody to tell, or a dead link whose motion is over, as its thread soon says."""
        return link is None or (link.failure is not None and (motion is None or motion.wait(_LAST_CALL)))

    def _still_moves(self, took: str = "took") -> DriverError:
        """The error of a stop that did not bring the arm to rest."""
        return DriverError(
            f"the controller at {self.address} {took} the stop command, but does not report the arm at rest; "
            "use the emergency stop"
        )

    def _on_failure(self, error: DriverError) -> None:
        """The link is down (in its thread)."""
        if self._motion is not None:
            self._motion.finish(error)
