"""Reading and writing a log: this project's way against the MCAP support library's, in one run.

    python benchmarks/mcap_read.py [--minutes 1]

CPU seconds of this process; 500 Hz, 6 joints, three topics. The peak of memory is that of a process that does nothing
but read.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from agent.recording import LogWriter, read_log
from drivers.protocol import SampleBlock

JOINTS = [f"joint_{k}" for k in range(1, 7)]
BLOCK = 10  # samples a driver hands over at once
_READ_ALONE = """
import sys
from agent.recording import read_log

def peak():
    return next(int(line.split()[1]) / 1024 for line in open("/proc/self/status") if line.startswith("VmHWM"))

before = peak()
read_log(sys.argv[1])
print(before, peak())
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0)
    samples = int(parser.parse_args().minutes * 60 * 500)
    blocks = [make_block(start, min(BLOCK, samples - start)) for start in range(0, samples, BLOCK)]
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder) / "ours.mcap", Path(folder) / "theirs.mcap"
        rows = [
            ("write", cpu(lambda: write_ours(ours, blocks)), cpu(lambda: write_theirs(theirs, blocks))),
            ("read", min(cpu(lambda: read_log(ours)) for _ in range(3)), cpu(lambda: read_theirs(ours))),
        ]
        print(f"{samples} samples, {samples / 500:.0f} s, {ours.stat().st_size / 1e6:.1f} MB")
        print(f"{'':8}{'ours [s]':>10}{'library [s]':>13}{'ratio':>8}{'ours [µs a message]':>22}")
        for name, own, other in rows:
            print(f"{name:8}{own:10.3f}{other:13.3f}{other / own:8.1f}{1e6 * own / (3 * samples):22.2f}")
        peak = subprocess.run(
            [sys.executable, "-c", _READ_ALONE, str(ours)],
            capture_output=True,
            text=True,
            check=True,
            cwd=Path(__file__).resolve().parents[1],
        )
        before, after = (float(value) for value in peak.stdout.split())
        print(f"memory of a process that reads it: {after:.0f} MiB at its peak, {before:.0f} MiB of it before")


def make_block(start: int, count: int) -> SampleBlock:
    number = np.arange(start, start + count)
    rng = np.random.default_rng(start)
    arrays = [rng.normal(size=(count, 6)) for _ in range(5)]
    return SampleBlock(number, number / 500, *arrays, received=1.7e9 + number[-1] / 500)


def cpu(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def write_ours(path: Path, blocks: list[SampleBlock]) -> None:
    with LogWriter(path, JOINTS, robot="arm", motion="benchmark", sample_rate=500.0) as writer:
        for block in blocks:
            writer.write(block)
            writer.write_planned(block.time, block.reference_position, block.reference_velocity)


def write_theirs(path: Path, blocks: list[SampleBlock]) -> None:
    from mcap_ros2.writer import Writer

    from agent.recording.mcap.joint_state import SCHEMA_NAME, SCHEMA_TEXT

    with open(path, "wb") as file, Writer(file, chunk_size=64 * 1024) as writer:
        schema = writer.register_msgdef(SCHEMA_NAME, SCHEMA_TEXT)
        for block in blocks:
            references = (block.reference_position, block.reference_velocity, None)
            for topic, arrays in (
                ("/joint_states", (block.position, block.velocity, block.torque)),
                ("/joint_references", references),
                ("/planned_joint_references", references),
            ):
                for k, stamp in enumerate(block.time):
                    nanoseconds = round(stamp * 1e9)
                    position, velocity, effort = (() if a is None else a[k].tolist() for a in arrays)
                    message = {
                        "header": {
                            "stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
                            "frame_id": "",
                        },
                        "name": JOINTS,
                        "position": position,
                        "velocity": velocity,
                        "effort": effort,
                    }
                    writer.write_message(topic, schema, message, log_time=nanoseconds)


def read_theirs(path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        rows: dict[str, list] = {}
        for _, channel, _, message in reader.iter_decoded_messages(log_time_order=False):
            rows.setdefault(channel.topic, []).append((message.position, message.velocity, message.effort))
        for values in rows.values():
            np.array([position for position, _, _ in values])


if __name__ == "__main__":
    main()
