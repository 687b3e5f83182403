"""One connection of the binary link: requests and answers, heartbeats, and the thread that reads.

Nothing here waits for whoever consumes the samples, so neither a slow disk nor a busy search silences the heartbeat.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import selectors
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

from drivers.errors import ConfigurationError, DriverError, ProtocolError, RefusedError
from drivers.wire.reasons import Refusal
from drivers.wire.tcp import MAX_REPLY_PAYLOAD, Decoder, Heartbeat, Refused, decode, encode

Reply = TypeVar("Reply")
_RECEIVE = 256 * 1024


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of `host:port`, `[IPv6]:port` included.

    Raises:
        ConfigurationError: anything else.
    """
    host, separator, port = str(address).rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not separator or not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65536:
        raise ConfigurationError(f"address {address!r}: host:port is expected, like 192.168.0.10:9100")
    return host, int(port)


def open_socket(address: str, timeout: float) -> socket.socket:
    """A connected socket.

    Raises:
        DriverError: nobody there.
        ConfigurationError: not an address.
    """
    host, port = parse_address(address)
    try:
        connection = socket.create_connection((host, port), timeout)
    except ConnectionRefusedError:
        raise DriverError(
            f"no controller answers at {address}: connection refused; is it on, is the address right?"
        ) from None
    except TimeoutError:
        raise DriverError(
            f"no controller answers at {address} within {timeout:g} s; is it on, is the address right, "
            "does a firewall stand between?"
        ) from None
    except (socket.gaierror, UnicodeError):
        raise DriverError(f"no controller at {address}: the host name {host!r} is not known; check it") from None
    except OSError as error:
        raise DriverError(f"no controller answers at {address}: {error.strerror or error}; check the network") from None
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


class Link:
    """A connected socket and its reader thread.

    `on_message(message, request)` gets, in the reader thread, what nobody waits for; `on_failure(error)` comes once,
    as the last call, when the link ends for whatever reason. `watchdog` [s] may be set once it is agreed on; while
    `guarded`, so long a silence of the peer ends the link. Heartbeats are sent all the time, four to a watchdog.
    """

    def __init__(
        self,
        connection: socket.socket,
        peer: str,
        on_message: Callable[[Any, int], None],
        on_failure: Callable[[DriverError], None],
        watchdog: float,
        timeout: float,
    ) -> None:
        self.peer = peer
        self.watchdog = watchdog
        self.guarded = False
        self.failure: DriverError | None = None
        self._socket = connection
        self._socket.settimeout(timeout)
        self._on_message = on_message
        self._on_failure = on_failure
        self._waiting: dict[int, queue.SimpleQueue[Any]] = {}
        self._ids = itertools.count(1)
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._heard = False
        self._thread = threading.Thread(target=self._run, name=f"link {peer}", daemon=True)
        self._thread.start()

    def post(self, message: Any) -> int:
        """Send a request without waiting; its answer goes to `on_message` with the id that is returned.

        Raises:
            DriverError: the link is down.
        """
        request = next(self._ids)
        self._send(message, request)
        return request

    def request(self, message: Any, reply: type[Reply], timeout: float, what: str) -> Reply:
        """Send a request once and wait for its answer.

        Raises:
            RefusedError: the controller refused; its reason is in the message.
            DriverError: no answer in time, or the link is down.
        """
        request = next(self._ids)
        answers: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._waiting[request] = answers
        try:
            self._send(message, request)
            answer = answers.get(timeout=timeout)
        except queue.Empty:
            spoke = "it sends, but" if self._heard else "it accepted the connection, but"
            raise DriverError(
                f"the controller at {self.peer} is silent: {spoke} did not answer {what} within {timeout:g} s; "
                "is it the calibration server that listens there?"
            ) from None
        finally:
            self._waiting.pop(request, None)
        if isinstance(answer, DriverError):
            raise self._ended()
        if isinstance(answer, Refused):
            raise RefusedError(f"the controller at {self.peer} refused {what}: {refusal_text(answer)}")
        if not isinstance(answer, reply):
            raise ProtocolError(f"the controller at {self.peer} answered {what} with {type(answer).__name__}")
        return answer

    def close(self) -> None:
        """End the link and its thread; never raises."""
        self._closing.set()
        self._hang_up()
        if threading.current_thread() is not self._thread:
            self._thread.join(5.0)
        self._socket.close()

    def _hang_up(self) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)

    def _ended(self) -> DriverError:
        assert self.failure is not None
        return type(self.failure)(str(self.failure))

    def _send(self, message: Any, request: int = 0) -> None:
        if self.failure is not None:
            raise self._ended()
        try:
            with self._lock:
                self._socket.sendall(encode(message, request))
        except TimeoutError:
            raise DriverError(f"the controller at {self.peer} takes no data any more; the link is dead") from None
        except OSError as error:
            if self.failure is not None:
                raise self._ended() from None
            raise DriverError(f"the link to {self.peer} dropped: {error.strerror or error}") from None

    def _run(self) -> None:
        try:
            self._read()
            failure = DriverError(f"the link to {self.peer} was closed by this end")
        except DriverError as error:
            failure = error
        except OSError as error:
            failure = DriverError(f"the link to {self.peer} dropped: {error.strerror or error}")
        except Exception as error:  # whoever waits must hear of it, whatever it is
            failure = ProtocolError(f"what {self.peer} sent cannot be handled: {type(error).__name__}: {error}")
        self.failure = failure
        self._hang_up()
        for answers in list(self._waiting.values()):
            answers.put(failure)
        self._on_failure(failure)

    def _read(self) -> None:
        decoder = Decoder(MAX_REPLY_PAYLOAD)
        silence, beaten = 0.0, time.monotonic()
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            while not self._closing.is_set():
                interval = self.watchdog / 4
                began = time.monotonic()
                if began - beaten >= interval:
                    with contextlib.suppress(DriverError):  # what the peer still sent is to be read all the same
                        self._send(Heartbeat())
                    beaten = began
                data = b""
                if selector.select(interval):
                    data = self._socket.recv(_RECEIVE)
                    if not data:
                        raise DriverError(f"the controller at {self.peer} closed the connection")
                # A stall of this process is not the peer's silence: no turn counts for more than it should last.
                silence += min(time.monotonic() - began, interval)
                try:
                    for frame in decoder.feed(data):
                        silence = 0.0
                        self._heard = True
                        self._deliver(decode(frame), frame.request)
                except ProtocolError as error:
                    raise ProtocolError(f"{self.peer}: {error}") from None
                if self.guarded and silence >= self.watchdog:
                    raise DriverError(
                        f"the controller at {self.peer} fell silent: nothing for {self.watchdog * 1000:.0f} ms while "
                        "the arm may move; go and look at it"
                    )

    def _deliver(self, message: Any, request: int) -> None:
        if isinstance(message, Heartbeat):
            return
        answers = self._waiting.get(request) if request else None
        if answers is not None:
            answers.put(message)
        else:
            self._on_message(message, request)


def refusal_text(refused: Refused) -> str:
    """A refusal for people: its reason, the place in the program, the controller's own words."""
    try:
        reason = Refusal(refused.code).name.lower().replace("_", " ")
    except ValueError:
        reason = f"reason {refused.code}"
    place = f", line {refused.line} column {refused.column}" if refused.line else ""
    return f"{reason}{place}: {refused.message}"
