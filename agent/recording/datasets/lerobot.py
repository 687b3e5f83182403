"""LeRobot datasets, versions 2 and 3: a folder with `meta/info.json` and Parquet files of frames.

Version 2 has a file an episode, version 3 many episodes in a file; in both, each row holds its `episode_index` and
`frame_index`. `timestamp` is frame_index / fps [lerobot datasets/dataset_writer.py], so it says nothing about the
clock. The state of a frame is read before its action is sent, which the servos hold until the next.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, comma_list, counted, read_json, sha256_file, sha256_text
from agent.recording.datasets.episodes import FRAME_NUMBER, HELD, HOLD, STAMPS, UNITS, Episode, Recorded
from agent.recording.datasets.joints import clean, flat_names, poses, quantity_of
from agent.recording.datasets.units import in_radians
from agent.recording.tables.table_files import read_table
from agent.recording.tables.text_tables import ColumnTable

INFO = "meta/info.json"
_STATE, _ACTION = "observation.state", "action"
#: First bytes of a file that Git LFS has not fetched.
_POINTER = b"version https://git-lfs"
_MOST_FPS = 1e5
#: Names that a message lists.
_LISTED = 8


def is_lerobot(path: Path) -> bool:
    """Whether a folder is a LeRobot dataset."""
    return path.is_dir() and (path / INFO).is_file()


def read_lerobot(path: Path) -> Recorded:
    """All episodes of a dataset, in rad.

    Raises:
        InputError: a file is missing or damaged, it holds no joint positions, its actions are no set-points of them, or
            the unit cannot be told.
    """
    info = read_json(path / INFO)
    features = info.get("features") if isinstance(info, dict) else None
    fps = info.get("fps") if isinstance(info, dict) else None
    if not isinstance(features, dict) or not isinstance(fps, int | float) or not 0 < fps < _MOST_FPS:
        raise InputError(f"{path / INFO}: names no features or no fps, so it describes no LeRobot dataset")
    states, actions = (_names(features, feature) for feature in (_STATE, _ACTION))
    joints = _joints(path, states)
    columns = {
        _STATE: ([states.index(name) for name in joints], len(states)),
        _ACTION: (_set_points(path, joints, actions), len(actions)),
    }
    files = sorted((path / "data").rglob("*.parquet"))
    if not files:
        raise InputError(f"{path}: no Parquet files in {path / 'data'}; fetch the whole dataset, not only meta")
    parts: dict[int, list[_Frames]] = {}
    for file in files:
        for number, frames in _episodes_in(file, columns):
            parts.setdefault(number, []).append(frames)
    whole = {number: _joined(frames) for number, frames in sorted(parts.items())}
    notes = [f"{counted(len(whole), 'episode')} at {fps:g} Hz"]
    if isinstance(total := info.get("total_episodes"), int) and total > len(whole):
        notes[0] += f" of {total}; the files of the others are missing"
    if actions and columns[_ACTION][0] is None:
        notes.append("no action of the set is a joint's set-point")
    episodes, off = zip(*(_episode(number, frames, fps) for number, frames in whole.items()), strict=True)
    by_clock = max(off) > 0.5 / fps
    if by_clock:
        notes.append(
            f"timestamps differ from frame_index at {fps:g} Hz by up to {max(off):.3g} s: the timestamps count"
        )
    recorded = Recorded(
        path=path,
        joints=tuple(map(clean, joints)),
        episodes=episodes,
        unit="",
        rate=None if by_clock else float(fps),
        facts={} if by_clock else {STAMPS: FRAME_NUMBER},
        sha256=sha256_text("".join(map(sha256_file, files))),
        notes=tuple(notes),
    )
    converted = in_radians(recorded, str(info.get("robot_type")))
    bus_servos = not converted.facts[UNITS].startswith("rad")  # then LeRobot's own loop sent the commands
    return replace(converted, facts=converted.facts | ({HOLD: HELD} if bus_servos else {}))


@dataclass(frozen=True, eq=False)
class _Frames:
    """Rows of one episode: number and timestamp of the frame (K,), the latter in any unit or NaN, position and command
    (K, n)."""

    number: np.ndarray
    stamp: np.ndarray
    position: np.ndarray
    command: np.ndarray | None


def _names(features: dict[str, Any], feature: str) -> list[str]:
    """Names of the columns of a feature; empty where it is missing or has none."""
    about = features.get(feature)
    return flat_names(about.get("names")) if isinstance(about, dict) else []


def _joints(path: Path, states: list[str]) -> list[str]:
    """Columns of the state that are positions of joints, as `info.json` names them."""
    joints = [name for name in states if quantity_of(name) == "position"]
    listed = comma_list(states, _LISTED) or "none"
    if not joints or poses(joints):
        raise InputError(
            f"{path / INFO}: the names of {_STATE} are no joints: {listed}. Joint positions with their names are "
            "needed; if the columns hold them, name the columns in a map: agent import --map"
        )
    cleaned = [clean(name) for name in joints]
    if len(set(cleaned)) < len(cleaned):
        raise InputError(f"{path / INFO}: {_STATE} names a joint twice: {listed}")
    return joints


def _set_points(path: Path, joints: list[str], actions: list[str]) -> list[int] | None:
    """Column of each joint's set-point; None where there are no actions.

    Raises:
        InputError: actions of a hand, or of other joints.
    """
    if not actions:
        return None
    if ends := poses(actions):
        raise InputError(
            f"{path}: the actions are of the end effector ({comma_list(ends, _LISTED)}), not set-points of the joints. "
            "Without set-points no servo can be identified: record the joint targets that the robot was sent"
        )
    named = [clean(name) for name in actions if quantity_of(name) == "position"]
    if missing := [name for name in map(clean, joints) if name not in named]:
        raise InputError(
            f"{path}: states and actions are of different joints: {comma_list(missing, _LISTED)} has no set-point; the "
            f"actions are {comma_list(actions, _LISTED)}. Record leader and follower of one arm"
        )
    columns = {clean(name): k for k, name in enumerate(actions) if quantity_of(name) == "position"}
    return [columns[clean(name)] for name in joints]


def _episodes_in(file: Path, columns: dict[str, tuple[list[int] | None, int]]) -> Iterator[tuple[int, _Frames]]:
    """Numbers and frames of the episodes in a Parquet file, of `columns`: which of a feature, and how many it names."""
    with open(file, "rb") as start:
        if start.read(len(_POINTER)) == _POINTER:
            raise InputError(f"{file}: a pointer of Git LFS, not the file itself: git lfs pull")
    table = read_table(file)
    episode, number = (_column(file, table, name) for name in ("episode_index", "frame_index"))
    stamp = table.column("timestamp")
    if stamp is None or len(stamp) != len(episode):
        stamp = np.full(len(episode), np.nan)
    position, command = (_matrix(file, table, feature, *columns[feature], len(episode)) for feature in columns)
    assert position is not None
    for index in np.unique(episode):
        rows = episode == index
        yield int(index), _Frames(number[rows], stamp[rows], position[rows], None if command is None else command[rows])


def _column(file: Path, table: ColumnTable, name: str) -> np.ndarray:
    column = table.column(name)
    if column is None and name in table.constants:  # a file with one row
        return np.array([table.constants[name]])
    if column is None or not np.all(np.isfinite(column)):
        raise InputError(f"{file}: no numbers in the column {name}, by which LeRobot tells episodes and frames")
    return column


def _matrix(
    file: Path, table: ColumnTable, name: str, columns: list[int] | None, named: int, rows: int
) -> np.ndarray | None:
    """(K, n) some columns of a feature whose columns have as many names; None for none."""
    if columns is None:
        return None
    names = table.matrix(name) or ([name] if name in table.columns else [])
    arrays = [table.columns[title] for title in names]
    if arrays and len(arrays[0]) != rows and len(arrays) == rows:  # an episode with fewer frames than joints
        arrays = [*np.stack(arrays).T]
    if rows == 1 and name in table.constants:
        arrays = [np.array([table.constants[name]])]
    if len(arrays) != named or any(len(column) != rows for column in arrays):
        raise InputError(f"{file}: {name} has {counted(len(arrays), 'column')} of numbers, and {INFO} names {named}")
    return np.stack([arrays[k] for k in columns], axis=1)


def _joined(parts: list[_Frames]) -> _Frames:
    """Frames of one episode in the order of their numbers."""
    number = np.concatenate([part.number for part in parts])
    order = np.argsort(number, kind="stable")
    commands = [part.command for part in parts if part.command is not None]
    position = np.concatenate([part.position for part in parts])
    stamp = np.concatenate([part.stamp for part in parts])
    return _Frames(number[order], stamp[order], position[order], np.concatenate(commands)[order] if commands else None)


def _episode(number: int, frames: _Frames, fps: float) -> tuple[Episode, float]:
    """An episode, and by how much its timestamps were off the frame numbers [s]; where they are off by more than half a
    frame, a clock made them."""
    time, stamp = frames.number / fps, _in_seconds(frames.stamp, fps)
    off = 0.0
    if stamp is not None:
        stamp = stamp - stamp[0] + time[0]
        off = float(np.max(np.abs(stamp - time)))
        if off > 0.5 / fps:
            time = stamp
    return Episode(f"episode_{number:06d}", time, frames.position, frames.command), off


def _in_seconds(stamp: np.ndarray, fps: float) -> np.ndarray | None:
    """Rising timestamps in s, ms, µs or ns, whichever is nearest to the rate; None where they do not rise."""
    steps = np.diff(stamp)
    if not len(steps) or not np.all(steps > 0):
        return None
    return np.asarray(stamp / 1000.0 ** np.clip(np.rint(np.log10(np.median(steps) * fps) / 3), 0, 3))
