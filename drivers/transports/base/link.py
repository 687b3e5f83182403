"""Shared base of all drivers: the thread that reads a link, and one motion at a time."""

from __future__ import annotations

import contextlib
import selectors
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from socket import SHUT_RDWR, socket
from typing import Any, Generic, TypeVar

import numpy as np

from drivers.errors import ConfigurationError, DriverError, ProtocolError, RefusedError
from drivers.protocol import Gap, SampleBlock
from drivers.texts import public_address
from drivers.transports.base.samples import SampleStream

#: Silence [s] after which either end takes the other for gone, where the controller grants what is asked for. A busy
#: machine keeps a process waiting for up to 0.3 s.
WATCHDOG = 0.5
_LAST_CALL = 1.0  # s, at most, from the failure of a link to the end of its motion


def dropped(peer: str, error: OSError) -> DriverError:
    """The error of a link that the operating system reports as broken."""
    return DriverError(f"the link to {peer} dropped: {error.strerror or error}")


class LinkThread:
    """A thread that alone reads a link. It ends with an error, whatever the reason: `failure` from then on.

    `on_failure(error)` is its last call. A subclass starts the thread, and keeps in `_handles` the sockets that end
    with the link. While `guarded`, a silence of `watchdog` [s] ends a link that is read with `_each_turn`.
    """

    failure: DriverError | None = None
    guarded = False
    watchdog = WATCHDOG
    _handles: Iterable[socket] = ()
    _heard = False  # something in this turn, that shows that the peer lives
    _silent_for = 0.0  # s, of all turns since then

    def __init__(self, peer: str, on_failure: Callable[[DriverError], None]) -> None:
        self.peer = peer
        self._on_failure = on_failure
        self._closing = threading.Event()
        self._changed = threading.Condition()  # something has come, or the link has ended
        self._thread = threading.Thread(target=self._run, name=f"link {peer}", daemon=True)

    def check(self) -> None:
        """Raises:
        DriverError: the link is down.
        """
        if self.failure is not None:
            raise type(self.failure)(str(self.failure))

    def wait(self, reached: Callable[[], bool], timeout: float) -> bool:
        """Wait until received messages make `reached` true; False if they do not within `timeout` [s]."""
        with self._changed:
            return self._changed.wait_for(lambda: reached() or self.failure is not None, timeout) and reached()

    def transmit(self, handle: socket, data: bytes, peer: str) -> None:
        """Send bytes, once.

        Raises:
            DriverError: the link is down, or the far end takes no data any more.
        """
        self.check()
        try:
            handle.sendall(data)
        except TimeoutError:
            raise DriverError(f"{peer} takes no data any more; the link is dead") from None
        except OSError as error:
            self.check()
            raise dropped(peer, error) from None

    def close(self) -> None:
        """End the link and its thread; never raises."""
        self._closing.set()
        self._hang_up()
        self._join(5.0)
        for handle in self._handles:
            handle.close()

    def _join(self, timeout: float) -> None:
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout)

    def _hang_up(self) -> None:
        for handle in self._handles:
            with contextlib.suppress(OSError):
                handle.shutdown(SHUT_RDWR)

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

    def _each_turn(self, handles: Sequence[socket], longest: float | None = None) -> Iterator[list[Any]]:
        """Wait for handles to become readable, turn by turn until the link is closed; yields those that are.

        Whoever handles them sets `_heard`. A turn waits `longest` [s], by default min(watchdog, WATCHDOG) / 4.

        Raises:
            DriverError: nothing was heard for a watchdog while `guarded`.
        """
        with selectors.DefaultSelector() as selector:
            for handle in handles:
                selector.register(handle, selectors.EVENT_READ)
            while not self._closing.is_set():
                began, wait = time.monotonic(), min(self.watchdog, WATCHDOG) / 4 if longest is None else longest
                self._heard = False
                ready = [key.fileobj for key, _ in selector.select(wait)]
                waited = time.monotonic() - began
                yield ready
                self._count_silence(waited, wait)

    def _count_silence(self, waited: float, longest: float) -> None:
        """End a turn that took `waited` [s].

        A stall of this process is not the peer's silence: no turn counts for more than it should last, `longest` [s].

        Raises:
            DriverError: nothing was heard for a watchdog while `guarded`.
        """
        self._silent_for = 0.0 if self._heard else self._silent_for + min(waited, longest)
        if self.guarded and self._silent_for >= self.watchdog:
            raise self._fell_silent()

    def _work(self) -> None:
        """Read until `_closing` is set."""
        raise NotImplementedError

    def _fell_silent(self) -> DriverError:
        """The error of a peer that is silent while the arm may move."""
        raise NotImplementedError

    def _end(self, failure: DriverError) -> None:
        """Set `failure`, hang up, and let nobody wait any longer."""
        with self._changed:
            self.failure = failure
            self._changed.notify_all()
        self._hang_up()


Link = TypeVar("Link", bound=LinkThread)
Motion = TypeVar("Motion", bound=SampleStream)


class LinkDriver(Generic[Link, Motion]):
    """The part of `drivers.protocol.Driver` that is the same on every wire.

    Parameters
    ----------
    address : of the far end, for messages.
    timeout : how long [s] to wait for an answer.
    start_timeout : the same for `start`, where the controller plans first, and for the arm to rest after `stop`.
    buffer_limit : bytes of samples kept for a consumer that is behind (the default: over an hour at 500 Hz and six
        joints). Beyond it the motion is stopped; the link itself never waits for the consumer.
    watchdog : silence [s] after which either end takes the other for gone, where a client may ask for one; the
        controller may answer another one.
    """

    def __init__(
        self,
        address: str,
        timeout: float = 5.0,
        start_timeout: float = 60.0,
        buffer_limit: int = 512 * 1024 * 1024,
        watchdog: float = WATCHDOG,
    ) -> None:
        self.address = public_address(address)
        self._timeout = timeout
        self._start_timeout = start_timeout
        self._buffer_limit = buffer_limit
        self._watchdog = watchdog
        self._link: Link | None = None
        self._motion: Motion | None = None
        #: `ListensFirst`
        self.listening: Callable[[], None] = lambda: None

    @property
    def watchdog(self) -> float:
        """The watchdog in force [s]: the one asked for, once connected the one of the link."""
        link = self._link
        return self._watchdog if link is None else link.watchdog

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """What is missing from the samples of the last motion, once the driver has tried to get it again."""
        return () if self._motion is None else self._motion.sequencer.gaps

    def connect(self) -> None:
        """Open the link and agree with the controller on what is needed."""
        self.close()
        self._motion = None
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def samples(self) -> Iterator[SampleBlock]:
        """Samples of the motion, in order, each once; what arrived before an error is yielded before it is raised."""
        if self._motion is None:
            raise DriverError("there are no samples: nothing was started")
        return self._motion.blocks()

    def stop(self) -> None:
        """Ask for a stop on the path and wait until the arm rests; nothing to do where nobody is connected."""
        link, motion = self._link, self._motion
        if link is not None and not self._nothing_to_stop(link, motion):
            self._bring_to_rest(link, motion)

    def close(self) -> None:
        """Close the link; a controller that still moves comes to rest by itself. Never raises."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _open(self) -> None:
        """Set `_link`, greet the controller, and learn who it is."""
        raise NotImplementedError

    def _bring_to_rest(self, link: Link, motion: Motion | None) -> None:
        """Send the stop, and wait until the arm rests.

        Raises:
            DriverError: the controller does not report that it does.
        """
        raise NotImplementedError

    def _connected(self) -> Link:
        if self._link is None:
            raise DriverError(f"the link to {self.address} is not open; connect first")
        self._link.check()
        return self._link

    @property
    def _running(self) -> Motion | None:
        """The motion that is not over, if there is one."""
        motion = self._motion
        return None if motion is None or motion.over else motion

    def _check_over(self) -> None:
        if self._running is not None:
            raise DriverError("the last motion is not over yet; read its samples to the end, or stop it")

    @contextlib.contextmanager
    def _start_of(self, motion: Motion) -> Iterator[Motion]:
        """Listen to a motion that is started in here. After a refusal the arm stands, unless its samples say otherwise;
        after any other failure it may move: a stop is sent, and the link is closed, which stops it too."""
        self._motion = motion
        self.listening()
        try:
            yield motion
        except BaseException as error:
            if isinstance(error, RefusedError) and not motion.moved:
                motion.finish(None)  # whoever listened to it is done
                self._motion = None
                self._not_started()
                raise
            self._stop_for_good(motion)
            if isinstance(error, RefusedError):
                raise DriverError(f"{error}; {motion.seen}") from None
            raise

    def _stop_for_good(self, motion: Motion) -> None:
        """Send a stop, give the arm a moment, and close the link, which stops the arm too."""
        link = self._link
        if link is not None and link.failure is None:

            def stop() -> None:
                with contextlib.suppress(DriverError):
                    self._bring_to_rest(link, motion)

            stopping = threading.Thread(target=stop, name="stop of a failed start", daemon=True)
            stopping.start()
            stopping.join(_LAST_CALL)
        self.close()

    def _not_started(self) -> None:
        """The start was refused."""
        if self._link is not None:
            self._link.guarded = False

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


def check_currents(torque_per_ampere: np.ndarray, joints: int) -> None:
    """See that somebody has said what torque an ampere is, (n, n) [N·m/A].

    Raises:
        ConfigurationError: nobody has, or of another arm.
    """
    if torque_per_ampere.shape != (joints, joints):
        raise ConfigurationError(
            f"the link delivers motor currents of {joints} joints; torque_per_ampere has the shape "
            f"{torque_per_ampere.shape}"
        )
