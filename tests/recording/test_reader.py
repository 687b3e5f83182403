"""Any conforming log is read, whoever wrote it; what cannot be used is refused with a reason."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from mcap.writer import CompressionType, IndexType

from agent.core.errors import InputError
from agent.recording import read_log
from agent.robot import Joint, RobotDescription, load_robot


def robot_with(*names: str) -> RobotDescription:
    joints = tuple(Joint(name, False, 1.0, None, 1.0, 1.0, None, None, None, None, -3.0, 3.0) for name in names)
    coupling = tuple(tuple(float(i == j) for j in range(len(names))) for i in range(len(names)))
    return RobotDescription("arm", "", "tip", (0.0, 0.0, -9.81), None, joints, coupling)


def kinds(log) -> dict[str, int]:
    """Repairs by the beginning of their text."""
    return {repair.kind.split(",")[0]: repair.count for repair in log.repairs}


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"use_chunking": False},
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_statistics": False},
        {"chunk_size": 500},
    ],
    ids=["zstd", "lz4", "plain", "no crc", "unchunked", "no index", "no summary", "tiny chunks"],
)
def test_reads_every_container_format(tools, tmp_path, options):
    block = tools.motion(500)
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", tools.as_messages(block), **options))
    np.testing.assert_array_equal(log.position, block.position)
    np.testing.assert_array_equal(log.velocity, block.velocity)
    np.testing.assert_array_equal(log.effort, block.torque)
    np.testing.assert_allclose(log.t, block.time - 100.0, atol=1e-9)
    assert log.sample_rate == pytest.approx(500.0)
    assert log.repairs == ()


def test_joints_are_in_the_order_of_the_robot(tools, tmp_path):
    block = tools.motion(50)
    names = ("gripper", "joint_3", "joint_1", "joint_2")
    messages = [
        {
            **m,
            "names": names,
            **{key: (9.0, m[key][2], m[key][0], m[key][1]) for key in ("position", "velocity", "effort")},
        }
        for m in tools.as_messages(block)
    ]
    path = tools.write_foreign(tmp_path / "log.mcap", messages)
    log = read_log(path, robot_with("joint_1", "joint_2", "joint_3"))
    assert log.joint_names == ("joint_1", "joint_2", "joint_3")
    np.testing.assert_array_equal(log.position, block.position)
    np.testing.assert_array_equal(log.effort, block.torque)
    assert read_log(path).joint_names == names


def test_counts_messages_of_other_joints_and_skips_unknown_types(tools, tmp_path):
    block = tools.motion(200)
    gripper = [{"time": t + 1e-4, "names": ["finger"], "position": [0.1]} for t in block.time[::4]]
    temperatures = [{"time": t, "topic": "/temperatures", "names": ["x"], "position": [40.0]} for t in block.time]
    messages = sorted(tools.as_messages(block) + gripper + temperatures, key=lambda m: m["time"])
    path = tools.write_foreign(tmp_path / "log.mcap", messages, strangers=[b"?", b"", b"x" * 300])
    for log in (read_log(path), read_log(path, robot_with(*tools.JOINTS))):
        np.testing.assert_array_equal(log.position, block.position)
        assert kinds(log) == {"messages of other joints": 50}


def test_a_topic_below_a_namespace(tools, tmp_path):
    block = tools.motion(50)
    states = tools.as_messages(block, topic="/cell_3/joint_states")
    references = [
        {"time": t, "position": q, "topic": "/cell_3/joint_references"}
        for t, q in zip(block.time, block.position, strict=True)
    ]
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", states + references))
    np.testing.assert_array_equal(log.position, block.position)
    np.testing.assert_array_equal(log.reference_position, block.position)


def test_big_endian_messages(tools, tmp_path):
    stamps, position = np.arange(40) / 100.0, np.arange(40) * 0.5
    messages = []
    for t, q in zip(stamps, position, strict=True):
        head = struct.pack(">iII", int(t), round((t % 1) * 1e9), 1) + b"\0" + bytes(3)
        body = struct.pack(">II", 1, 2) + b"a\0" + bytes(2) + struct.pack(">I", 1)
        body += bytes(-len(head + body) % 8) + struct.pack(">d", q) + struct.pack(">II", 0, 0)
        messages.append({"time": t, "data": b"\x00\x00\x00\x00" + head + body})
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages))
    np.testing.assert_array_equal(log.position[:, 0], position)
    assert log.velocity is None


def test_padding_bytes_are_ignored(tools, tmp_path):
    """Some serialisers leave whatever was in memory where alignment skips bytes."""
    plain = tools.write_foreign(tmp_path / "plain.mcap", tools.as_messages(tools.motion(30), names=("a", "bb", "ccc")))
    from mcap.reader import make_reader

    with open(plain, "rb") as file:
        data = [bytearray(m.data) for _, _, m in make_reader(file).iter_messages()]
    for k, message in enumerate(data):
        message[3] = k  # options of the encapsulation
        message[12 + 4 + 6 : 12 + 4 + 8] = bytes([k, 255 - k])  # after "world\0"
    messages = [{"time": 100 + k / 500, "data": bytes(m)} for k, m in enumerate(data)]
    log = read_log(tools.write_foreign(tmp_path / "dirty.mcap", messages))
    np.testing.assert_array_equal(log.position, tools.motion(30).position)


def test_reads_logs_without_velocity_or_effort(tools, tmp_path):
    block = tools.motion(50)
    for missing in ("velocity", "effort"):
        messages = tools.as_messages(block, **{missing: ()})
        log = read_log(tools.write_foreign(tmp_path / f"{missing}.mcap", messages))
        assert getattr(log, missing) is None
        assert log.repairs == ()
        nothing = tools.as_messages(block, **{missing: (np.nan,) * 3})
        log = read_log(tools.write_foreign(tmp_path / f"{missing}_nan.mcap", nothing))
        assert getattr(log, missing) is None
        assert kinds(log) == {f"samples without a finite {missing}": 50}


def test_a_velocity_that_is_always_zero_is_ignored(tools, tmp_path):
    block = tools.motion(50)
    messages = tools.as_messages(block, velocity=(0.0,) * 3)
    log = read_log(tools.write_foreign(tmp_path / "silent.mcap", messages))
    assert log.velocity is None
    assert kinds(log) == {"samples with a velocity of zero though the arm moves": 50}
    still = tools.as_messages(block, velocity=(0.0,) * 3, position=tuple(block.position[0]))
    log = read_log(tools.write_foreign(tmp_path / "still.mcap", still))
    assert not log.velocity.any()
    assert log.repairs == ()


def test_broken_rows_are_dropped_and_counted(tools, tmp_path):
    block = tools.motion(100)
    messages = tools.as_messages(block)
    messages[97]["position"] = (0.0, np.nan, 0.0)
    messages[98]["effort"] = (0.0, 0.0)
    messages[99]["position"] = (1.0, 2.0)
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages))
    np.testing.assert_array_equal(log.position, block.position[:97])
    assert kinds(log) == {"samples without a finite position": 1, "samples with arrays of wrong length": 2}


def test_messages_that_cannot_be_decoded_are_counted(tools, tmp_path):
    messages = tools.as_messages(tools.motion(100))
    messages[50]["data"] = b"\x00\x01\x00\x00"
    messages[51]["data"] = b"\x00\x01\x00\x00" + bytes(12) + b"\xff\xff\xff\x7f"
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages))
    assert len(log.t) == 98
    assert kinds(log)["messages that cannot be decoded"] == 2


def test_set_points_are_matched_to_samples(tools, tmp_path):
    block = tools.motion(200)
    messages = tools.as_messages(block)
    for k in (*range(10, 60), 199):
        messages.append({"time": block.time[k] + 1e-5, "topic": "/joint_references", "position": block.position[k] + 1})
    for t in block.time:
        messages.append({"time": t + 1e-3, "topic": "/planned_joint_references", "position": (0, 0, 0)})
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages))
    known = np.isfinite(log.reference_position).all(axis=1)
    assert np.flatnonzero(known).tolist() == [*range(10, 60), 199]
    np.testing.assert_array_equal(log.reference_position[known], block.position[known] + 1)
    assert log.planned_position is None
    assert kinds(log) == {"/planned_joint_references: messages without a sample at their stamps": 200}


def test_reads_cycle_starts(tools, tmp_path):
    messages = tools.as_messages(tools.motion(500))
    messages[0]["position"] = (np.nan,) * 3
    run = {"robot": "arm", "sample_rate_hz": "500", "cycle_starts_s": "[0.002, 0.502]", "note": "x"}
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages, metadata=run))
    np.testing.assert_allclose(log.cycle_starts, (0.0, 0.5), atol=1e-9)  # from the first sample that is left
    assert log.metadata == run


@pytest.mark.parametrize("text", ["what", '[1, "x"]', "[0, -5]", "[0.5, 0.0]", "7", "[0, 99]", "null"])
def test_reports_unusable_cycle_starts(tools, tmp_path, text):
    messages = tools.as_messages(tools.motion(500))
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages, metadata={"cycle_starts_s": text}))
    assert any("cycle_starts_s" in kind for kind in kinds(log))
    assert all(0 <= start <= log.t[-1] for start in log.cycle_starts)


def test_reports_a_wrong_nominal_rate(tools, tmp_path):
    messages = tools.as_messages(tools.motion(500))
    log = read_log(tools.write_foreign(tmp_path / "log.mcap", messages, metadata={"sample_rate_hz": "1000"}))
    assert log.sample_rate == pytest.approx(500.0)
    assert any("stamps say 500 Hz" in kind for kind in kinds(log))


def test_refuses_files_that_are_not_logs(tools, tmp_path):
    empty = tmp_path / "empty.mcap"
    empty.touch()
    text = tmp_path / "text.mcap"
    text.write_text("time,position\n0,1\n")
    no_states = tools.write_foreign(tmp_path / "other.mcap", [{"time": 0, "topic": "/x", "position": (0, 0, 0)}])
    cases = {
        tmp_path / "missing.mcap": "no such file",
        empty: "the file is empty",
        text: "not an MCAP file",
        tmp_path: "folder without metadata",
        tools.write_foreign(tmp_path / "nothing.mcap", []): "no messages in it",
        no_states: r"no readable /joint_states.*it has .*/x: sensor_msgs/msg/JointState",
        tools.write_foreign(tmp_path / "one.mcap", tools.as_messages(tools.motion(1))): "1 sample",
    }
    for path, reason in cases.items():
        with pytest.raises(InputError, match=reason) as caught:
            read_log(path)
        assert str(path) in str(caught.value)


def test_refuses_a_log_of_another_robot(tools, tmp_path):
    path = tools.write_foreign(tmp_path / "log.mcap", tools.as_messages(tools.motion(50)))
    with pytest.raises(
        InputError, match=r"not of robot 'arm': wrist missing, its joints are joint_1, joint_2, joint_3"
    ):
        read_log(path, robot_with("joint_1", "wrist"))


def test_a_log_of_a_built_in_robot_has_its_joints(tools, tmp_path):
    robot = load_robot("comau_ns16")
    zeros = np.zeros(6)
    messages = [{"time": k / 500, "names": robot.joint_names, "position": zeros + k} for k in range(20)]
    assert read_log(tools.write_foreign(tmp_path / "log.mcap", messages), robot).joint_names == robot.joint_names


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_order_repetition_and_loss_leave_the_other_samples_unchanged(tools, tmp_path_factory, data):
    """Whatever subset of samples arrives, in whatever order and how often, they come back sorted and once."""
    block = tools.motion(120)
    kept = sorted(data.draw(st.sets(st.integers(0, 119), min_size=60)))
    again = data.draw(st.lists(st.sampled_from(kept), max_size=10))
    order = data.draw(st.permutations(kept + again))
    path = tmp_path_factory.mktemp("shuffled") / "log.mcap"
    messages = tools.as_messages(tools.cut(block, np.array(order)))
    log = read_log(tools.write_foreign(path, messages))
    np.testing.assert_array_equal(log.position, block.position[kept])
    np.testing.assert_array_equal(log.effort, block.torque[kept])
    found = kinds(log)
    assert found.get("repeated samples", 0) == len(again)
    assert ("stamps out of order" in found) == (np.diff(order) < 0).any()
    covered = [k for start, stop in log.segments for k in range(start, stop)]
    assert covered == list(range(len(kept)))
