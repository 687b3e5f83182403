"""CSV files of Isaac Sim's system identification: `time, q1…qN, dq1…dqN, cmd1…cmdN`, in rad and s.

Set-points may be missing, velocities too, and so may the line of names [isaacsim.robot_setup.sysid trajectory_csv.py].
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.core import InputError, counted, sha256_file
from agent.recording.datasets.episodes import Episode, Recorded
from agent.recording.tables.table_files import read_table

#: Beginnings of the names of columns, each followed by the number of a joint.
_FIELDS = {"q": "position", "dq": "velocity", "cmd": "command"}
_NAME = re.compile(rf"^({'|'.join(_FIELDS)})_?(\d+)$")
_TIMES = ("time", "t", "timestamp")
_LONGEST_HEAD = 2**14  # bytes
_LISTED = 8  # names in a message


def is_isaac_csv(path: Path) -> bool:
    """Whether a text file begins with the names of such columns."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with open(path, "rb") as file:
        head = file.readline(_LONGEST_HEAD).decode("utf-8-sig", "replace")
    return _are_its_names([name.strip(' "\r\n') for name in re.split(r"[,;\t]", head.lower().lstrip("# "))])


def _are_its_names(names: Sequence[str]) -> bool:
    return names[0] in _TIMES and len(names) > 1 and all(map(_NAME.match, names[1:]))


def read_isaac_csv(path: Path, joints: int | None = None) -> Recorded:
    """The motion in a file; `joints` are as many as the arm has, for a file without a line of names.

    Raises:
        InputError: other columns, a joint without one of its columns, or a number of them that is no multiple of the
            joints.
    """
    table = read_table(path)
    columns = {name.lower().lstrip("# "): values for name, values in table.columns.items()}
    if _are_its_names([*columns]):
        fields: dict[str, dict[int, np.ndarray]] = {field: {} for field in _FIELDS.values()}
        for hit, values in zip(map(_NAME.match, [*columns][1:]), [*columns.values()][1:], strict=True):
            assert hit is not None
            fields[_FIELDS[hit[1]]][int(hit[2])] = values
        fields = {field: numbered for field, numbered in fields.items() if numbered}
        numbers = sorted(fields.get("position", {}))
        if not numbers or numbers != [*range(numbers[0], numbers[0] + len(numbers))] or numbers[0] > 1:
            raise InputError(f"{path}: the positions q1…qN are not all there: {', '.join(map(str, numbers)) or 'none'}")
        if any(sorted(numbered) != numbers for numbered in fields.values()):
            listed = "; ".join(f"{field} {', '.join(map(str, sorted(fields[field])))}" for field in fields)
            raise InputError(f"{path}: the columns are not of the same joints: {listed}")
        arrays = {field: np.column_stack([numbered[n] for n in numbers]) for field, numbered in fields.items()}
    else:
        unnamed = [*columns.values()]
        parts = (len(unnamed) - 1) // joints if joints else 0
        named = [name for name in columns if not name.startswith("column ")]
        if named or not joints or len(unnamed) != 1 + parts * joints or not 1 <= parts <= len(_FIELDS):
            what = f"the columns {', '.join(named[:_LISTED])}" if named else counted(len(unnamed), "column")
            raise InputError(
                f"{path}: {what} are not time, and one to three of each joint of the arm: time, q1…qN, dq1…dqN, "
                "cmd1…cmdN. Describe them with --map MAP.yaml"
            )
        arrays = {
            field: np.column_stack(unnamed[1 + k * joints : 1 + (k + 1) * joints])
            for k, field in enumerate([*_FIELDS.values()][:parts])
        }
    time = next(iter(columns.values()))
    episode = Episode(path.stem, time, **arrays)
    return Recorded(path, (), (episode,), sha256=sha256_file(path), notes=table.notes)
