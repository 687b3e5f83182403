"""Findings of a command that checks many things."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class CheckedItem:
    """One thing that was checked: `subject`, what was found, and the exit code it asks for (0: fine)."""

    subject: str
    message: str
    exit_code: int = 0

    @property
    def ok(self) -> bool:
        """Whether it stops nothing."""
        return self.exit_code == 0


@dataclass(frozen=True)
class Findings:
    """All that was checked."""

    findings: tuple[CheckedItem, ...]
    schema: str = "check/1"

    @property
    def exit_code(self) -> int:
        """0, or the code of the first problem."""
        return next((finding.exit_code for finding in self.findings if not finding.ok), 0)

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        rows = [{"subject": f.subject, "ok": f.ok, "message": f.message} for f in self.findings]
        return {"schema": self.schema, "ok": self.exit_code == 0, "findings": rows}

    def text(self) -> str:
        """A line each."""
        return "\n".join(f"{'ok     ' if f.ok else 'PROBLEM'} {f.subject}: {f.message}" for f in self.findings)
