"""Bags of ROS 2, as `ros2 bag record` leaves them: a folder of MCAP files, and sqlite3."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from agent.core.errors import InputError
from agent.recording import read_log
from tests.recording.conftest import JOINTS, make_motion, write_foreign

_TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
"""


def _messages(part: slice):
    motion = make_motion(400)
    return [
        {
            "time": float(motion.time[k]),
            "names": JOINTS,
            "position": motion.position[k].tolist(),
            "velocity": motion.velocity[k].tolist(),
            "effort": motion.torque[k].tolist(),
        }
        for k in range(400)[part]
    ]


def _describe(folder: Path, *names: str) -> Path:
    lines = "\n".join(f"    - {name}" for name in names)
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{lines}\n", "utf-8")
    return folder


def _database(path: Path, mcap: Path) -> None:
    """The same messages as sqlite3 rows."""
    with sqlite3.connect(path) as bag, open(mcap, "rb") as file:
        bag.executescript(_TABLES)
        bag.execute("INSERT INTO topics VALUES (1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr', '')")
        bag.execute("INSERT INTO topics VALUES (2, '/odd', 'odd/msg/Odd', 'cdr', '')")
        bag.execute("INSERT INTO messages VALUES (NULL, 2, 5, ?)", (b"\x00\x01\x00\x00\x01",))
        for _, _, message in make_reader(file).iter_messages():
            bag.execute("INSERT INTO messages VALUES (NULL, 1, ?, ?)", (message.log_time, message.data))
    bag.close()


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    """The motion in one file."""
    return write_foreign(tmp_path / "whole.mcap", _messages(slice(None)))


def test_a_folder_of_two_files_is_one_log(whole: Path, tmp_path: Path):
    folder = tmp_path / "bag"
    folder.mkdir()
    write_foreign(folder / "bag_0.mcap", _messages(slice(0, 250)))
    write_foreign(folder / "bag_1.mcap", _messages(slice(250, None)))
    log, expected = read_log(_describe(folder, "bag/bag_0.mcap", "bag_1.mcap")), read_log(whole)
    assert log.name == "bag"
    np.testing.assert_array_equal(log.t, expected.t)
    np.testing.assert_array_equal(log.effort, expected.effort)


def test_a_database_is_a_log_alone_and_in_its_folder(whole: Path, tmp_path: Path):
    expected = read_log(whole)
    folder = tmp_path / "bag"
    folder.mkdir()
    _database(folder / "bag_0.db3", whole)
    for log in (read_log(folder / "bag_0.db3"), read_log(_describe(folder, "bag_0.db3"))):
        assert log.joint_names == JOINTS
        np.testing.assert_array_equal(log.t, expected.t)
        np.testing.assert_array_equal(log.position, expected.position)
        np.testing.assert_array_equal(log.velocity, expected.velocity)


def test_a_topic_that_was_never_published_is_named(whole: Path, tmp_path: Path):
    _database(tmp_path / "bag_0.db3", whole)
    with sqlite3.connect(tmp_path / "bag_0.db3") as bag:
        bag.execute("DELETE FROM messages WHERE topic_id = 1")
    bag.close()
    with pytest.raises(InputError, match="the topic /joint_states is in it without a single message"):
        read_log(tmp_path / "bag_0.db3")


def test_what_is_no_bag_is_told(tmp_path: Path):
    with pytest.raises(InputError, match=r"folder without metadata\.yaml"):
        read_log(tmp_path)
    with pytest.raises(InputError, match="is missing, although"):
        read_log(_describe(tmp_path, "bag_0.mcap"))
    with pytest.raises(InputError, match="unpack it first"):
        read_log(_describe(tmp_path, "bag_0.db3.zstd"))
    (tmp_path / "bad.db3").write_bytes(b"nothing")
    with pytest.raises(InputError, match="no sqlite3 bag"):
        read_log(tmp_path / "bad.db3")
    (tmp_path / "metadata.yaml").write_text("other: 1\n", encoding="utf-8")
    with pytest.raises(InputError, match="names no files"):
        read_log(tmp_path)
