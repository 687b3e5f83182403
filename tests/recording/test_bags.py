"""Bags of ROS 2, as `ros2 bag record` leaves them: a folder of MCAP files, and sqlite3."""

import gzip
import sqlite3
import sys
import tracemalloc
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

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
    assert log.repairs == ()
    messages = _messages(slice(0, 250))
    messages[100]["position"] = [np.nan] * 3
    write_foreign(folder / "bag_0.mcap", messages)
    assert [repair.kind for repair in read_log(folder).repairs] == [
        "samples without a finite position, dropped",
        "missing samples, short enough to interpolate",
    ]


def test_reads_a_database_by_file_or_folder(whole: Path, tmp_path: Path):
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


def _packed(data: bytes, _: int = 0) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


def test_reads_messages_compressed_one_by_one(whole: Path, tmp_path: Path):
    expected = read_log(whole)
    with sqlite3.connect(tmp_path / "a.db3") as bag:
        _database(tmp_path / "a.db3", whole)
        for number, data in bag.execute("SELECT id, data FROM messages").fetchall():
            bag.execute("UPDATE messages SET data = ? WHERE id = ?", (_packed(data), number))
    bag.close()
    with open(whole, "rb") as file:
        data = [message.data for _, channel, message in make_reader(file).iter_messages() if channel.topic != "/odd"]
    messages = [{**message, "data": _packed(one)} for message, one in zip(_messages(slice(None)), data, strict=True)]
    mixed = [
        packed if k % 3 else {**packed, "data": one} for k, (packed, one) in enumerate(zip(messages, data, strict=True))
    ]
    for path in (
        tmp_path / "a.db3",
        write_foreign(tmp_path / "b.mcap", messages),
        write_foreign(tmp_path / "c.mcap", mixed),
    ):
        log = read_log(path)
        np.testing.assert_array_equal(log.t, expected.t)
        np.testing.assert_array_equal(log.position, expected.position)
        np.testing.assert_array_equal(log.effort, expected.effort)


def test_a_message_is_limited_in_memory(tmp_path: Path):
    bomb = _packed(bytes(200 * 2**20))
    path = write_foreign(tmp_path / "bomb.mcap", [{"time": 1.0 + k, "data": bomb} for k in range(3)])
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="3 messages on /joint_states"):
            read_log(path)
        assert tracemalloc.get_traced_memory()[1] < 50 * 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("ending", "pack"), [("zstd", _packed), ("gz", gzip.compress), ("lz4", lz4.frame.compress)])
@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_reads_files_compressed_as_a_whole(whole: Path, tmp_path: Path, ending, pack, kind):
    expected = read_log(whole)
    _database(tmp_path / "whole.db3", whole)
    folder = tmp_path / "bag"
    folder.mkdir()
    file = folder / f"bag_0.{kind}.{ending}"
    file.write_bytes(pack((tmp_path / f"whole.{kind}").read_bytes()))
    for path in (file, _describe(folder, file.name)):
        log = read_log(path)
        np.testing.assert_array_equal(log.t, expected.t)
        np.testing.assert_array_equal(log.effort, expected.effort)


def test_recovers_a_truncated_compressed_file(whole: Path, tmp_path: Path):
    plain = write_foreign(tmp_path / "plain.mcap", _messages(slice(None)), compression=CompressionType.NONE)
    stream, packed = zstandard.ZstdCompressor().compressobj(), b""
    for part in np.array_split(np.frombuffer(plain.read_bytes(), np.uint8), 20):
        packed += stream.compress(part.tobytes()) + stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    (tmp_path / "cut.mcap.zstd").write_bytes(packed[: len(packed) * 3 // 4])
    log = read_log(tmp_path / "cut.mcap.zstd")
    assert 50 < len(log.t) < len(read_log(whole).t)
    assert any("not closed by its writer" in repair.kind for repair in log.repairs)


def test_refuses_a_decompression_bomb(tmp_path: Path):
    (tmp_path / "bomb.mcap.zstd").write_bytes(_packed(b"\x89MCAP0\r\n" + bytes(400 * 2**20)))
    with pytest.raises(InputError, match="500 times its size"):
        read_log(tmp_path / "bomb.mcap.zstd")


def test_finds_a_file_named_with_or_without_its_compression_suffix(whole: Path, tmp_path: Path):
    for there, named in (("a_0.mcap.zstd", "a_0.mcap"), ("b_0.mcap", "b_0.mcap.zstd")):
        folder = tmp_path / there
        folder.mkdir()
        (folder / there).write_bytes(_packed(whole.read_bytes()) if there.endswith("zstd") else whole.read_bytes())
        np.testing.assert_array_equal(read_log(_describe(folder, named)).t, read_log(whole).t)


def test_a_folder_without_description_is_a_bag_by_the_names_of_its_files(tmp_path: Path, whole: Path):
    for name, part in (("drive_0", slice(0, 150)), ("drive_1", slice(150, 300)), ("drive_10", slice(300, None))):
        (tmp_path / "killed").mkdir(exist_ok=True)
        write_foreign(tmp_path / "killed" / f"{name}.mcap", _messages(part))
    np.testing.assert_array_equal(read_log(tmp_path / "killed").t, read_log(whole).t)
    write_foreign(tmp_path / "killed" / "other_0.mcap", _messages(slice(None)))
    with pytest.raises(InputError, match=r"folder without metadata\.yaml"):
        read_log(tmp_path / "killed")


@pytest.mark.parametrize("share", [0.95, 0.6, 0.3])
def test_recovers_a_truncated_database(whole: Path, tmp_path: Path, share):
    _database(tmp_path / "whole.db3", whole)
    data = (tmp_path / "whole.db3").read_bytes()
    (tmp_path / "cut.db3").write_bytes(data[: int(share * len(data))])
    log, expected = read_log(tmp_path / "cut.db3"), read_log(whole)
    assert 0.5 * share < len(log.t) / len(expected.t) < 1
    rows = np.searchsorted(expected.t, log.t - 1e-6)
    np.testing.assert_array_equal(log.position, expected.position[rows])
    assert any("not closed by its writer" in repair.kind for repair in log.repairs)


def _ros1(path: Path) -> Path:
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="reading ROS 1 is an extra: pip install '.[ros1]'")
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    state, header, stamp = (
        types.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with rosbag1.Writer(path) as writer:
        topic = writer.add_connection("/arm/joint_states", state.__msgtype__, typestore=types)
        for k, message in enumerate(_messages(slice(None))):
            ns = round(message["time"] * 1e9)
            arrays = [np.array(message[field]) for field in ("position", "velocity", "effort")]
            body = state(header(k, stamp(ns // 10**9, ns % 10**9), "base"), list(message["names"]), *arrays)
            writer.write(topic, ns, types.serialize_ros1(body, state.__msgtype__))
    return path


def test_reads_a_ros_1_bag(whole: Path, tmp_path: Path):
    log, expected = read_log(_ros1(tmp_path / "old.bag")), read_log(whole)
    assert log.joint_names == JOINTS
    np.testing.assert_allclose(log.t, expected.t, atol=1e-9)
    np.testing.assert_array_equal(log.position, expected.position)
    np.testing.assert_array_equal(log.effort, expected.effort)
    (tmp_path / "cut.bag").write_bytes((tmp_path / "old.bag").read_bytes()[:9000])
    with pytest.raises(InputError, match=r"rosbag reindex cut\.bag"):
        read_log(tmp_path / "cut.bag")


def test_reads_ros_1_messages_in_an_mcap_file(whole: Path, tmp_path: Path):
    """As `mcap convert` makes it of a ROS 1 bag."""
    rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="reading ROS 1 is an extra: pip install '.[ros1]'")
    with rosbag1.Reader(_ros1(tmp_path / "old.bag")) as bag, open(tmp_path / "converted.mcap", "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="mcap go")
        schema = writer.register_schema("sensor_msgs/JointState", "ros1msg", b"")
        channel = writer.register_channel("/joint_states", "ros1", schema)
        for _, stamp, raw in bag.messages():
            writer.add_message(channel, stamp, bytes(raw), stamp)
        writer.finish()
    log, expected = read_log(tmp_path / "converted.mcap"), read_log(whole)
    assert log.joint_names == JOINTS
    np.testing.assert_array_equal(log.velocity, expected.velocity)


def test_without_the_library_a_bag_of_ros_1_is_named_with_what_converts_it(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    (tmp_path / "run.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(4096))
    with pytest.raises(
        InputError, match=r"ROS 1 bag: convert it with rosbags-convert --src run.bag --dst run; .*\[ros1\]"
    ):
        read_log(tmp_path / "run.bag")


def test_reports_what_is_wrong_with_an_invalid_bag(tmp_path: Path):
    with pytest.raises(InputError, match=r"folder without metadata\.yaml"):
        read_log(tmp_path)
    with pytest.raises(InputError, match="is missing, although"):
        read_log(_describe(tmp_path, "bag_0.mcap"))
    (tmp_path / "bad.db3").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not an MCAP file; a log is an MCAP file or a bag of ROS"):
        read_log(tmp_path / "bad.db3")
    (tmp_path / "bad.db3").write_bytes(b"SQLite format 3\0nothing")
    with pytest.raises(InputError, match="no sqlite3 bag"):
        read_log(tmp_path / "bad.db3")
    (tmp_path / "pointer.mcap").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    with pytest.raises(InputError, match="git lfs pull"):
        read_log(tmp_path / "pointer.mcap")
    (tmp_path / "metadata.yaml").write_text("other: 1\n", encoding="utf-8")
    with pytest.raises(InputError, match="names no files"):
        read_log(tmp_path)
