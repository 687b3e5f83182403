"""The dashboard of a CB3 or e-Series controller: one line asked, one line answered."""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.texts import ALARM, NAME, printable
from drivers.transports.base.link import dropped
from drivers.transports.base.ports import open_socket
from drivers.wire.ur_rtde import INERTIA_SINCE

_GREETING = "Connected: Universal Robots Dashboard Server"
_LONGEST = 4096  # bytes of a line


@dataclass(frozen=True)
class UrModel:
    """What stands there: `robot` as descriptions call it (`ur5e`, `ur5`), serial number, version of PolyScope."""

    robot: str
    serial: str
    version: tuple[int, ...]

    @property
    def remote(self) -> bool:
        """Whether this controller has a remote and a local mode, and says which."""
        return self.version >= (5, 6)

    @property
    def tells_inertia(self) -> bool:
        """Whether RTDE has the inertia of the payload."""
        return self.version >= INERTIA_SINCE.get(self.version[0], (6,))

    @property
    def period(self) -> float:
        """[s] of its control cycle."""
        return 0.002 if self.version >= (5,) else 0.008


class Dashboard:
    """A connection to the dashboard; any thread may ask.

    Raises:
        DriverError: nobody there, or silent.
        ProtocolError: somebody else's port.
    """

    def __init__(self, address: str, timeout: float) -> None:
        self.address = address
        self._timeout = timeout
        self._lock = threading.Lock()
        self._owed = 0  # answers that did not come in time
        self._buffer = b""
        self._socket = open_socket(address, timeout)
        try:
            greeting = self._line("the greeting of the dashboard")
        except BaseException:
            self.close()
            raise
        if not greeting.startswith(_GREETING):
            self.close()
            raise ProtocolError(
                f"{address} is no dashboard of a UR controller: it says {printable(greeting, NAME)!r}; is the address "
                "right? (PolyScope X has no dashboard, and this driver does not support it)"
            )

    def ask(self, command: str, timeout: float | None = None) -> str:
        """The answer to a command; an earlier one that comes late is passed over. `timeout` [s], if another than usual.

        Raises:
            DriverError: silent, or the link dropped.
        """
        within = self._timeout if timeout is None else timeout
        if not self._lock.acquire(timeout=within):
            raise self._silent(command, within)
        try:
            self._socket.settimeout(within)
            self._socket.sendall(command.encode() + b"\n")
            self._owed += 1
            while True:
                line = self._line(command)
                self._owed -= 1
                if not self._owed:
                    return line
        except OSError as error:
            raise dropped(self.address, error) from None
        finally:
            self._lock.release()

    def model(self) -> UrModel:
        """Who is there.

        Raises:
            ProtocolError: a version that cannot be read.
        """
        text = self.ask("PolyscopeVersion")
        match = re.search(r"(?<!\d)\d{1,9}(?:\.\d{1,9}){1,5}(?![\d.])", text)
        if match is None:
            raise ProtocolError(f"{self.address}: the version of PolyScope is not in {printable(text, NAME)!r}")
        version = tuple(int(part) for part in match[0].split("."))
        name = self.ask("get robot model").strip().lower().removesuffix("e")
        return UrModel(name + "e" * (version >= (5,)), self.ask("get serial number").strip(), version)

    def remote(self) -> bool:
        """Whether the robot is in remote control.

        Raises:
            RefusedError: the answer is neither yes nor no.
        """
        answer = self.ask("is in remote control").strip().lower()
        if answer not in ("true", "false"):
            raise RefusedError(f"{self.address}: asked for remote control, it answers {printable(answer, ALARM)!r}")
        return answer == "true"

    def close(self) -> None:
        """Never raises."""
        self._socket.close()

    def _line(self, asked: str) -> str:
        try:
            while b"\n" not in self._buffer:
                data = self._socket.recv(_LONGEST)
                if not data:
                    raise DriverError(f"the dashboard at {self.address} closed the connection")
                self._buffer += data
                if len(self._buffer) > _LONGEST:
                    raise ProtocolError(f"{self.address} is no dashboard of a UR controller: a line without an end")
        except TimeoutError:
            raise self._silent(asked, self._socket.gettimeout()) from None
        except OSError as error:
            raise dropped(self.address, error) from None
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode("latin-1").strip()

    def _silent(self, asked: str, within: float | None) -> DriverError:
        return DriverError(
            f"the dashboard at {self.address} is silent: no answer to {asked!r} within {within:g} s; are its services "
            "switched on (Settings, Security, Services)?"
        )
