"""CSV files of Isaac Sim's system identification: `time, q1…qN, dq1…dqN, cmd1…cmdN`, in rad and s.

Set-points may be missing, velocities too, and so may the line of names [isaacsim.robot_setup.sysid trajectory_csv.py].
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from agent.core import InputError, sha256_file
from agent.recording.datasets.episodes import Episode, Recorded
from agent.recording.tables import read_table

#: Beginnings of the names of columns, each followed by the number of a joint.
_FIELDS = {"q": "position", "dq": "velocity", "cmd": "command"}
_NAME = re.compile(rf"^({'|'.join(_FIELDS)})_?(\d+)$")
_LONGEST_HEAD = 2**14  # bytes


def is_isaac_csv(path: Path) -> bool:
    """Whether a text file begins with the names of such columns."""
    if path.suffix.lower() != ".csv" or not path.is_file():
        return False
    with open(path, "rb") as file:
        head = file.readline(_LONGEST_HEAD).decode("utf-8", "replace").lower()
    names = [name.strip() for name in head.split(",")]
    return names[0] == "time" and len(names) > 1 and all(_NAME.match(name) for name in names[1:])


def read_isaac_csv(path: Path, joints: int | None = None) -> Recorded:
    """The motion in a file; `joints` are as many as the arm has, for a file without a line of names.

    Raises:
        InputError: other columns, or a number of them that is no multiple of the joints.
    """
    table = read_table(path)
    columns = {name.lower(): values for name, values in table.columns.items()}
    if is_isaac_csv(path):
        fields = {field: _numbered(columns, start) for start, field in _FIELDS.items()}
        arrays = {field: np.column_stack(values) for field, values in fields.items() if values}
    else:
        values = [*columns.values()]
        parts = (len(values) - 1) // joints if joints else 0
        if not joints or len(values) != 1 + parts * joints or not 1 <= parts <= len(_FIELDS):
            raise InputError(
                f"{path}: {len(values)} columns are not time, and one to three of each joint of the arm: time, "
                "q1…qN, dq1…dqN, cmd1…cmdN. Describe them with --map MAP.yaml"
            )
        arrays = {
            field: np.column_stack(values[1 + k * joints : 1 + (k + 1) * joints])
            for k, field in enumerate([*_FIELDS.values()][:parts])
        }
    counts = {field: values.shape[1] for field, values in arrays.items()}
    if len({*counts.values()}) != 1 or "position" not in counts:
        listed = ", ".join(f"{field} {count}" for field, count in counts.items())
        raise InputError(f"{path}: the columns are not of the same joints: {listed}")
    time = next(iter(columns.values()))
    episode = Episode(path.stem, time, **arrays)
    return Recorded(path, (), (episode,), sha256=sha256_file(path), notes=table.notes)


def _numbered(columns: dict[str, np.ndarray], start: str) -> list[np.ndarray]:
    """Columns whose names begin so, in the order of their numbers."""
    numbered = {
        int(hit[2]): values for name, values in columns.items() if (hit := _NAME.match(name)) and hit[1] == start
    }
    return [numbered[number] for number in sorted(numbered)]
