"""The only way from the pipeline to a moving arm: every condition before motion, and the watch while it moves.

A program is sent once and started once. Whatever ends the motion early - an error, any signal (`agent.core.signals`),
a full disk, the consumer leaving - asks the controller for a stop on the path first. Where that is not confirmed, or
the arm is not seen to stand, the link is closed, and the controller's own watchdog stops the arm.
"""

from __future__ import annotations

import gc
import json
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from agent.core import ControllerError, InputError, SafetyError, stop_to_come, undisturbed
from agent.robot import RobotDescription
from agent.safety.adherence import Adherence
from agent.safety.first_run import FIRST_SPEED, CheckedPrograms
from agent.safety.planned_program import PlannedProgram, standstill_plan
from agent.safety.preconditions import (
    check_frames,
    check_identity,
    check_period,
    check_plan,
    check_ready,
    check_throughput,
    confirm_clear_cell,
    reported_position,
)
from agent.safety.stopping import STOP_ANSWER_TIMEOUT
from agent.safety.watch import MotionWatch
from drivers.errors import DriverError, RefusedError
from drivers.protocol import (
    AcceptsViaPoints,
    Driver,
    Identity,
    ListensFirst,
    ReportsDiagnostics,
    SampleBlock,
)

if TYPE_CHECKING:
    from agent.robot import Tool
    from agent.safety.authorisation import Authorisation

_AFTER_MOTION = "make sure that the arm rests, put that right, then run the command again"


@dataclass(frozen=True)
class Permission:
    """Who said that the arm may move.

    `checked`: programs that have had their slow first run. `yes`: a person said before that the cell is clear.
    `authorisation`: what a person wrote down for when nobody is there. `watching`: the samples are for looking at, so a
    link that delivers too little to identify from will do.
    """

    checked: CheckedPrograms
    yes: bool = False
    authorisation: Authorisation | None = None
    watching: bool = False


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What plans are made for: a tool, and how far from its plan that may be where the cell was checked [m]."""

    tool: Tool | None = None
    margin: float = 0.0


class GuardedLink:
    """A controller link that nothing moves through unchecked.

    Args:
        driver: not connected yet.
        robot: what the recipe is for.
        address: for messages, and to tell whether an emulator is on this machine.
        rate: of samples [Hz] that the recipe asks for.
        permission: who said that the arm may move.
        ask: puts a question to a person; True is yes.
        warn: tells what a person should know.
        surroundings: what the plans are made for.
        clock: seconds, for the watch.
    """

    def __init__(
        self,
        driver: Driver,
        robot: RobotDescription,
        address: str,
        rate: float,
        permission: Permission,
        ask: Callable[[str], bool],
        warn: Callable[[str], None],
        surroundings: Surroundings = Surroundings(),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.robot = robot
        self.address = address
        self._driver = driver
        self._rate = rate
        self._permission = permission
        self._ask = ask
        self._warn = warn
        self._surroundings = surroundings
        self._clock = clock
        self._identity: Identity | None = None
        self._emulator = False
        self._watch: MotionWatch | None = None  # of a motion in which the arm may still move
        #: (controller time [s], (n,) [°C]) of the last motion, where the controller measures temperatures.
        self.temperatures: list[tuple[float, np.ndarray]] = []
        self._changes: list[tuple[float, str, str, str]] = []  # of what is set at the controller, in the last motion

    @property
    def identity(self) -> Identity:
        """Identity of the controller."""
        assert self._identity is not None, "open() comes first"
        return self._identity

    @property
    def takes_points(self) -> bool:
        """Whether programs go to this controller as via-points."""
        return isinstance(self._driver, AcceptsViaPoints)

    def open(self) -> None:
        """Connect, see who is there, and have a person confirm where that is needed.

        Raises:
            ControllerError: another robot, another period than the recipe's rate, samples that are too few, or nobody
                there where the arm would go on without this end.
            InputError: nobody confirmed that the cell is clear.
            DriverError: nobody there, silent, or another protocol.
        """
        with self._advice("check that the controller is on and reachable, then run the command again"):
            self._driver.connect()
            identity, status = self._driver.identify(), self._driver.status()
        check_identity(identity, self.robot, self.address)
        if not identity.watch_only:
            check_period(identity, self._rate, self.address)
        elif not self._permission.watching:
            raise ControllerError(f"{self.address}: {identity.watch_only}; agent record can watch as it is")
        else:
            self._warn(f"{self.address}: {identity.watch_only}")
        check_throughput(self._driver, identity, self.address)
        if identity.unguarded and self._permission.authorisation is not None:
            raise ControllerError(f"{self.address}: {identity.unguarded}; somebody has to stand by")
        if identity.unguarded:
            self._warn(f"{self.address}: {identity.unguarded}; stay at the emergency stop")
        if self._permission.authorisation is None and not self._permission.yes:
            confirm_clear_cell(identity, status, self.address, self._ask)
        self._identity, self._emulator = identity, status.emulator

    def position(self) -> np.ndarray:
        """(n,) where the arm stands now [rad]."""
        with self._advice("check the link, then run the command again"):
            status = self._driver.status()
        return reported_position(status, self.robot, self.address)

    @property
    def _is_unwatched(self) -> bool:
        """Whether a motion is authorised that nobody has watched, and nobody watches now."""
        return self._permission.authorisation is not None and self._permission.authorisation.unseen

    def needs_slow_run(self, program: PlannedProgram) -> bool:
        """Whether the program has to run slowly first: a machine, and a program that is new to it.

        Raises:
            InputError: it has to, and nobody is there to watch.
        """
        if self._emulator or self._permission.checked.has(self.identity.serial or self.address, program.checksum):
            return False
        if self._is_unwatched:
            if not program.speed <= FIRST_SPEED:
                raise InputError(
                    f"{self.address}: program {program.name!r} is new, and it reaches {program.speed:.2f} m/s; with "
                    f"nobody there a new motion runs at no more than {FIRST_SPEED:g} m/s"
                )
            return False
        if self._permission.authorisation is not None:
            raise InputError(
                f"{self.address}: program {program.checksum[:12]}… has never run on serial {self.identity.serial} with "
                f"somebody watching ({self._permission.checked.path} does not list it); run it once with --yes and no "
                "authorisation"
            )
        return not program.speed <= FIRST_SPEED

    def send(self, program: PlannedProgram) -> None:
        """Store the program at the controller, and see that everything allows it to run.

        Raises:
            SafetyError: the emergency stop is pressed.
            ControllerError: something else is not as it must be.
            InputError: nobody has allowed this motion.
            DriverError: refused, or the link failed.
        """
        with self._advice("put that right at the controller, then run the command again"):
            checksum = self._hand_over(program)
        if checksum != program.checksum:
            raise ControllerError(
                f"{self.address}: the controller stored another text than program {program.name!r} that was sent; "
                "delete the program there, check the controller's memory, then run the command again"
            )
        self._check(program)

    @contextmanager
    def motion(
        self, program: PlannedProgram, keep: Callable[[SampleBlock], object] = lambda block: None
    ) -> Iterator[Iterator[SampleBlock]]:
        """Start the program that was sent, once, and hand out its samples until the arm rests.

        Leaving the block before the samples end stops the arm; `keep` takes the samples of that stop.

        Raises:
            SafetyError: as in `send`, or the state changed while the arm moved, or it did not obey a stop.
            ControllerError, InputError: as in `send`; nothing has moved. Or the link is too slow to watch the arm.
            DriverError: refused, or the link failed; what was received has been handed out.
        """
        position = self._check(program)
        plan = program.chains or (standstill_plan(position),)
        period = self.identity.period
        adherence = Adherence(
            plan, self.robot, self._surroundings.tool, self._surroundings.margin, period, program.longest_rest
        )
        watch = MotionWatch(
            self._driver, self.robot, self.address, period, adherence, program.longest, self._clock, self._warn
        )
        self.temperatures, self._changes = watch.temperatures, watch.changes
        over = False
        lost: DriverError | None = None

        def watched() -> Generator[SampleBlock, None, None]:
            nonlocal over
            with suppress(*(DriverError,) if lost else ()):  # it only repeats what was lost
                yield from watch.samples()
            if lost is not None:
                raise lost
            over = True

        samples = watched()
        gc.freeze()  # all that is here stays: to look through it again takes up to a second, in which nobody watches
        # Closed last, after any stop, and here: whoever keeps an error keeps what is left of the samples with it, and
        # a watch that ends with the interpreter would wait for a thread that is gone.
        with closing(samples), stop_to_come():
            self._watch = watch
            try:
                with self._advice(_AFTER_MOTION, _AFTER_MOTION):
                    lost = self._start(program, watch)
                    yield samples
            except RefusedError:
                raise
            except BaseException as error:
                if not over:
                    self._settle(watch, samples, keep, error)
                raise
            else:
                if not over:
                    self._settle(watch, samples, keep)
            finally:
                self._watch = None
        if (
            over and program.chains and not self._emulator and not self._is_unwatched
        ):  # it moved, slowly or known before
            self._permission.checked.add(self.identity.serial or self.address, program.stands_for or program.checksum)

    def _start(self, program: PlannedProgram, watch: MotionWatch) -> DriverError | None:
        """Start a program while its samples are judged; returns why it failed where the arm may be moving all the same.

        Raises:
            RefusedError: the controller did not start it, and its samples, if any, show a stationary arm.
        """
        if isinstance(self._driver, ListensFirst):
            self._driver.listening = watch.listen
        try:
            watch.read_settings(-np.inf)
            self._driver.start(program.name, program.checksum)
        except DriverError as error:
            if isinstance(error, RefusedError):
                watch.settle(STOP_ANSWER_TIMEOUT)
                if watch.stopping.since is None:
                    raise
            watch.stopped = True  # what came of that is kept, and judged
            watch.stopping.request()
            watch.stopping.wait(STOP_ANSWER_TIMEOUT)
            return error
        return None

    @property
    def lost(self) -> int:
        """Samples of the last motion that never came, from its first to its last."""
        return sum(gap.count for gap in self._driver.gaps)

    @property
    def facts(self) -> dict[str, str]:
        """What is known of the last motion beyond its samples."""
        facts = dict(self._driver.facts) if isinstance(self._driver, ReportsDiagnostics) else {}
        if self._changes:
            keys = ("time_s", "setting", "before", "after")
            facts["controller_changes"] = json.dumps([dict(zip(keys, change, strict=True)) for change in self._changes])
        return facts

    def close(self) -> None:
        """Close the link; the arm is stopped first, where something has kept that from happening. Never raises."""
        watch, self._watch = self._watch, None
        if watch is not None:
            for _ in watch.drain():
                pass
        self._driver.close()
        gc.unfreeze()

    def _hand_over(self, program: PlannedProgram) -> str:
        """The checksum (SHA-256, hex) of what the controller would run."""
        if not isinstance(self._driver, AcceptsViaPoints):
            return self._driver.upload(program.name, program.text)
        self._driver.load(program.name, program.checksum, program.points)
        return program.checksum

    def _check(self, program: PlannedProgram) -> np.ndarray:
        """Everything that must be so before a start; returns (n,) where the arm stands."""
        if self._permission.authorisation is not None:
            self._permission.authorisation.check(
                self.robot.name, self.identity.serial, program.checksum, program.speed, program.duration
            )
        if self.needs_slow_run(program):
            raise ControllerError(
                f"{self.address}: program {program.name!r} has never run on serial {self.identity.serial}; its first "
                f"run must not exceed {FIRST_SPEED:g} m/s, this one reaches {program.speed:.2f} m/s"
            )
        with self._advice("check the link, then run the command again"):
            status = self._driver.status()
            check_ready(status, self.address, program.name, program.checksum)
            position = reported_position(status, self.robot, self.address)
            check_plan(program, self.robot, position, self.address)
            check_frames(program.name, program.frames, self._driver, self.address)
        return position

    def _settle(
        self,
        watch: MotionWatch,
        samples: Generator[SampleBlock, None, None],
        keep: Callable[[SampleBlock], object],
        error: BaseException | None = None,
    ) -> None:
        """Stop the arm and follow it until it stands, or the link is closed.

        Raises:
            SafetyError: it did not obey.
        """
        with undisturbed():
            watch.stopping.request()
            samples.close()
            for block in () if watch.stopping.over else watch.drain():
                with suppress(Exception):  # a disk that is full, most likely: the arm is followed all the same
                    keep(block)
        if watch.stopping.disobeyed and not isinstance(error, SafetyError):
            raise SafetyError(f"{self.address}: {watch.stopping.failure}") from error
        if not (error is None or isinstance(error, Exception) or watch.stopping.failure):  # somebody ended the program
            self._warn(f"{self.address}: the arm was stopped and stands; the log of this motion ends here")

    @contextmanager
    def _advice(self, remedy: str, if_asked: str = "put that right, then run the command again") -> Iterator[None]:
        """Errors of the driver leave with what to do about them; some ask after it already."""
        try:
            yield
        except DriverError as error:
            advice = f" {if_asked[0].upper()}{if_asked[1:]}" if error.asks else f"; {remedy}"
            raise type(error)(f"{error}{advice}") from None
