"""A log on disk in the making, in the format of docs/logs.md. One thread at a time; `LogWriter` gives it its own."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from agent.core import package_version, written_whole
from agent.recording.log import Log
from agent.recording.mcap.foxglove import FOXGLOVE_LAYOUT as LAYOUT_NAME, foxglove_layout
from agent.recording.mcap.joint_state import SCHEMA_NAME, SCHEMA_TEXT, JointStateLayout, layout_for
from agent.recording.mcap.output import CHUNK_SIZE, MESSAGE_HEAD, McapOutput, RecordingError
from agent.recording.repair.sequence import SequenceCheck

STATES = "/joint_states"
REFERENCES = "/joint_references"
PLANNED = "/planned_joint_references"
CURRENTS = "/motor_currents"
TEMPERATURES = "/temperatures"
STATUS = "/controller_status"
RUN = "run"
#: Longest stretch of data, and of waiting, that a killed process may lose [s]; the contract allows one second.
FLUSH_INTERVAL = 0.5
_NANO = 1_000_000_000


class LoggedSamples(Protocol):
    """K samples of n joints, as a driver delivers them: (K,) and (K, n) arrays; None where there are no values.

    `current` (K, n) of the motors [A]; `received` is the receive time [s], 0 where the driver has none.
    """

    @property
    def sequence(self) -> np.ndarray: ...
    @property
    def time(self) -> np.ndarray: ...
    @property
    def position(self) -> np.ndarray: ...
    @property
    def velocity(self) -> np.ndarray | None: ...
    @property
    def torque(self) -> np.ndarray | None: ...
    @property
    def reference_position(self) -> np.ndarray | None: ...
    @property
    def reference_velocity(self) -> np.ndarray | None: ...
    @property
    def received(self) -> float: ...
    @property
    def current(self) -> np.ndarray | None: ...


class LogFile:
    """Writes one log. The file is readable, up to the last flush, at any moment of its life.

    The record `run` is written at the start, for whoever reads the log of a killed writer, and again, with what is
    known only then, at the end; the index at the file's end names the last one.

    Args:
        joint_names: as in the robot description.
        sample_rate: nominal [Hz], or None where nobody knows.
        clock: receive time [s], where samples come without one.
        facts: what else the record `run` says.

    Raises:
        InputError: the file exists.
        RecordingError: from every method, where the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        joint_names: Sequence[str],
        robot: str,
        motion: str,
        sample_rate: float | None,
        clock: Callable[[], float] = time.time,
        facts: Mapping[str, str] | None = None,
    ):
        self._names = tuple(joint_names)
        self._clock = clock
        self._sequence = SequenceCheck()
        self._missed = 0
        self._run = {"robot": robot, "motion": motion, **(facts or {})}
        if sample_rate is not None:
            self._run["sample_rate_hz"] = f"{sample_rate:.12g}"
        self._layouts: dict[tuple[bool, bool, bool], JointStateLayout] = {}
        self._channels: dict[str, int] = {}
        self._first: int | None = None
        self._flushed = 0
        self._receive_offset = 0
        self._cycle_starts: list[float] = []
        self._out = McapOutput(path, "ros2", f"calibration-agent {package_version()}")
        self._schema = self._out.add_schema(SCHEMA_NAME, "ros2msg", SCHEMA_TEXT)
        self._channel(STATES)
        self._out.add_metadata(RUN, self._run, indexed=False)

    @property
    def lost(self) -> int:
        """Samples that never came, by sequence number or as the link counted them."""
        return max(self._sequence.lost, self._missed)

    @property
    def repeated(self) -> int:
        """Samples that came again and were left out."""
        return self._sequence.repeated

    def write(self, samples: LoggedSamples) -> None:
        """Add measured samples and, where there are any, the set-points of the controller."""
        lost = self.lost
        keep = self._sequence.take(samples.sequence, samples.time)
        stamps = nanoseconds(samples.time)[keep]
        if len(stamps) == 0:
            return
        if self._first is None:
            self._first = self._flushed = int(stamps[0])
        received = int((samples.received or self._clock()) * _NANO)
        self._receive_offset = received - int(stamps[-1])
        states = (samples.position, samples.velocity, samples.torque)
        topics = [(STATES, [None if values is None else np.asarray(values)[keep] for values in states])]
        if samples.reference_position is not None:
            references = (samples.reference_position, samples.reference_velocity, None)
            topics.append((REFERENCES, [None if values is None else np.asarray(values)[keep] for values in references]))
        if samples.current is not None:
            topics.append((CURRENTS, [None, None, np.asarray(samples.current)[keep]]))
        self._append(topics, stamps, np.full(len(stamps), received), np.asarray(samples.sequence)[keep])
        if self.lost > lost:
            self.event(f"{self.lost - lost} samples lost up to controller time {stamps[-1] / _NANO:.6f} s")
        if abs(int(stamps[-1]) - self._flushed) >= FLUSH_INTERVAL * _NANO:
            self.flush()
            self._flushed = int(stamps[-1])

    def write_states(
        self,
        topic: str,
        times: np.ndarray,
        position: np.ndarray | None = None,
        velocity: np.ndarray | None = None,
        effort: np.ndarray | None = None,
    ) -> None:
        """Add joint states of any kind, set-points too, for controller times (K,) [s]: (K, n) each."""
        stamps = nanoseconds(times)
        arrays = [None if values is None else np.asarray(values) for values in (position, velocity, effort)]
        self._append([(topic, arrays)], stamps, stamps + self._receive_offset, np.arange(len(stamps)))

    def cycle_start(self, time: float) -> None:
        """Note a controller time [s] at which the motion begins anew."""
        self._cycle_starts.append(time)

    def note(self, facts: Mapping[str, str]) -> None:
        """Add to what the record `run` says at the end."""
        self._run |= facts

    def missed(self, count: int) -> None:
        """Note how many samples the link lost in all, those before the first and after the last one seen too."""
        self._missed = count

    def event(self, text: str) -> None:
        """Note what happened, on /controller_status at the receive time."""
        data = text.encode() + b"\0"
        message = np.frombuffer(b"\x00\x01\x00\x00" + struct.pack("<I", len(data)) + data, np.uint8)
        now = np.array([int(self._clock() * _NANO)])

        def fill(rows: np.ndarray) -> None:
            rows[:] = message

        self._out.add_messages(self._channel(STATUS), now, np.zeros(1), len(message), fill)

    def flush(self) -> None:
        """Hand over to the operating system what is still in memory, and see that the file is still there."""
        self._out.flush()
        self._out.check_kept()

    def finish(self, padding: int = 0) -> None:
        """Write the final record `run`, bytes of padding if asked for, and the index, and wait for the disk."""
        run = dict(self._run)
        if self._cycle_starts:
            first = (self._first or 0) / _NANO
            run["cycle_starts_s"] = json.dumps([round(start - first, 9) for start in self._cycle_starts])
        run["lost_samples"], run["repeated_samples"] = str(self.lost), str(self.repeated)
        self._out.add_metadata(RUN, run)
        self._out.add_attachment(LAYOUT_NAME, "application/json", foxglove_layout(self._names).encode())
        if padding:
            self._out.add_attachment("padding", "application/octet-stream", bytes(padding))
        self._out.finish()
        self._out.sync()
        self._out.check_kept()

    def close(self) -> None:
        """Let go of the file, finished or not."""
        self._out.close()

    def _append(
        self,
        topics: list[tuple[str, list[np.ndarray | None]]],
        stamps: np.ndarray,
        log_times: np.ndarray,
        sequences: np.ndarray,
    ) -> None:
        layouts = [self._layout(arrays) for _, arrays in topics]
        size = sum(MESSAGE_HEAD + len(layout.template) for layout in layouts)
        start = 0
        while start < len(stamps):
            room = max(1, (self._out.room if self._out.room >= size else CHUNK_SIZE) // size)
            part = slice(start, start + room)
            for (topic, arrays), layout in zip(topics, layouts, strict=True):
                rows = [None if values is None else values[part] for values in arrays]

                def fill(
                    messages: np.ndarray, layout: JointStateLayout = layout, rows: list[np.ndarray | None] = rows
                ) -> None:
                    layout.fill(messages, stamps[part], rows)  # noqa: B023  called before `part` moves on

                self._out.add_messages(
                    self._channel(topic), log_times[part], sequences[part], len(layout.template), fill
                )
            start += room

    def _layout(self, arrays: list[np.ndarray | None]) -> JointStateLayout:
        key = (arrays[1] is not None, arrays[2] is not None, arrays[0] is not None)
        if key not in self._layouts:
            self._layouts[key] = layout_for(self._names, *key)
        return self._layouts[key]

    def _channel(self, topic: str) -> int:
        if topic not in self._channels:
            schema = self._schema
            if topic == STATUS:
                schema = self._out.add_schema("std_msgs/msg/String", "ros2msg", "string data\n")
            self._channels[topic] = self._out.add_channel(topic, "cdr", schema)
        return self._channels[topic]


def write_log(path: Path, log: Log, further: Mapping[str, Sequence[Any]] | None = None) -> None:
    """Write a log that is in memory, whole or not at all; an existing file is replaced.

    `further` are joint states by topic: times (K,) [s from the first sample], position, velocity and effort (K, n) or
    None.

    Raises:
        RecordingError: the file cannot be written.
    """
    try:
        with written_whole(path) as beside:
            _write_whole(beside, log, further or {})
    except OSError as error:
        raise RecordingError(path, error.strerror) from None
    except RecordingError as error:
        raise RecordingError(path, error.reason) from None


#: Of the record `run`, what the writer says itself.
_OWN = ("robot", "motion", "sample_rate_hz", "cycle_starts_s")


def _write_whole(path: Path, log: Log, further: Mapping[str, Sequence[Any]]) -> None:
    times = log.stamp + log.t
    run = log.metadata
    robot, motion = run.get("robot", ""), run.get("motion", "")
    facts = {key: value for key, value in run.items() if key not in _OWN}
    file = LogFile(path, log.joint_names, robot, motion, log.sample_rate, clock=lambda: times[0], facts=facts)
    try:
        file.write(_Block(np.arange(len(times)), times, log.position, log.velocity, log.effort))
        for topic, position in ((REFERENCES, log.reference_position), (PLANNED, log.planned_position)):
            if position is not None:
                known = np.all(np.isfinite(position), axis=1)
                file.write_states(topic, times[known], position[known])
        for topic, (seconds, *states) in further.items():
            file.write_states(topic, log.stamp + seconds, *states)
        for start in log.cycle_starts:
            file.cycle_start(log.stamp + start)
        file.finish()
    finally:
        file.close()


@dataclass(frozen=True, eq=False)
class _Block:
    """Samples that come from memory; arrays as in `LoggedSamples`."""

    sequence: np.ndarray
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray | None
    torque: np.ndarray | None
    reference_position: np.ndarray | None = None
    reference_velocity: np.ndarray | None = None
    received: float = 0.0
    current: np.ndarray | None = None


def nanoseconds(times: np.ndarray) -> np.ndarray:
    """(S,) integers [ns] from (S,) seconds."""
    return np.rint(np.asarray(times, float) * _NANO).astype(np.int64)
