"""Which programs have run slowly, with somebody watching, on which machine: a small file beside the runs."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

from agent.core import InputError

FILE = "checked_programs.json"
_SCHEMA = "checked_programs/1"


class CheckedPrograms:
    """Programs by their SHA-256 (hex), machines by their serial.

    Args:
        path: the file; read when it is asked, so that what another run adds counts.
    """

    def __init__(self, path: Path):
        self.path = path

    def has(self, serial: str, checksum: str) -> bool:
        """Whether the program has run slowly on this machine.

        Raises:
            InputError: the file is damaged.
        """
        return any(entry["serial"] == serial and entry["program"] == checksum for entry in self._entries())

    def add(self, serial: str, checksum: str) -> None:
        """Remember it.

        Raises:
            AgentError: the file cannot be written, or it is damaged.
        """
        from agent.core import write_atomically

        if self.has(serial, checksum):
            return
        now = datetime.now(UTC).isoformat(timespec="seconds")
        entries = [*self._entries(), {"serial": serial, "program": checksum, "at": now}]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path, json.dumps({"schema": _SCHEMA, "programs": entries}, indent=2) + "\n")

    def _entries(self) -> list[dict[str, str]]:
        try:
            data = json.loads(self.path.read_text(encoding="utf-8"))
            if data["schema"] != _SCHEMA:
                raise ValueError(f"schema {data['schema']!r}")
            return [{key: str(entry[key]) for key in ("serial", "program", "at")} for entry in data["programs"]]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{self.path}: this list of checked programs is damaged ({error}); move it away, every program will "
                "then run slowly once more"
            ) from None
