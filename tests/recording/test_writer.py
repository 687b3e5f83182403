"""Logs as the writer leaves them, seen with other people's readers and with ours."""

import os
import signal
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader
from mcap.records import Chunk, Metadata
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from agent.core import Ended, signals_raised
from agent.core.errors import InputError
from agent.recording import Log, LogWriter, read_log, write_log
from agent.recording.mcap.joint_state import layout_for
from agent.recording.mcap.log_file import RecordingError

names = st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12), min_size=1, max_size=7)


@settings(max_examples=60, deadline=None)
@given(names, st.booleans(), st.booleans(), st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1), st.data())
def test_messages_are_what_the_support_library_writes(tools, names, velocity, effort, seconds, nanoseconds, data):
    from mcap_ros2._dynamic import serialize_dynamic

    numbers = hnp.arrays(float, (1, len(names)), elements=st.floats(width=64))
    arrays = [data.draw(numbers), data.draw(numbers) if velocity else None, data.draw(numbers) if effort else None]
    layout = layout_for(names, velocity, effort)
    ours = layout.filled(np.array([seconds * 10**9 + nanoseconds]), arrays)

    from agent.recording.mcap.joint_state import SCHEMA_NAME, SCHEMA_TEXT

    theirs = serialize_dynamic(SCHEMA_NAME, SCHEMA_TEXT)[SCHEMA_NAME](
        {
            "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""},
            "name": names,
            **{
                key: [] if array is None else array[0].tolist()
                for key, array in zip(("position", "velocity", "effort"), arrays, strict=True)
            },
        }
    )
    assert ours.tobytes() == theirs


def test_other_readers_find_the_documented_topics(tools, record):
    block = tools.motion(2000)
    path = record(block)
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert {c.topic: c.message_encoding for c in summary.channels.values()} == {
            "/joint_states": "cdr",
            "/joint_references": "cdr",
        }
        assert {(s.name, s.encoding) for s in summary.schemas.values()} == {("sensor_msgs/msg/JointState", "ros2msg")}
        assert summary.statistics.message_count == 4000
        assert len(summary.chunk_indexes) > 1
        assert all(c.compression == "zstd" and c.uncompressed_size <= 64 * 1024 for c in summary.chunk_indexes)
        runs = [record.metadata for record in reader.iter_metadata() if record.name == "run"]
        assert len(runs) == 1
        assert runs[0]["robot"] == "arm"
        assert runs[0]["motion"] == "test"
        assert float(runs[0]["sample_rate_hz"]) == 500.0
        messages = [
            (channel.topic, message, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False)
        ]
    states = [decoded for topic, _, decoded in messages if topic == "/joint_states"]
    np.testing.assert_array_equal([m.position for m in states], block.position)
    np.testing.assert_array_equal([m.velocity for m in states], block.velocity)
    np.testing.assert_array_equal([m.effort for m in states], block.torque)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in states]
    np.testing.assert_allclose(stamps, block.time, atol=1e-9)
    references = [decoded for topic, _, decoded in messages if topic == "/joint_references"]
    np.testing.assert_array_equal([m.position for m in references], block.reference_position)
    assert all(len(m.effort) == 0 for m in references)
    assert {message.log_time for _, message, _ in messages} == {int(block.received * 1e9)}


def test_the_message_index_leads_to_every_message(tools, record):
    path = record(tools.motion(700), tools.motion(700, first=700))
    with open(path, "rb") as file:
        stamps = [m.log_time for _, _, m in make_reader(file).iter_messages(topics=["/joint_states"])]
    assert len(stamps) == 1400
    assert stamps == sorted(stamps)


def test_a_recording_round_trips(tools, record):
    block = tools.motion(3000)
    log = read_log(record(*(tools.cut(block, slice(k, k + 7)) for k in range(0, 3000, 7))))
    assert log.joint_names == tools.JOINTS
    np.testing.assert_array_equal(log.position, block.position)
    np.testing.assert_array_equal(log.velocity, block.velocity)
    np.testing.assert_array_equal(log.effort, block.torque)
    np.testing.assert_array_equal(log.reference_position, block.reference_position)
    np.testing.assert_allclose(log.t, block.time - 100.0, atol=1e-9)
    assert log.stamp == 100.0
    assert log.sample_rate == 500.0
    assert log.segments == ((0, 3000),)
    assert log.repairs == ()
    assert log.planned_position is None
    assert log.cycle_starts == ()


def test_writes_planned_set_points_and_cycle_starts(tools, tmp_path):
    block = tools.motion(1000)
    planned = tools.cut(block, slice(200, 900))
    path = tmp_path / "log.mcap"
    with LogWriter(path, tools.JOINTS, robot="arm", motion="excitation", sample_rate=500.0) as writer:
        writer.write(block)
        writer.write_planned(planned.time, planned.position + 1, planned.velocity)
        writer.cycle_start(float(block.time[200]))
        writer.cycle_start(float(block.time[550]))
    log = read_log(path)
    np.testing.assert_array_equal(log.planned_position[200:900], planned.position + 1)
    assert np.isnan(log.planned_position[:200]).all()
    assert np.isnan(log.planned_position[900:]).all()
    np.testing.assert_allclose(log.cycle_starts, (0.4, 1.1), atol=1e-9)
    assert log.metadata["motion"] == "excitation"


def test_writes_blocks_without_velocity_effort_or_references(tools, record):
    from dataclasses import replace

    block = replace(
        tools.motion(100), velocity=None, torque=None, reference_position=None, reference_velocity=None, received=0.0
    )
    path = record(block, clock=lambda: 1234.5)
    log = read_log(path)
    assert log.velocity is None
    assert log.effort is None
    assert log.reference_position is None
    with open(path, "rb") as file:
        assert {message.log_time for _, _, message in make_reader(file).iter_messages()} == {1234500000000}


def test_samples_that_the_link_lost_before_the_first_and_after_the_last_are_counted(tools, tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path, tools.JOINTS, robot="arm", motion="test", sample_rate=500.0) as writer:
        writer.write(tools.cut(tools.motion(1000), slice(100, 900)))
        writer.missed(200)
    assert writer.lost == 200
    log = read_log(path)
    assert log.metadata["lost_samples"] == "200"
    assert "lost on the link: 200 at 0.000 s" in [str(repair) for repair in log.repairs]


def test_lost_and_repeated_samples_are_counted_and_reported(tools, record):
    block = tools.motion(1000)
    order = np.r_[0:300, 305:600, 590:600, 600:1000]  # five lost, ten repeated
    path = record(*(tools.cut(block, order[k : k + 9]) for k in range(0, len(order), 9)))
    log = read_log(path)
    assert len(log.t) == 995
    assert log.metadata["lost_samples"] == "5"
    assert log.metadata["repeated_samples"] == "10"
    repairs = {repair.kind.split(",")[0]: repair for repair in log.repairs}
    assert repairs["gap"].count == 5
    assert repairs["repeated on the link"].count == 10
    with open(path, "rb") as file:
        events = [m.data for _, _, m in make_reader(file).iter_messages(topics=["/controller_status"])]
    assert len(events) == 1
    assert b"5 samples lost" in events[0]


def test_a_late_sample_fills_its_gap(tools, record):
    block = tools.motion(400)
    order = np.r_[0:100, 101:200, 100, 200:400]
    log = read_log(record(tools.cut(block, order)))
    assert log.metadata["lost_samples"] == "0"
    np.testing.assert_array_equal(log.position, block.position)


def test_a_restarted_counter_loses_no_sample(tools, record):
    from dataclasses import replace

    second = replace(tools.motion(300, first=300), sequence=np.arange(300))
    path = record(tools.motion(300), second)
    log = read_log(path)
    assert len(log.t) == 600
    assert log.metadata["lost_samples"] == "0"


def test_writes_events(tools, tmp_path):
    path = tmp_path / "log.mcap"
    with LogWriter(path, tools.JOINTS, robot="arm", motion="test", clock=lambda: 5.0) as writer:
        writer.write(tools.motion(10))
        writer.event("protective stop")
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [(m.log_time, d.data) for _, _, m, d in reader.iter_decoded_messages(topics=["/controller_status"])]
    assert found == [(5 * 10**9, "protective stop")]


def test_an_error_while_recording_keeps_what_was_recorded(tools, tmp_path):
    path = tmp_path / "log.mcap"

    def recording() -> None:
        with LogWriter(path, tools.JOINTS, robot="arm", motion="test") as writer:
            writer.write(tools.motion(250))
            raise ConnectionError("the link dropped")

    with pytest.raises(ConnectionError, match="the link dropped"):
        recording()
    assert len(read_log(path).t) == 250


def test_data_reach_the_disk_without_closing(tools, tmp_path):
    path = tmp_path / "log.mcap"
    writer = LogWriter(path, tools.JOINTS, robot="arm", motion="test")
    try:
        writer.write(tools.motion(20))
        ended = threading.Event()
        for _ in range(1000):  # waits for the writer's own interval of half a second, and no longer than it takes
            if _states_on_disk(path) == 20:
                break
            ended.wait(0.01)
        assert _states_on_disk(path) == 20
        with open(path, "rb") as file:
            first = next(r for r in _records(file) if isinstance(r, Metadata))
        assert first.name == "run"
    finally:
        writer.close()


def _records(file):
    from mcap.exceptions import EndOfFile

    try:
        yield from StreamReader(file, emit_chunks=True).records
    except EndOfFile:
        return


def _states_on_disk(path: Path) -> int:
    with open(path, "rb") as file:
        if not any(isinstance(record, Chunk) for record in _records(file)):
            return 0
    return len(read_log(path).t)


def test_an_existing_log_is_not_overwritten(tools, record):
    path = record(tools.motion(10))
    before = path.read_bytes()
    with pytest.raises(InputError, match="never overwritten"):
        LogWriter(path, tools.JOINTS, robot="arm", motion="test")
    assert path.read_bytes() == before


def test_reports_a_missing_folder(tools, tmp_path):
    with pytest.raises(RecordingError, match=r"cannot be written: No such file") as caught:
        LogWriter(tmp_path / "missing" / "log.mcap", tools.JOINTS, robot="arm", motion="test")
    assert caught.value.exit_code == 1


@pytest.fixture
def slow_disk(monkeypatch):
    """A disk that takes nothing until this is set; `begun` is set once it was given something."""
    from agent.recording.mcap import writer as module

    awake = threading.Event()
    awake.begun = threading.Event()

    class Slow(module.LogFile):
        def write(self, samples):
            awake.begun.set()
            awake.wait()
            super().write(samples)

    monkeypatch.setattr(module, "LogFile", Slow)
    yield awake
    awake.set()


def test_a_slow_disk_does_not_block_the_link_and_a_too_slow_one_is_an_error(tools, tmp_path, slow_disk):
    path = tmp_path / "log.mcap"
    block = tools.motion(1000)
    blocks = [tools.cut(block, slice(k, k + 10)) for k in range(0, 1000, 10)]
    size = 10 * (5 * 3 * 8 + 8)
    with LogWriter(path, tools.JOINTS, robot="arm", motion="test", backlog_limit=40 * size) as writer:
        for part in blocks[:40]:
            writer.write(part)  # returns although nothing is written
        assert writer.backlog == 40 * size
        with pytest.raises(RecordingError, match=r"the disk is too slow: .* wait for it; choose a folder on a faster"):
            writer.write(blocks[40])
        slow_disk.set()
    assert writer.backlog == 0
    np.testing.assert_array_equal(read_log(path).position, block.position[:410])


def test_a_stuck_disk_is_an_error_and_loses_no_sample(tools, tmp_path, slow_disk):
    path = tmp_path / "log.mcap"
    block = tools.motion(100)
    with LogWriter(path, tools.JOINTS, robot="arm", motion="test", stall_limit=0.0) as writer:
        writer.write(tools.cut(block, slice(0, 50)))
        slow_disk.begun.wait()
        with pytest.raises(RecordingError, match="it has taken nothing for"):
            writer.write(tools.cut(block, slice(50, 100)))
        slow_disk.set()
    np.testing.assert_array_equal(read_log(path).position, block.position)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_loses_no_sample_that_waits_for_a_slow_disk(tools, tmp_path, slow_disk, monkeypatch, number):
    """It is raised once everything is written; meanwhile somebody says how far that is."""
    from agent.recording.mcap import writer as module

    monkeypatch.setattr(module, "_TOLD", 0.001)
    path, block, told = tmp_path / "log.mcap", tools.motion(1000), []

    def tell(text):
        told.append(text)
        if len(told) == 2:
            os.kill(os.getpid(), number)
        if len(told) == 4:
            slow_disk.set()

    def record():
        with LogWriter(path, tools.JOINTS, robot="arm", motion="test", tell=tell) as writer:
            for k in range(0, 1000, 10):
                writer.write(tools.cut(block, slice(k, k + 10)))

    with signals_raised(), pytest.raises((KeyboardInterrupt, Ended)):
        record()
    np.testing.assert_array_equal(read_log(path).position, block.position)
    assert "log.mcap: the disk is slow; 0 of 1000 samples are written" in told[0]
    assert told[3].endswith("the program ends when that is done")


def test_a_disk_is_asked_a_few_times_a_second(tools, tmp_path, monkeypatch):
    """Or one that takes 0.3 s for each write, however small, falls behind by minutes."""
    from agent.recording.mcap import log_file as module

    asked, flush = [], module._KeptFile.flush

    def counted(file):
        asked.append(len(file._waiting) > 0)
        flush(file)

    monkeypatch.setattr(module._KeptFile, "flush", counted)
    block = tools.motion(5000)
    with LogWriter(tmp_path / "log.mcap", tools.JOINTS, robot="arm", motion="test") as writer:
        for k in range(0, 5000, 10):
            writer.write(tools.cut(block, slice(k, k + 10)))
    seconds = block.time[-1] - block.time[0]
    assert sum(asked) <= 2 * seconds + 8


@pytest.fixture
def uneven() -> Log:
    """Two stretches of a 1 Hz motion with a gap between them, unevenly sampled at about 500 Hz."""
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.001, 0.003, 2000))
    t[1000:] += 0.5
    t -= t[0]
    q = np.sin(2 * np.pi * t)[:, None] * [1.0, 2.0]
    planned = q.copy()
    planned[:300] = np.nan
    return Log(
        path=Path("uneven.mcap"),
        joint_names=("a", "b"),
        t=t,
        position=q,
        velocity=None,
        effort=np.sign(q),
        reference_position=q,
        planned_position=planned,
        sample_rate=500.0,
        stamp=7.0,
        segments=((0, 1000), (1000, 2000)),
        cycle_starts=(0.0, 1.0),
        metadata={"robot": "arm", "motion": "test"},
    )


def test_a_log_in_memory_needs_a_folder(uneven, tmp_path):
    (tmp_path / "file").touch()
    for folder, reason in (("missing", "No such file or directory"), ("file", "Not a directory")):
        with pytest.raises(RecordingError, match=rf"{folder}/copy.mcap: the log cannot be written: {reason}"):
            write_log(tmp_path / folder / "copy.mcap", uneven)


def test_an_in_memory_log_is_written_and_read_back(uneven, tmp_path):
    path = tmp_path / "copy.mcap"
    write_log(path, uneven)
    write_log(path, uneven)  # replaces it
    log = read_log(path)
    for name in ("position", "effort", "reference_position", "planned_position"):
        np.testing.assert_array_equal(getattr(log, name), getattr(uneven, name))
    np.testing.assert_allclose(log.t, uneven.t, atol=2e-9)
    assert log.velocity is None
    assert log.stamp == 7.0
    assert log.segments == uneven.segments
    np.testing.assert_allclose(log.cycle_starts, uneven.cycle_starts, atol=1e-9)
    assert [p.name for p in tmp_path.iterdir()] == ["copy.mcap"]
