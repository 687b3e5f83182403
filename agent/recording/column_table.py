"""Columns of numbers by name, whatever file they come from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np


@dataclass(frozen=True, eq=False)
class ColumnTable:
    """Columns (S,) by name, in the order of the file, NaN where a field is no number; constants by name.

    A matrix (S, k) named q is columns q[1] to q[k]. Columns of a MAT file may differ in length. `words` has the first
    field of a column that is no number, where there is one; `other_names` the column of a name in another line of
    names; `doubled` names that several columns have; `notes` what there is to say about the file.
    """

    path: Path
    columns: dict[str, np.ndarray]
    constants: dict[str, float]
    words: dict[str, str] = field(default_factory=dict)
    other_names: dict[str, str] = field(default_factory=dict)
    doubled: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()

    def name(self, key: str | int) -> str | None:
        """Name of a column, found by name or by number from 1; None if there is no such column."""
        if isinstance(key, int):
            return list(self.columns)[key - 1] if 1 <= key <= len(self.columns) else None
        for text in (key, key.lstrip("#% ")):  # a comment that holds the names
            name = text if text in self.columns else self.other_names.get(text, f"{text}[1]")
            if name in self.columns:
                return name
        return None

    def column(self, key: str | int) -> np.ndarray | None:
        """Column (S,), found by name or by number from 1; None if there is no such column."""
        name = self.name(key)
        return None if name is None else self.columns[name]

    def matrix(self, name: str) -> list[str]:
        """Names of the columns of a matrix, q[1], q[2], …; empty if there is none of that name."""
        name = self.other_names.get(name, name)
        return [column for column in self.columns if column.startswith(f"{name}[")]
