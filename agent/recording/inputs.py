"""Whatever holds motions: a log, a bag, or a dataset of many episodes."""

from __future__ import annotations

from pathlib import Path

from agent.recording.datasets import dataset_logs, is_dataset, open_dataset
from agent.recording.log import Log
from agent.recording.mcap.topics import logged_joints
from agent.recording.reading import read_log
from agent.robot import RobotDescription


def read_recording(path: Path, robot: RobotDescription, topic: str | None = None) -> tuple[list[Log], tuple[str, ...]]:
    """The logs of a file or folder, one for each episode, and what there is to say about all of them.

    `topic` is that of the joint states; of a dataset of two arms, `left` or `right`.

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
        return logged_joints(path, topic)
    recorded = open_dataset(path, topic)
    return recorded.joints or recorded.columns
