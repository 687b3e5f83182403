"""Record an arm that somebody else moves: nothing is sent to it."""

from __future__ import annotations

import time
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Console, Ended, InputError, deferred, signals_raised
from drivers.registry import watch

if TYPE_CHECKING:
    from agent.recording import LogWriter

#: Silence of the robot [s] from which on it is said; it does not end a recording.
_SILENT = 2.0


@dataclass(frozen=True)
class Watched:
    """A finished recording: every sample that came is in the log at `path`."""

    path: Path
    samples: int
    set_points: int
    lost: int


def record_watched(address: str, log: Path, console: Console) -> Watched:
    """Record joint states and set-points until a signal ends it; the log is complete then.

    Args:
        address: of a ROS 2 controller, `ros2://DOMAIN/NAMESPACE/CONTROLLER`.
        log: to write.
        console: where progress is shown.

    Raises:
        InputError: the log exists.
        ConfigurationError, DriverError: no such address, nothing here to listen with, or nobody publishes.
        ProtocolError: messages that cannot be read.
    """
    from agent.recording import LogWriter

    if log.exists():
        raise InputError(f"{log}: exists already; name another log with -o")
    with signals_raised(), closing(watch(address, console.say)) as source:
        source.open()
        observed = source.observed
        observed.settle()
        _say_start(source, console)
        with LogWriter(
            log,
            observed.joints,
            robot="",
            motion="watched",
            sample_rate=observed.rate or None,
            facts={"watched": address},
            tell=console.say,
        ) as writer:
            try:
                _record(source, writer, console)
            finally:
                writer.missed(observed.lost)
    _say_end(observed, log, console)
    return Watched(log, observed.samples, observed.set_points, observed.lost)


def _record(source: Any, writer: LogWriter, console: Console) -> None:
    """Until a signal; none comes between the arrival of a sample and its way to the log."""
    observed, heard = source.observed, time.monotonic()
    with suppress(KeyboardInterrupt, Ended):
        while True:
            with deferred():
                source.receive()
                block, points = observed.new_samples(time.time()), observed.new_set_points()
                if block is not None:
                    heard = time.monotonic()
                    writer.write(block)
                if points is not None:
                    writer.write_references(*points)
            silent = time.monotonic() - heard
            text = f"; no sample for {silent:.0f} s" if silent > _SILENT else ""
            console.progress(f"{observed.samples} samples, {observed.lost} lost{text}; Ctrl-C ends the recording")


def _say_start(source: Any, console: Console) -> None:
    observed = source.observed
    console.say(f"recording {len(observed.joints)} joints at {observed.rate:.1f} Hz: {', '.join(observed.joints)}")
    if observed.others:
        console.say(f"not recorded, of other groups: {', '.join(sorted(observed.others))}")
    if source.without:
        console.warn(f"no set-points in the log: {source.without}")
    elif not observed.set_points:
        state = source.target.name(source.target.controller, "controller_state")
        console.warn(f"no set-points so far: nothing readable on {state}; is the controller's name right?")


def _say_end(observed: Any, log: Path, console: Console) -> None:
    console.say(f"{log}: {observed.samples} samples at {observed.rate:.1f} Hz, {observed.set_points} set-points")
    if observed.lost:
        console.warn(
            f"{observed.lost} samples are missing by the stamps; the longest gap is {observed.longest:.3f} s. The "
            "robot did not publish them, or the network lost them"
        )
    if observed.clock_steps:
        console.warn(
            f"the stamps went back {observed.clock_steps} times: the robot's clock was set, or two nodes publish"
        )
    if observed.foreign:
        console.say(f"{observed.foreign} messages of other joints were left out")
    if observed.damaged:
        console.warn(f"{observed.damaged} messages were left out: they are damaged, or no JointState")
    if observed.unreadable:
        console.warn(
            f"{observed.unreadable} set-points were left out: the messages are of another ROS 2 distribution than Jazzy"
        )
