"""Whatever holds motions: a log, a bag, or a dataset of many episodes; and datasets that become logs."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

from agent.core import InputError, counted
from agent.recording.datasets import dataset_logs, is_dataset, open_dataset
from agent.recording.log import Log
from agent.recording.mcap.log_file import write_log
from agent.recording.mcap.topics import is_nameless, logged_joints
from agent.recording.reading import read_log
from agent.robot import RobotDescription


def read_recording(path: Path, robot: RobotDescription, topic: str | None = None) -> tuple[list[Log], tuple[str, ...]]:
    """The logs of a file or folder, one for each episode, and what there is to say about all of them.

    Args:
        path: file or folder.
        robot: description of the arm.
        topic: of the joint states; of a dataset of two arms, `left` or `right`.

    Raises:
        InputError: it cannot be read as a recording of this robot.
    """
    return dataset_logs(path, robot, topic) if is_dataset(path) else ([read_log(path, robot, topic)], ())


def recorded_joints(path: Path, topic: str | None = None) -> tuple[str, ...] | int:
    """Names of the joints in a recording; how many there are where it names none.

    Raises:
        InputError: it cannot be read.
    """
    if not is_dataset(path):
        names = logged_joints(path, topic)
        return len(names) if is_nameless(names) else names
    recorded = open_dataset(path, topic)
    return recorded.joints or recorded.columns


def import_dataset(
    robot: RobotDescription, path: Path, out: Path, topic: str | None = None, preset: str | None = None
) -> tuple[str, ...]:
    """Write a log for each episode of a dataset. All logs are written, or none.

    Args:
        robot: description of the arm.
        path: of the dataset.
        out: folder of the logs; of a single episode also a file `.mcap`.
        topic: as of `read_recording`.
        preset: name of the format, where the path does not show it.

    Raises:
        InputError: the dataset cannot be read, or `out` is a file where a folder is needed.
        RecordingError: a log cannot be written.
    """
    logs, notes = dataset_logs(path, robot, topic, preset)
    if out.suffix == ".mcap":
        if len(logs) > 1:
            raise InputError(f"{path}: holds {counted(len(logs), 'episode')}: name a folder for their logs, not {out}")
        write_log(out, logs[0])
    else:
        with TemporaryDirectory(dir=out.absolute().parent, prefix=f".{out.name}.") as unfinished:
            whole = Path(unfinished) / out.name
            whole.mkdir()
            for log in logs:
                write_log(whole / f"{log.path.stem}.mcap", log)
            os.rename(whole, out)
    repairs = [f"{log.name}: {repair}" for log in logs for repair in log.repairs]
    frames = sum(len(log.t) for log in logs)
    return (*notes, *repairs, f"{counted(len(logs), 'log')}, {frames} samples")
