"""Motions to record, and logs as other programs write them."""

from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from drivers.protocol import SampleBlock

JOINTS = ("joint_1", "joint_2", "joint_3")
JOINT_STATE = "sensor_msgs/msg/JointState"
DEFINITION = (
    "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + "=" * 80
    + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


def make_motion(samples: int, rate: float = 500.0, start: float = 100.0, first: int = 0) -> SampleBlock:
    """Three joints, every number different from all others."""
    count = np.arange(first, first + samples)
    time = start + count / rate
    phase = (count / rate)[:, None] * np.array([1.0, 1.7, 2.3])
    return SampleBlock(
        sequence=count,
        time=time,
        position=np.sin(phase),
        velocity=np.cos(phase),
        torque=10 * np.sin(2 * phase) + 1e-3 * count[:, None],
        reference_position=np.sin(phase) + 0.01,
        reference_velocity=np.cos(phase) + 0.01,
        received=1.7e9 + float(time[-1] if samples else start),
    )


def cut(block: SampleBlock, part: Any) -> SampleBlock:
    """The samples of a block that an index takes."""
    names = ("sequence", "time", "position", "velocity", "torque", "reference_position", "reference_velocity")
    return SampleBlock(**{name: getattr(block, name)[part] for name in names}, received=block.received)


def write_foreign(
    path: Path,
    messages: Iterable[dict[str, Any]],
    metadata: dict[str, str] | None = None,
    strangers: Iterable[bytes] = (),
    compression: CompressionType = CompressionType.ZSTD,
    **options: Any,
) -> Path:
    """A log by the MCAP library. A message has time [s], and may have topic, names, position, velocity, effort, data
    (CDR as it is); `strangers` are messages of a type that no reader here knows."""
    from mcap_ros2._dynamic import serialize_dynamic

    encode = serialize_dynamic(JOINT_STATE, DEFINITION)[JOINT_STATE]
    with open(path, "wb") as file:
        writer = Writer(file, compression=compression, **options)
        writer.start(profile="ros2", library="another")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", DEFINITION.encode())
        other = writer.register_channel("/odd", "cdr", writer.register_schema("odd/msg/Odd", "ros2msg", b"uint8 x\n"))
        for k, data in enumerate(strangers):
            writer.add_message(other, k, data, k)
        channels: dict[str, int] = {}
        for message in messages:
            topic = message.get("topic", "/joint_states")
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            nanoseconds = round(message["time"] * 1e9)
            data = message.get("data") or encode(
                {
                    "header": {
                        "stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
                        "frame_id": message.get("frame_id", "world"),
                    },
                    "name": list(message.get("names", JOINTS)),
                    **{key: list(message.get(key, ())) for key in ("position", "velocity", "effort")},
                }
            )
            writer.add_message(channels[topic], nanoseconds, data, nanoseconds)
        if metadata is not None:
            writer.add_metadata("run", metadata)
        writer.finish()
    return path


def as_messages(block: SampleBlock, **fixed: Any) -> list[dict[str, Any]]:
    """One message a sample, with position, velocity and effort."""
    rows = zip(block.time, block.position, block.velocity, block.torque, strict=True)
    return [{"time": t, "position": q, "velocity": v, "effort": e, **fixed} for t, q, v, e in rows]


@pytest.fixture(scope="session")
def tools() -> SimpleNamespace:
    """The helpers above, for the tests of this folder."""
    return SimpleNamespace(
        JOINTS=JOINTS, motion=make_motion, cut=cut, write_foreign=write_foreign, as_messages=as_messages
    )


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Path]:
    """Record blocks with the writer under test; returns the file."""
    from agent.recording import LogWriter

    def run(*blocks: SampleBlock, name: str = "log.mcap", **settings: Any) -> Path:
        path = tmp_path / name
        options = {"robot": "arm", "motion": "test", "sample_rate": 500.0, **settings}
        with LogWriter(path, JOINTS, **options) as writer:
            for block in blocks:
                writer.write(block)
        return path

    return run
