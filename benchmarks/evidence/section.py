"""What a section of the page is made of."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field


@dataclass
class PageSection:
    """Markdown `lines`, and what of it belongs among the weak spots."""

    lines: list[str] = field(default_factory=list)
    weak: list[str] = field(default_factory=list)

    def say(self, *lines: str) -> None:
        """Add lines, and an empty one."""
        self.lines += [*lines, ""]

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """Add a table."""
        self.say(
            "| " + " | ".join(head) + " |",
            "| " + " | ".join("---" for _ in head) + " |",
            *("| " + " | ".join(row) + " |" for row in rows),
        )

    def picture(self, name: str, what: str) -> None:
        """Add a picture of the page's folder."""
        self.say(f"![{what}](evidence/{name}.svg)")
