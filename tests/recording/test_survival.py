"""What is left of a log when its writer, its disk or a part of the file is gone."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from mcap.writer import CompressionType

from agent.core.errors import InputError
from agent.recording import LogWriter, read_log
from agent.recording.mcap.log_file import RecordingError
from tests.conftest import environment

# records 50 ms of data at a time and says so once they have gone through the writer
_RECORDER = """
import sys, time
import numpy as np
from agent.recording import LogWriter
from drivers.protocol import SampleBlock

writer = LogWriter(sys.argv[1], ["joint_1", "joint_2"], robot="arm", motion="long", sample_rate=500.0)
for k in range(4000):
    count = np.arange(25 * k, 25 * k + 25)
    q = np.sin(count / 500.0)[:, None] * [1.0, 2.0]
    writer.write(SampleBlock(count, count / 500.0, q, q, q, q, q))
    while writer.backlog:
        time.sleep(0.001)
    print(k, flush=True)
"""


@pytest.mark.parametrize("acknowledged", [30, 77, 200])
def test_a_killed_writer_loses_at_most_the_last_second(tmp_path, acknowledged):
    path = tmp_path / "log.mcap"
    process = subprocess.Popen([sys.executable, "-c", _RECORDER, str(path)], stdout=subprocess.PIPE, env=environment())
    assert process.stdout is not None
    for _ in range(acknowledged):
        assert process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    log = read_log(path)
    assert log.t[-1] >= acknowledged * 0.05 - 1.0
    np.testing.assert_allclose(log.position[:, 1], 2 * np.sin(np.arange(len(log.t)) / 500.0), atol=1e-12)
    assert log.sample_rate == 500.0
    assert log.metadata["motion"] == "long"
    assert any("not closed" in repair.kind for repair in log.repairs)


def test_reports_a_log_whose_writer_was_killed_before_any_message(tmp_path):
    with LogWriter(tmp_path / "log.mcap", ["joint_1"], robot="arm", motion="long", sample_rate=500.0):
        cut = tmp_path / "cut.mcap"
        cut.write_bytes((tmp_path / "log.mcap").read_bytes())
    with pytest.raises(InputError, match="no messages in it; its writer stopped before it had written any"):
        read_log(cut)


_FILLER = """
import resource, sys
import numpy as np
from agent.core.errors import AgentError
from agent.recording import LogWriter
from drivers.protocol import SampleBlock

resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
noise = np.random.default_rng(0).normal(size=(100, 6))
try:
    with LogWriter(sys.argv[1], [f"joint_{k}" for k in range(6)], robot="arm", motion="m") as writer:
        for k in range(100):
            count = np.arange(100 * k, 100 * k + 100)
            writer.write(SampleBlock(count, count / 500.0, noise, noise, noise, noise, noise))
except AgentError as error:
    print(error)
    sys.exit(error.exit_code)
"""


def test_a_full_disk_is_one_clear_error_and_the_log_stays_readable(tmp_path):
    path = tmp_path / "log.mcap"
    process = subprocess.run(
        [sys.executable, "-c", _FILLER, str(path)], capture_output=True, text=True, env=environment(), check=False
    )
    assert process.returncode == 1
    assert process.stdout.startswith(f"{path}: the log cannot be written: ")
    assert "bytes recorded before are in the file and readable" in process.stdout
    assert process.stderr == ""
    log = read_log(path)
    assert len(log.t) > 200
    assert [repair.kind for repair in log.repairs] == [
        "the file was not closed by its writer; unreadable bytes at its end"
    ]
    assert log.repairs[0].count == 0  # half a record was taken back


@pytest.fixture(scope="module")
def whole_logs(tools, tmp_path_factory):
    """Bytes of whole logs by different writers, and what is in them."""
    folder = tmp_path_factory.mktemp("whole")
    block = tools.motion(300)
    with LogWriter(folder / "ours", tools.JOINTS, robot="arm", motion="test", sample_rate=500.0) as writer:
        for k in range(0, 300, 50):
            writer.write(tools.cut(block, slice(k, k + 50)))
    messages = tools.as_messages(block)
    tools.write_foreign(folder / "zstd", messages, chunk_size=20_000)
    tools.write_foreign(folder / "lz4", messages, chunk_size=20_000, compression=CompressionType.LZ4)
    tools.write_foreign(folder / "plain", messages, chunk_size=20_000, compression=CompressionType.NONE)
    tools.write_foreign(folder / "unchunked", messages, use_chunking=False)
    return {path.name: path.read_bytes() for path in folder.iterdir()}, block


kinds = st.sampled_from(["ours", "zstd", "lz4", "plain", "unchunked"])


@settings(max_examples=250, deadline=None)
@given(kinds, st.floats(0, 1))
def test_a_truncated_file_gives_the_samples_before_the_cut(whole_logs, tmp_path_factory, kind, part):
    files, block = whole_logs
    data = files[kind]
    cut_at = int(part * len(data))
    path = tmp_path_factory.mktemp("cut") / "log.mcap"
    path.write_bytes(data[:cut_at])
    try:
        log = read_log(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017  either outcome is right
        return
    np.testing.assert_array_equal(log.position, block.position[: len(log.t)])
    np.testing.assert_array_equal(log.effort, block.torque[: len(log.t)])
    assert len(log.t) == 300 or any("not closed" in repair.kind for repair in log.repairs)


@settings(max_examples=250, deadline=None)
@given(kinds, st.floats(0, 1, exclude_max=True), st.integers(1, 255))
def test_a_flipped_byte_never_crashes_the_reader(whole_logs, tmp_path_factory, kind, part, flip):
    files, _ = whole_logs
    data = bytearray(files[kind])
    data[int(part * len(data))] ^= flip
    path = tmp_path_factory.mktemp("flipped") / "log.mcap"
    path.write_bytes(bytes(data))
    try:
        log = read_log(path)
    except InputError:
        return
    assert 2 <= len(log.t) <= 300
    assert np.isfinite(log.position).all()
    assert (np.diff(log.t) > 0).all()


def test_a_damaged_chunk_is_left_out_and_named(whole_logs, tmp_path):
    files, block = whole_logs
    data = bytearray(files["zstd"])
    second = data.index(b"zstd", data.index(b"zstd") + 1)
    data[second + 500] ^= 0xFF
    path = tmp_path / "log.mcap"
    path.write_bytes(bytes(data))
    log = read_log(path)
    assert 100 < len(log.t) < 300
    assert any("damaged chunks" in repair.kind and "number 2" in repair.kind for repair in log.repairs)
    kept = np.searchsorted(block.time - 100.0, log.t - 1e-6)
    np.testing.assert_array_equal(log.position, block.position[kept])


def _delete(path: Path) -> None:
    path.unlink()


def _truncate(path: Path) -> None:
    os.truncate(path, 100)


def _replace(path: Path) -> None:
    other = path.with_suffix(".other")
    other.write_bytes(path.read_bytes())
    other.rename(path)


def _append(path: Path) -> None:
    with open(path, "ab") as file:
        file.write(b"more")


def _move_the_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


@pytest.mark.parametrize("harm", [_delete, _truncate, _replace, _append, _move_the_folder])
@pytest.mark.parametrize("after", [False, True], ids=["before the last sample", "after the last sample"])
def test_a_log_deleted_while_recording_is_an_error(tools, tmp_path: Path, harm, after: bool):
    """The system writes on into a file that no path leads to, and says nothing."""
    path = tmp_path / "run" / "log.mcap"
    path.parent.mkdir()
    writer = LogWriter(path, tools.JOINTS, robot="arm", motion="excitation")

    def write(first: int, samples: int) -> None:
        writer.write(tools.motion(samples, first=first))
        while writer.backlog:
            time.sleep(0.001)

    def go_on() -> None:
        for first in range(1000, 1001 if after else 3000, 50):
            write(first, 50)
        if after:
            writer.close()

    write(0, 1000)
    harm(path)
    with pytest.raises(RecordingError, match="deleted, replaced or changed while it was recorded"):
        go_on()


def test_an_undisturbed_log_is_complete(tools, record):
    assert len(read_log(record(tools.motion(4000))).t) == 4000
