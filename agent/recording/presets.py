"""Recordings whose columns are known: the map that `agent import --preset` uses, as far as a file has its columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np

from agent.core import InputError
from agent.recording.column_table import ColumnTable
from agent.recording.mapping import Mapping, load_mapping

#: The map of each recorder.
PRESETS = {"ur-rtde": "ur_recording.yaml", "ur-record": "ur_recording.yaml"}
#: What a recording may leave out.
_OPTIONAL = ("velocity", "effort", "reference_position")


def preset_map(name: str, tables: Sequence[ColumnTable]) -> tuple[Mapping, list[str]]:
    """The map of a recorder for these tables, and what there is to say: quantities and marks that they do not have.

    Raises:
        InputError: there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"--preset {name!r} is not known; there are {', '.join(PRESETS)}")
    mapping = load_mapping(Path(str(files("agent.recording") / PRESETS[name])))
    changes: dict[str, None] = {}
    notes = []
    for quantity in _OPTIONAL:
        columns = getattr(mapping.entries, quantity).columns
        if not any(all(table.column(column) is not None for column in columns) for table in tables):
            changes[quantity] = None
            notes.append(f"no {columns[0]} and its like: {quantity} is left out")
    rows = mapping.entries.rows
    if rows is not None:
        marks = [column for table in tables if (column := table.column(rows.column)) is not None]
        if not any(np.any(mark == rows.equals) for mark in marks):
            changes["rows"] = None
            notes.append(f"no row has {rows.column} {rows.equals:g} (a program runs), so all rows are taken")
    return replace(mapping, entries=mapping.entries.model_copy(update=changes), preset=True), notes
