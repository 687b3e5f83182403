"""The program that a driver keeps until it is started, where the controller stores none."""

from __future__ import annotations

import hashlib
from typing import Generic, Protocol, TypeVar

from drivers.errors import RefusedError


class _Text(Protocol):
    @property
    def text(self) -> str: ...


Program = TypeVar("Program", bound=_Text)


class KeptProgram(Generic[Program]):
    """At most one program, with its name and the SHA-256 (hex) of its text; both are empty while there is none."""

    name = checksum = ""
    program: Program | None = None

    def keep(self, name: str, program: Program) -> str:
        """Keep this one instead; returns its checksum."""
        self.name, self.program = name, program
        self.checksum = hashlib.sha256(program.text.encode()).hexdigest()
        return self.checksum

    def find(self, name: str, checksum: str) -> Program:
        """The program that is to be started.

        Raises:
            RefusedError: another one was kept, or none.
        """
        if self.program is None or (self.name, self.checksum) != (name, checksum):
            raise RefusedError(f"the program that was stored is not the {name!r} that is to be started; nothing moved")
        return self.program
