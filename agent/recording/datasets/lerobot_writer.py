"""Writes joint targets as a LeRobot dataset, version 3.0, which `lerobot-replay` sends to an arm.

Degrees, as LeRobot's arms take them with `use_degrees`; a gripper in percent of its range. There are no observations.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import needed, write_atomically
from agent.robot import is_gripper

_CHUNK = "chunk-000/file-000.parquet"
_NUMBERS = {
    "timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64", "task_index": "int64"
}  # fmt: skip


def write_targets(
    folder: Path,
    joints: Sequence[str],
    episodes: Sequence[np.ndarray],
    fps: int,
    ranges: np.ndarray,
    task: str,
) -> None:
    """Write one episode for each array of set-points.

    Parameters
    ----------
    folder : Path
        Folder of the dataset; it is made.
    joints : sequence of str
        Names of n joints.
    episodes : sequence of ndarray, shape (S, n)
        Set-points [rad or m], one row for each frame.
    fps : int
        Frames a second.
    ranges : ndarray, shape (n, 2)
        Least and largest position of each joint [rad or m]: 0 and 100 of a gripper.
    task : str
        What the episodes are for.

    Raises:
        InputError: pyarrow is not installed.
        OSError: the folder cannot be written.
    """
    arrow, parquet = needed("pyarrow", "a LeRobot dataset", "tables"), needed("pyarrow.parquet", "it", "tables")
    targets = [_in_their_units(joints, rows, ranges).astype(np.float32) for rows in episodes]
    lengths = [len(rows) for rows in targets]
    ends = np.cumsum(lengths)
    frame = np.concatenate([np.arange(length) for length in lengths])
    columns: dict[str, Any] = {
        "action": arrow.FixedSizeListArray.from_arrays(np.concatenate(targets).ravel(), len(joints)),
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(ends[-1]),
        "task_index": np.zeros(ends[-1], dtype=np.int64),
    }
    about = {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[task]] * len(lengths),
        "length": lengths,
        "data/chunk_index": [0] * len(lengths),
        "data/file_index": [0] * len(lengths),
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        "meta/episodes/chunk_index": [0] * len(lengths),
        "meta/episodes/file_index": [0] * len(lengths),
    }
    index = "__index_level_0__"
    tasks = arrow.table({"task_index": np.zeros(1, dtype=np.int64), index: [task]})
    of_pandas = {"index_columns": [index], "columns": [], "column_indexes": [], "pandas_version": "2.0.0"}
    tables = {
        f"data/{_CHUNK}": arrow.table(columns),
        f"meta/episodes/{_CHUNK}": arrow.table(about),
        "meta/tasks.parquet": tasks.replace_schema_metadata({"pandas": json.dumps(of_pandas)}),
    }
    for name, table in tables.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, folder / name)
    info = _info([f"{name}.pos" for name in joints], len(lengths), int(ends[-1]), fps)
    write_atomically(folder / "meta/info.json", json.dumps(info, indent=1))


def _in_their_units(joints: Sequence[str], rows: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    converted = np.degrees(rows)
    for j, name in enumerate(joints):
        if is_gripper(name):
            converted[:, j] = 100 * (rows[:, j] - ranges[j, 0]) / (ranges[j, 1] - ranges[j, 0])
    return converted


def _info(names: list[str], episodes: int, frames: int, fps: int) -> dict[str, Any]:
    numbers = {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _NUMBERS.items()}
    return {
        "codebase_version": "v3.0",
        "robot_type": "unknown",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": {"action": {"dtype": "float32", "shape": [len(names)], "names": names}, **numbers},
    }
