"""Send a program, run it once and record its motion: one log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.console import Console
from agent.errors import ControllerError
from agent.recipe import Recipe
from agent.robot import RobotDescription
from agent.run import robot_lock, sha256_text
from agent.safety.preconditions import check_identity, check_ready, needs_person, not_confirmed
from drivers.errors import DriverError
from drivers.protocol import Driver, Identity

if TYPE_CHECKING:
    from agent.motion.trajectory import Trajectory


@dataclass(frozen=True)
class Recording:
    """What came of one motion. Durations in seconds of controller time."""

    path: Path
    samples: int
    lost: int
    duration: float
    cycle_starts: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data, but for the path."""
        return {key: value for key, value in asdict(self).items() if key != "path"}

    @classmethod
    def from_dict(cls, path: Path, data: dict[str, Any]) -> Recording:
        """The inverse of `to_dict`; other keys are left alone."""
        cycles = tuple(data["cycle_starts"])
        return cls(path, data["samples"], data["lost"], data["duration"], cycles)


class Link:
    """An open controller link that has passed identification and, where one is needed, a person's word."""

    def __init__(self, driver: Driver, identity: Identity, robot: RobotDescription, address: str, console: Console):
        self.driver = driver
        self.identity = identity
        self.robot = robot
        self.address = address
        self._console = console

    def position(self) -> np.ndarray:
        """(n,) where the arm stands now [rad]."""
        return np.asarray(self.driver.status().position, dtype=float)

    def run(
        self, name: str, text: str, log: Path, motion: str, chains: Sequence[Trajectory], total: float
    ) -> Recording:
        """Upload, check, start once, and record until the program ends.

        Args:
            chains: what we planned from stop to stop, in order: written to the log beside the set-points.
            total: expected duration [s], for the progress line.

        Raises:
            ControllerError, SafetyError: not ready to move, or stopped while moving.
            DriverError: the link failed; what was received is in the log.
        """
        from agent.recording import LogWriter

        checksum = self.driver.upload(name, text)
        if checksum != sha256_text(text):
            raise ControllerError(
                f"{self.address}: the controller stored another text than program {name!r} that was sent"
            )
        check_ready(self.driver.status(), self.address, name, checksum)
        aligner = _Aligner(chains, self.identity.period)
        with LogWriter(
            log,
            self.robot.joint_names,
            robot=self.robot.name,
            motion=motion,
            sample_rate=1.0 / self.identity.period,
        ) as writer:
            try:
                self.driver.start(name, checksum)
                for block in self.driver.samples():
                    writer.write(block)
                    aligner.take(block.time, block.reference_position)
                    self._console.progress(f"{motion}: {aligner.elapsed:6.1f} of about {total:.0f} s of motion")
            except BaseException:
                with suppress(DriverError):
                    self.driver.stop()
                raise
            finally:
                for start in aligner.finish(writer.write_planned):
                    writer.cycle_start(start)
        return Recording(log, aligner.samples, writer.lost, aligner.elapsed, tuple(aligner.cycle_starts))


@contextmanager
def open_link(recipe: Recipe, robot: RobotDescription, console: Console, yes: bool) -> Iterator[Link]:
    """Lock the robot, connect, and check who is there; the arm is stopped if anything goes wrong inside.

    Raises:
        BusyError: another run holds this robot.
        ControllerError: another robot, or another period than the recipe's rate.
        DriverError: nobody there, silent, or another protocol.
    """
    from drivers.registry import create

    address = recipe.controller.address
    with robot_lock(recipe.controller.driver, address):
        driver = create(recipe.controller.driver, address)
        try:
            driver.connect()
            identity = driver.identify()
            check_identity(identity, robot, address)
            if abs(identity.period * recipe.record.rate - 1.0) > 1e-6:
                raise ControllerError(
                    f"{address}: the controller samples at {1 / identity.period:g} Hz, the recipe asks for "
                    f"{recipe.record.rate:g} Hz: change record.rate"
                )
            console.detail(f"{identity.robot}, serial {identity.serial}, {identity.controller} {identity.version}")
            if needs_person(driver.status(), address) and not yes:
                question = (
                    f"{identity.robot} (serial {identity.serial}) at {address} is about to move. Is the cell clear?"
                )
                if not console.confirm(question):
                    raise not_confirmed(address)
            yield Link(driver, identity, robot, address, console)
        finally:
            driver.close()


def record_program_file(recipe: Recipe, program: Path, log: Path, console: Console, yes: bool) -> Recording:
    """Run a PDL2 program that somebody wrote, and record it.

    Raises:
        InputError: the program cannot be parsed or planned, or the log exists.
    """
    from agent.errors import InputError
    from agent.planning import check_motion, plan_statements
    from agent.recording.log import motion_name

    if log.exists():
        raise InputError(f"{log}: exists already; name another log with -o")
    try:
        text = program.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{program}: cannot be read: {error}") from None
    with open_link(recipe, recipe.robot, console, yes) as link:
        name, chains = plan_statements(recipe, text, str(program), link.position())
        for chain in chains:
            check_motion(recipe, chain)
        total = sum(chain.duration for chain in chains)
        recording = link.run(name, text, log, motion_name(program), chains, total)
    report_losses(recording, console)
    return recording


def report_losses(recording: Recording, console: Console) -> None:
    """Say what the link lost; silence means nothing was."""
    if recording.lost:
        console.warn(
            f"{recording.path.name}: {recording.lost} of {recording.samples + recording.lost} samples were lost"
        )


class _Aligner:
    """Lays what we planned, from stop to stop, onto the controller's set-points.

    The controller waits for the arm to settle at each stop, so only the stretches between stops are comparable in
    time. Where the numbers of stretches differ there is nothing to compare, and nothing is written.
    """

    #: Shortest rest [s] of the set-points that counts as a stop.
    REST = 0.006
    #: An approach shorter than this [rad, m] is where the arm rests off its set-point; the controller makes none.
    THERE = 1e-3

    def __init__(self, chains: Sequence[Trajectory], period: float):
        self._chains = chains
        self._period = period
        self._times: list[np.ndarray] = []
        self._references: list[np.ndarray] = []
        self.samples = 0
        self.cycle_starts: list[float] = []

    def take(self, time: np.ndarray, reference: np.ndarray) -> None:
        self._times.append(np.asarray(time))
        self._references.append(np.asarray(reference))
        self.samples += len(time)

    @property
    def elapsed(self) -> float:
        return float(self._times[-1][-1] - self._times[0][0]) if self.samples else 0.0

    def finish(self, write_planned: Callable[[np.ndarray, np.ndarray, np.ndarray], None]) -> list[float]:
        """Write the planned set-points; returns the controller times at which cycles start (all but the approach)."""
        if not self.samples:
            return []
        time = np.concatenate(self._times)
        stretches = moving_stretches(np.concatenate(self._references), round(self.REST / self._period))
        chains, approaches = self._chains, 1
        if len(stretches) == len(chains) - 1 and np.ptp(chains[0].q, axis=0).max() < self.THERE:
            chains, approaches = chains[1:], 0  # the arm stood at the first point already
        if len(stretches) != len(chains):
            return []
        for (start, _), chain in zip(stretches, chains, strict=True):
            stop = min(start + len(chain.t), len(time))
            write_planned(time[start:stop], chain.q[: stop - start], chain.qd[: stop - start])
        self.cycle_starts = [float(time[start] - time[0]) for start, _ in stretches[approaches:]]
        return [float(time[start]) for start, _ in stretches[approaches:]]


def moving_stretches(reference: np.ndarray, rest: int) -> list[tuple[int, int]]:
    """[start, stop) ranges of (S, n) set-points between rests of at least `rest` samples.

    A range starts at the last sample before the first change and ends after the last change.
    """
    if len(reference) < 2:
        return []
    changes = np.flatnonzero(np.any(np.diff(reference, axis=0) != 0.0, axis=1))
    if len(changes) == 0:
        return []
    splits = np.flatnonzero(np.diff(changes) > rest)
    starts = np.concatenate([[changes[0]], changes[splits + 1]])
    stops = np.concatenate([changes[splits], [changes[-1]]]) + 2
    return [(int(a), int(b)) for a, b in zip(starts, stops, strict=True)]
