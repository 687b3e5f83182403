"""A log on disk in the making, in the format of docs/logs.md. One thread at a time; `LogWriter` gives it its own."""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import AgentError, InputError, package_version, written_whole
from agent.recording.log import NANO, Log
from agent.recording.mcap.chunks import ChunkWriter
from agent.recording.mcap.foxglove import FOXGLOVE_LAYOUT, foxglove_layout
from agent.recording.mcap.joint_state import SCHEMA_NAME, SCHEMA_TEXT, JointStateLayout, layout_for
from drivers.protocol import SampleBlock

STATES = "/joint_states"
REFERENCES = "/joint_references"
PLANNED = "/planned_joint_references"
CURRENTS = "/motor_currents"
TEMPERATURES = "/temperatures"
STATUS = "/controller_status"
RUN = "run"
#: Longest stretch of data, and of waiting, that a killed process may lose [s]; the contract allows one second.
FLUSH_INTERVAL = 0.5
_ROWS = 1000  # samples encoded at a time
#: Bytes that wait for one write at most.
_WAITING = 2**20
#: Missing samples that may still come; older ones count as lost for good.
_REMEMBERED = 256


class RecordingError(AgentError):
    """A log cannot be written: disk full, read-only, too slow or no rights; `reason` is the system's. What was written
    before stays readable."""

    def __init__(
        self,
        path: Path,
        reason: str | None,
        written: int = 0,
        advice: str = "free space, or choose a folder with write permission",
    ):
        what = f"; {written} bytes recorded before are in the file and readable" if written else ""
        super().__init__(f"{path}: the log cannot be written: {reason}; {advice}{what}")
        self.reason = reason


_Arrays = tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]  # position, velocity, effort: (K, n) each


class LogFile:
    """Writes one log. The file is readable, up to the last flush, at any moment of its life.

    The record `run` is written at the start, for whoever reads the log of a killed writer, and again, with what is
    known only then, at the end.

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
        self._sequence = _SequenceCheck()
        self._missed = 0
        self._run = {"robot": robot, "motion": motion, **(facts or {})}
        if sample_rate is not None:
            self._run["sample_rate_hz"] = f"{sample_rate:.12g}"
        self._layouts: dict[tuple[bool, ...], JointStateLayout] = {}
        self._first: int | None = None
        self._flushed = 0
        self._receive_offset = 0
        self._cycle_starts: list[float] = []
        self._file = _KeptFile(path)
        self._writer = ChunkWriter(self._file, f"calibration-agent {package_version()}")
        self._channel(STATES)
        self._writer.add_metadata(RUN, self._run)
        self._file.flush()

    @property
    def lost(self) -> int:
        """Samples that never came, by sequence number or as the link counted them."""
        return max(self._sequence.lost, self._missed)

    @property
    def repeated(self) -> int:
        """Samples that came again and were left out."""
        return self._sequence.repeated

    def write(self, samples: SampleBlock) -> None:
        """Add measured samples and, where there are any, the set-points of the controller."""
        lost = self.lost
        keep = self._sequence.take(samples.sequence, samples.time)
        stamps = nanoseconds(samples.time)[keep]
        if len(stamps) == 0:
            return
        if self._first is None:
            self._flushed = int(stamps[0])
        received = int((samples.received or self._clock()) * NANO)
        self._receive_offset = received - int(stamps[-1])
        topics: dict[str, _Arrays] = {STATES: (samples.position, samples.velocity, samples.torque)}
        if samples.reference_position is not None:
            topics[REFERENCES] = (samples.reference_position, samples.reference_velocity, None)
        if samples.current is not None:
            topics[CURRENTS] = (None, None, samples.current)
        rows = {topic: tuple(_rows(values, keep) for values in arrays) for topic, arrays in topics.items()}
        self._append(rows, stamps, np.full(len(stamps), received), np.asarray(samples.sequence)[keep])
        if self.lost > lost:
            self.event(f"{self.lost - lost} samples lost up to controller time {stamps[-1] / NANO:.6f} s")
        if abs(int(stamps[-1]) - self._flushed) >= FLUSH_INTERVAL * NANO:
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
        self._append(
            {topic: (position, velocity, effort)}, stamps, stamps + self._receive_offset, np.arange(len(stamps))
        )

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
        message = b"\x00\x01\x00\x00" + struct.pack("<I", len(data)) + data
        channel = self._writer.channel(STATUS, "std_msgs/msg/String", "string data\n")
        now = np.array([int(self._clock() * NANO)])
        self._writer.add_messages(channel, now, np.zeros(1, int), np.frombuffer(message, np.uint8)[None])

    def flush(self) -> None:
        """Hand over to the operating system what is still in memory, and see that the file is still there."""
        self._writer.flush()
        self._file.check_kept()

    def finish(self, padding: int = 0) -> None:
        """Write the final record `run`, bytes of padding if asked for, and the index, and wait for the disk."""
        run = dict(self._run)
        if self._cycle_starts:
            first = (self._first or 0) / NANO
            run["cycle_starts_s"] = json.dumps([round(start - first, 9) for start in self._cycle_starts])
        run["lost_samples"], run["repeated_samples"] = str(self.lost), str(self.repeated)
        self._writer.add_metadata(RUN, run)
        layout = foxglove_layout(self._names).encode()
        self._writer.add_attachment(FOXGLOVE_LAYOUT, "application/json", layout)
        if padding:
            self._writer.add_attachment("padding", "application/octet-stream", bytes(padding))
        self._writer.finish()
        self._file.sync()
        self._file.check_kept()

    def close(self) -> None:
        """Close the file, finished or not."""
        self._file.close()

    def _append(
        self,
        topics: Mapping[str, Sequence[np.ndarray | None]],
        stamps: np.ndarray,
        log_times: np.ndarray,
        sequences: np.ndarray,
    ) -> None:
        if STATES in topics and self._first is None and len(stamps):
            self._first = int(stamps[0])
        numbers, times = np.asarray(sequences, np.int64) & 0xFFFFFFFF, np.maximum(log_times, 0)
        for start in range(0, len(stamps), _ROWS):
            part = slice(start, start + _ROWS)
            for topic, arrays in topics.items():
                rows = self._layout(arrays).filled(stamps[part], [_rows(values, part) for values in arrays])
                self._writer.add_messages(self._channel(topic), times[part], numbers[part], rows)

    def _layout(self, arrays: Sequence[np.ndarray | None]) -> JointStateLayout:
        position, velocity, effort = key = tuple(values is not None for values in arrays)
        if key not in self._layouts:
            self._layouts[key] = layout_for(self._names, velocity, effort, position)
        return self._layouts[key]

    def _channel(self, topic: str) -> int:
        return self._writer.channel(topic, SCHEMA_NAME, SCHEMA_TEXT)


class _SequenceCheck:
    """Follows the sequence numbers of a stream that should count up by one.

    A missing sample that comes late is kept. One that was there before is a repetition. A counter that starts anew
    while controller time goes on is a restart: nothing counts as lost, and nothing is left out.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self._next: int | None = None
        self._time = -np.inf
        self._missing: list[int] = []

    def take(self, sequence: np.ndarray, time: np.ndarray) -> np.ndarray:
        """(K,) mask of the samples to keep, from their sequence numbers and controller times (K,) [s]."""
        numbers = np.asarray(sequence, np.int64)
        if len(numbers) and np.array_equal(numbers, np.arange(len(numbers)) + (self._next or numbers[0])):
            self._next, self._time = int(numbers[-1]) + 1, float(time[-1])
            return np.ones(len(numbers), bool)
        return np.array([self._take(*row) for row in zip(numbers.tolist(), time.tolist(), strict=True)], bool)

    def _take(self, number: int, now: float) -> bool:
        expected = number if self._next is None else self._next
        if number in self._missing and now <= self._time:
            self._missing.remove(number)
            self.lost -= 1
            return True
        if number < expected and now <= self._time:
            self.repeated += 1
            return False
        if number < expected:
            self._missing = []
        elif number > expected:
            self.lost += number - expected
            late = range(max(expected, number - _REMEMBERED), number)
            self._missing = [*self._missing, *late][-_REMEMBERED:]
        self._next, self._time = number + 1, now
        return True


class _KeptFile:
    """A file that only grows, by whole records; whoever deletes, replaces or truncates it is noticed.

    Records wait in memory for `flush`: a disk may take its time for every write, whatever its size.
    """

    def __init__(self, path: Path):
        self._path = path
        self._end = 0  # of what the operating system has
        self._waiting = bytearray()
        try:
            # At the end of the file, wherever that is: else a file that was truncated grows to its size again.
            self._file = open(path, "xb", buffering=0, opener=_appending)  # noqa: SIM115  closed by `close`
        except FileExistsError:
            raise InputError(f"{path}: exists already; a recording is never overwritten, name another file") from None
        except OSError as error:
            raise RecordingError(path, error.strerror) from None

    def tell(self) -> int:
        return self._end + len(self._waiting)

    def write(self, data: bytes) -> int:
        self._waiting += data
        if len(self._waiting) > _WAITING:
            self.flush()
        return len(data)

    def flush(self) -> None:
        """Hand everything over to the operating system, at once."""
        data, self._waiting = bytes(self._waiting), bytearray()
        remaining = memoryview(data)
        try:
            while remaining:
                remaining = remaining[self._file.write(remaining) :]
        except OSError as error:
            with suppress(OSError):  # else the reader meets half a record, which it can deal with
                self._file.truncate(self._end)
            raise RecordingError(self._path, error.strerror, self._end) from None
        self._end += len(data)

    def sync(self) -> None:
        """Wait until the disk has everything: a power cut cannot lose it any more."""
        self.flush()
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise RecordingError(self._path, error.strerror, self._end) from None

    def check_kept(self) -> None:
        """
        Raises:
            RecordingError: the file is not at its path any more, or shorter than what was written: somebody deleted,
                replaced or truncated it, or its file system is gone. The system says nothing of that when it writes.
        """
        try:
            opened, on_disk = os.fstat(self._file.fileno()), os.stat(self._path)
        except OSError as error:
            raise self._lost(error.strerror or str(error)) from None
        if (opened.st_dev, opened.st_ino) != (on_disk.st_dev, on_disk.st_ino):
            raise self._lost("another file is in its place")
        if opened.st_size != self._end:
            raise self._lost(f"it has {opened.st_size} bytes, and {self._end} were written")

    def close(self) -> None:
        with suppress(RecordingError):  # it was raised before, or is about to be
            self.flush()
        self._file.close()

    def _lost(self, how: str) -> RecordingError:
        advice = "what was recorded of this motion is lost or damaged; record it again, where nobody touches the file"
        return RecordingError(
            self._path, f"it was deleted, replaced or changed while it was recorded ({how})", 0, advice
        )


def _appending(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_APPEND, 0o666)


def _rows(values: np.ndarray | None, which: np.ndarray | slice) -> np.ndarray | None:
    return None if values is None else np.asarray(values)[which]


def write_log(path: Path, log: Log, further: Mapping[str, Sequence[Any]] | None = None) -> None:
    """Write a log that is in memory, whole or not at all.

    Args:
        path: an existing file is replaced.
        log: what is written.
        further: joint states by topic: times (K,) [s from the first sample], position, velocity and effort (K, n) or
            None.

    Raises:
        RecordingError: the file cannot be written.
    """
    try:
        with written_whole(path) as unfinished:
            _write_whole(unfinished, log, further or {})
    except OSError as error:
        raise RecordingError(path, error.strerror) from None
    except RecordingError as error:
        raise RecordingError(path, error.reason) from None


#: Of the record `run`, what the writer says itself.
_OWN = ("robot", "motion", "sample_rate_hz", "cycle_starts_s")


def _write_whole(path: Path, log: Log, further: Mapping[str, Sequence[Any]]) -> None:
    times = log.stamp + log.t
    run = log.metadata
    facts = {key: value for key, value in run.items() if key not in _OWN}
    robot, motion = run.get("robot", ""), run.get("motion", "")
    with closing(LogFile(path, log.joint_names, robot, motion, log.sample_rate, facts=facts)) as file:
        file.write_states(STATES, times, log.position, log.velocity, log.effort)
        for topic, position in ((REFERENCES, log.reference_position), (PLANNED, log.planned_position)):
            if position is not None:
                known = np.all(np.isfinite(position), axis=1)
                file.write_states(topic, times[known], position[known])
        for topic, (seconds, *states) in further.items():
            file.write_states(topic, log.stamp + seconds, *states)
        for start in log.cycle_starts:
            file.cycle_start(log.stamp + start)
        file.finish()


def nanoseconds(times: np.ndarray) -> np.ndarray:
    """(S,) integers [ns] from (S,) seconds."""
    return np.rint(np.asarray(times, float) * NANO).astype(np.int64)
