"""The folder of programs on the controller, by FTP. A connection for every errand: none idles while the arm moves."""

from __future__ import annotations

import ftplib
import hashlib
import io
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from drivers.errors import DriverError, ProtocolError, RefusedError
from drivers.protocol import Identity
from drivers.secrets import read_secret
from drivers.transports.base.link import WATCHDOG
from drivers.transports.cnr.address import CnrAddress
from drivers.wire import cnr as wire

_UNGUARDED = (
    f"nothing says that this controller stops the arm where the agent is gone: the published programs run on. Have "
    f"agent_watch of docs/controller-programs.md active, try it, and write its time into {wire.IDENTITY_FILE}"
)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,31}", re.ASCII)
_NO_SUCH_FILE = "550"
#: Bytes of a file in the folder that are read: a controller's memory for programs is smaller.
_LONGEST = 4 << 20
_MOST_LINES = 100  # of an answer


@dataclass(frozen=True)
class CnrIdentity:
    """Content of the identity file. `watchdog` [s]."""

    identity: Identity
    emulator: bool
    watchdog: float


class ProgramFolder:
    """Programs and what belongs to them; every method may raise a `DriverError`."""

    def __init__(self, address: CnrAddress, timeout: float) -> None:
        self._address = address
        self._timeout = timeout
        self._peer = f"{address.host}:{address.ftp}"

    def machine(self) -> CnrIdentity:
        """Identity of the controller, from the file written when the link was set up."""
        with self._session() as ftp:
            data = _read(ftp, wire.IDENTITY_FILE)
        if data is None:
            raise DriverError(
                f"the folder of programs at {self._peer} has no {wire.IDENTITY_FILE}; write it once, as "
                "docs/real-robot.md shows, so that the robot can be told from others"
            )
        return _machine(data, self._peer)

    def stored(self) -> tuple[str, str]:
        """Name and SHA-256 (hex) of the program that a start would run; empty if there is none."""
        with self._session() as ftp:
            entry = _read(ftp, wire.PROGRAM_FILE)
            name = "" if entry is None else entry.decode("ascii", "replace").strip()
            text = _read(ftp, f"{name}.pdl") if _NAME.fullmatch(name) else None
        return ("", "") if text is None else (name, hashlib.sha256(text).hexdigest())

    def store(self, name: str, text: str) -> str:
        """Store a program and name it as the one to start; returns the SHA-256 (hex) of what was read back.

        Raises:
            RefusedError: not a name, no space, or the controller cannot translate the text (with line and column).
        """
        if not _NAME.fullmatch(name):
            raise RefusedError(f"{name!r} cannot name a program: 1 to 32 letters, digits or _, the first no digit")
        with self._session() as ftp:
            _remove(ftp, f"{name}.err")
            self._write(ftp, f"{name}.pdl", text.encode("utf-8"))
            stored = _read(ftp, f"{name}.pdl")
            if stored is None:
                raise DriverError(f"{self._peer} stored {name}.pdl and does not have it any more; look at its memory")
            faults = _read(ftp, f"{name}.err")
            if faults:
                _remove(ftp, f"{name}.pdl")
                raise RefusedError(f"the controller at {self._peer} refused the program {name}: {_first_fault(faults)}")
            self._write(ftp, wire.PROGRAM_FILE, f"{name}\n".encode("ascii"))
        return hashlib.sha256(stored).hexdigest()

    def _write(self, ftp: ftplib.FTP, name: str, data: bytes) -> None:
        try:
            ftp.storbinary(f"STOR {name}", io.BytesIO(data))
        except (ftplib.error_perm, ftplib.error_temp) as error:
            raise RefusedError(
                f"the controller at {self._peer} does not store {name}: {self._public_text(error)}; is its memory "
                "full, may its user write there?"
            ) from None

    @contextmanager
    def _session(self) -> Iterator[ftplib.FTP]:
        ftp = _Client(timeout=self._timeout)
        try:
            ftp.connect(self._address.host, self._address.ftp)
            self._enter(ftp)
            yield ftp
        except (ftplib.error_proto, UnicodeError) as error:
            raise ProtocolError(f"what answers at {self._peer} is no FTP server: {error}") from None
        except (ftplib.Error, EOFError) as error:
            raise DriverError(
                f"FTP at {self._peer} failed: {self._public_text(error) or 'the connection was closed'}"
            ) from None
        except OSError as error:
            raise DriverError(
                f"no FTP server answers at {self._peer}: {error.strerror or error}; is it switched on at the "
                "controller, is the port right?"
            ) from None
        finally:
            with suppress(OSError, EOFError, UnicodeError, ftplib.Error):
                ftp.quit()
            ftp.close()

    def _public_text(self, error: Exception) -> str:
        """The server's words, which may repeat what the options of the address say."""
        text = str(error)
        for option in (self._address.user, self._address.folder):
            text = text.replace(option, "…") if option else text
        return text

    def _enter(self, ftp: ftplib.FTP) -> None:
        address = self._address
        try:
            ftp.login(address.user, read_secret(address.password_from) if address.password_from else "")
        except ftplib.error_perm as error:
            raise DriverError(
                f"FTP at {self._peer} does not let this user in: {self._public_text(error)}; give user= and "
                "password_from= in the address"
            ) from None
        if address.folder:
            try:
                ftp.cwd(address.folder)
            except ftplib.error_perm as error:
                raise DriverError(
                    f"FTP at {self._peer} has no folder as the address names it: {self._public_text(error)}"
                ) from None


class _Client(ftplib.FTP):
    """Reject an answer with endless lines."""

    def getmultiline(self) -> str:
        self._lines = 0
        return super().getmultiline()

    def getline(self) -> str:
        self._lines += 1
        if self._lines > _MOST_LINES:
            raise ftplib.error_proto(f"an answer of more than {_MOST_LINES} lines")
        return super().getline()


def _read(ftp: ftplib.FTP, name: str) -> bytes | None:
    """A file, or None if it does not exist.

    Raises:
        ProtocolError: it is longer than any that belongs there.
    """
    parts: list[bytes] = []
    size = 0

    def take(part: bytes) -> None:
        nonlocal size
        size += len(part)
        if size > _LONGEST:
            raise ProtocolError(f"{name} is longer than {_LONGEST >> 20} MiB; is it the right file?")
        parts.append(part)

    try:
        ftp.retrbinary(f"RETR {name}", take)
    except ftplib.error_perm as error:
        if str(error).startswith(_NO_SUCH_FILE):
            return None
        raise
    return b"".join(parts)


def _remove(ftp: ftplib.FTP, name: str) -> None:
    with suppress(ftplib.error_perm):
        ftp.delete(name)


def _first_fault(faults: bytes) -> str:
    """`line column message`, as a sentence."""
    first = faults.decode("utf-8", "replace").strip().splitlines()[0]
    line, _, remainder = first.partition(" ")
    column, _, message = remainder.partition(" ")
    if line.isdigit() and column.isdigit():
        return f"line {line} column {column}: {message}"
    return first


def _machine(data: bytes, peer: str) -> CnrIdentity:
    where = f"{wire.IDENTITY_FILE} at {peer}"
    try:
        entry = json.loads(data.decode("utf-8"))
        texts = robot, serial, controller, version = [entry[k] for k in ("robot", "serial", "controller", "version")]
        names, period = tuple(entry["joint_names"]), float(entry["period"])
        watchdog, emulator = float(entry.get("watchdog", WATCHDOG)), entry.get("emulator", False)
    except KeyError as error:
        raise DriverError(f"{where} lacks {error}; docs/real-robot.md shows what it needs") from None
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DriverError(f"{where} cannot be read: {error}; docs/real-robot.md shows what it needs") from None
    if not all(isinstance(text, str) and text for text in (*texts, *names)) or not 1 <= len(names) <= wire.AXES:
        raise DriverError(f"{where}: robot, serial, controller, version and 1 to {wire.AXES} joint_names are texts")
    if not 0.0001 <= period <= 1.0 or not 0.05 <= watchdog <= 60.0 or not isinstance(emulator, bool):
        raise DriverError(
            f"{where}: period is 0.0001 to 1 s, watchdog 0.05 to 60 s, emulator true or false; it has {period}, "
            f"{watchdog}, {emulator}"
        )
    unguarded = "" if "watchdog" in entry else _UNGUARDED
    return CnrIdentity(
        Identity(robot, serial, controller, version, names, period, unguarded=unguarded), emulator, watchdog
    )
