"""Recording next to the link: the disk may be slow, the link never waits for it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any

import numpy as np

from agent.core import deferred, interrupted
from agent.recording.mcap.log_file import FLUSH_INTERVAL, PLANNED, REFERENCES, TEMPERATURES, LogFile, RecordingError
from drivers.protocol import SampleBlock

#: Limit of what waits in memory for a slow disk [bytes]: half an hour of six joints at 500 Hz.
BACKLOG_LIMIT = 256 * 2**20
#: Longest time a disk may take nothing while a motion is recorded [s]; what waits would be lost with the process.
STALL_LIMIT = 10.0
#: Longest time a closed log may wait for a disk that takes nothing at all [s].
CLOSE_LIMIT = 60.0
#: Interval between two messages on how far a log is that is being closed [s].
_TOLD = 2.0


class LogWriter:
    """Writes one log in a thread of its own. Every method but `close` returns at once, whatever the disk does.

    What was written reaches the operating system within half a second, of data and of waiting, so a killed process
    loses at most that. A disk that falls further behind than `backlog_limit` or `stall_limit` is an error of `write`:
    whoever records then stops the arm; what waits is still written where the disk takes it again.

    Use it as a context manager: leaving it closes the log, also after an error, which keeps what was recorded. A signal
    that comes meanwhile is raised when everything is written.

    Args:
        path: file to write; it must not exist.
        joint_names: as in the robot description.
        backlog_limit: [bytes].
        stall_limit: [s].
        tell: takes messages on how far a slow disk is, once the log is being closed.
        robot, motion, sample_rate, clock, facts: as in `LogFile`.

    Raises:
        InputError: the file exists.
        RecordingError: disk full, read-only, too slow or no rights; from `write` and `close`. What came before stays
            readable.
    """

    def __init__(
        self,
        path: str | Path,
        joint_names: Sequence[str],
        *,
        robot: str,
        motion: str,
        sample_rate: float | None = None,
        clock: Callable[[], float] = time.time,
        backlog_limit: int = BACKLOG_LIMIT,
        stall_limit: float = STALL_LIMIT,
        facts: Mapping[str, str] | None = None,
        tell: Callable[[str], None] = lambda _: None,
    ):
        self.path = Path(path)
        self._tell = tell
        self._samples = self._written = 0
        self._file = LogFile(self.path, joint_names, robot, motion, sample_rate, clock, facts)
        self._limit = backlog_limit
        self._stall_limit = stall_limit
        self._jobs: SimpleQueue[tuple[int, Callable[[], Any]] | None] = SimpleQueue()
        self._handed = self._done = 0  # bytes
        self._steps = 0
        self._busy_since: float | None = None
        self._failure: BaseException | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._work, name=f"log {self.path.name}", daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Samples that are not in the log, by sequence number; complete once the log is closed."""
        return self._file.lost

    @property
    def repeated(self) -> int:
        """Samples that came again and were left out; complete once the log is closed."""
        return self._file.repeated

    @property
    def backlog(self) -> int:
        """Bytes that were handed over and have not gone through the writer yet."""
        return 0 if self._failure is not None else self._handed - self._done

    def write(self, block: SampleBlock) -> None:
        """Add measured samples with their set-points. The arrays must not change afterwards."""
        references = (block.reference_position, block.reference_velocity)
        arrays = (block.position, block.velocity, block.torque, block.current, *references)
        size = sum(values.nbytes for values in arrays if values is not None) + block.time.nbytes
        self._samples += len(block)
        self._put(size, lambda: self._write(block))
        if self._failure is not None:
            raise self._failure
        since = self._busy_since
        stalled = 0.0 if since is None else time.monotonic() - since
        if self.backlog > self._limit:
            raise self._too_slow(f"{self.backlog >> 20} MiB wait for it")
        if stalled > self._stall_limit:
            raise self._too_slow(f"it has taken nothing for {stalled:.0f} s")

    def _write(self, block: SampleBlock) -> None:
        self._file.write(block)
        self._written += len(block)

    def write_planned(self, time: np.ndarray, position: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Add what was planned for controller times (K,) [s]: position and velocity (K, n)."""
        self._put(2 * position.nbytes, lambda: self._file.write_states(PLANNED, time, position, velocity))

    def write_references(self, time: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> None:
        """Add set-points that have stamps (K,) [s] of their own: position and velocity (K, n)."""
        self._put(2 * position.nbytes, lambda: self._file.write_states(REFERENCES, time, position, velocity))

    def write_temperatures(self, readings: Sequence[tuple[float, np.ndarray]]) -> None:
        """Add temperatures of the motors: controller time [s] and (n,) [°C] of each reading."""
        if readings:
            times, values = (np.array(column) for column in zip(*readings, strict=True))
            self._put(values.nbytes, lambda: self._file.write_states(TEMPERATURES, times, effort=values))

    def cycle_start(self, time: float) -> None:
        """Note a controller time [s] at which the motion begins anew."""
        self._put(0, lambda: self._file.cycle_start(time))

    def note(self, facts: Mapping[str, str]) -> None:
        """Add to what the record `run` says at the end."""
        self._put(0, lambda: self._file.note(facts))

    def missed(self, count: int) -> None:
        """Note how many samples the link lost in all, those before the first and after the last one seen too."""
        self._put(0, lambda: self._file.missed(count))

    def event(self, text: str) -> None:
        """Note what happened on the link or to the robot."""
        self._put(len(text), lambda: self._file.event(text))

    def close(self) -> None:
        """Write all that waits, and the index. Safe to call twice."""
        if self._closing:
            return
        self._closing = True
        self._jobs.put(None)
        with deferred():
            self._finish()
        if self._failure is not None:
            raise self._failure

    def _finish(self) -> None:
        """Wait for the thread, and say how far it is."""
        steps, stuck, interval = -1, 0.0, min(_TOLD, CLOSE_LIMIT)
        while True:
            self._thread.join(interval)
            if not self._thread.is_alive():
                return
            stuck, steps = (stuck + interval if steps == self._steps else 0.0), self._steps
            if not stuck < CLOSE_LIMIT:
                raise self._too_slow(f"it has taken nothing for {CLOSE_LIMIT:g} s")
            ends = "; the program ends when that is done" if interrupted() else ""
            self._tell(
                f"{self.path.name}: the disk is slow; {self._written} of {self._samples} samples are written{ends}"
            )

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        try:
            self.close()
        except Exception as failure:
            if error is None:
                raise
            if failure is not error:
                error.add_note(str(failure))

    def _too_slow(self, how: str) -> RecordingError:
        return RecordingError(self.path, f"the disk is too slow: {how}", advice="choose a folder on a faster disk")

    def _put(self, size: int, job: Callable[[], Any]) -> None:
        if self._failure is None:
            self._handed += size
            self._jobs.put((size, job))

    def _work(self) -> None:
        try:
            due = time.monotonic() + FLUSH_INTERVAL
            while (entry := self._next(due)) is not None:
                size, job = entry
                job()
                if time.monotonic() >= due:
                    self._file.flush()
                    due = time.monotonic() + FLUSH_INTERVAL
                self._done += size
                self._busy_since = None
                self._steps += 1
            self._file.finish()
        except BaseException as failure:  # raised again in the thread that writes
            self._failure, self._jobs = failure, SimpleQueue()
        finally:
            self._file.close()

    def _next(self, due: float) -> tuple[int, Callable[[], Any]] | None:
        """The next job and its size [bytes], or one that does nothing where a flush is due; None at the end."""
        try:
            return self._jobs.get(timeout=max(0.0, due - time.monotonic()))
        except Empty:
            return 0, lambda: None
        finally:
            self._busy_since = time.monotonic()
