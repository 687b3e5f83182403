"""Send a program, run it once and record its motion: one log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import LARGEST_PROGRAM, Console, InputError, read_text
from agent.link.alignment import Aligner
from agent.link.controller import create_driver, torque_facts
from agent.link.effort import check_effort
from agent.link.planning import interpolator_of, plan_program, torque_limits
from agent.recipe import Recipe
from agent.runs import robot_lock
from agent.safety import (
    FILE,
    FIRST_SPEED,
    CheckedPrograms,
    GuardedLink,
    Permission,
    PlannedProgram,
    Surroundings,
    slow_text,
)
from drivers.protocol import Identity, SampleBlock

if TYPE_CHECKING:
    from agent.robot import TorqueLimits
    from agent.safety import Authorisation


@dataclass(frozen=True)
class Recording:
    """Result of one motion. Durations in seconds of controller time.

    `temperatures`: of the motors [°C] when it began and when it ended, where the controller measures them.
    """

    path: Path
    samples: int
    lost: int
    duration: float
    cycle_starts: tuple[float, ...]
    temperatures: tuple[tuple[float, ...], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain data, except for the path."""
        return {key: value for key, value in asdict(self).items() if key != "path"}

    @classmethod
    def from_dict(cls, path: Path, data: dict[str, Any]) -> Recording:
        """The inverse of `to_dict`; other keys are left alone."""
        cycles = tuple(data["cycle_starts"])
        temperatures = tuple(tuple(values) for values in data.get("temperatures", ()))
        return cls(path, data["samples"], data["lost"], data["duration"], cycles, temperatures)


@dataclass(frozen=True)
class MotionOfMany:
    """Progress of one motion among others: the `text` before its progress, and the motion time after it [s]."""

    text: str = ""
    after: float = 0.0


class RobotLink:
    """An open controller link behind its guard, and the logs of what runs through it."""

    def __init__(
        self,
        guard: GuardedLink,
        recipe: Recipe,
        console: Console,
        facts: dict[str, str],
        limits: TorqueLimits | None = None,
    ):
        self._guard = guard
        self._recipe = recipe
        self._console = console
        self._facts = facts  # for the logs: how torque is obtained, and what else is known
        self._limits = limits  # with a mass at the flange

    @property
    def identity(self) -> Identity:
        """Who is at the far end."""
        return self._guard.identity

    @property
    def address(self) -> str:
        """Address of the controller."""
        return self._guard.address

    @property
    def _machine(self) -> dict[str, str]:
        """Machine and tool of the motion, for the logs: logs of another machine or tool belong to another model."""
        who, tool = self.identity, self._recipe.tool
        controller = f"{who.controller} {who.version}".strip()
        facts = {"serial": who.serial, "tool": "none" if tool is None else tool.text(), "controller": controller}
        return {key: value for key, value in facts.items() if value}

    def position(self) -> np.ndarray:
        """(n,) where the arm stands now [rad]."""
        return self._guard.position()

    def plan(self, text: str, path: str, start: np.ndarray | None = None, stands_for: str = "") -> PlannedProgram:
        """`plan_program` for this link, from where the arm stands now or from another `start` (n,).

        Raises:
            InputError: the program, or its way to the first point, breaks a limit.
        """
        from agent.motion import tool_frame, via_points

        recipe = self._recipe
        start = self.position() if start is None else start
        program = plan_program(recipe, text, path, start, self._limits, stands_for)
        if not self._guard.takes_points:
            return program
        # The points are joint positions, and the straight lines between them the tool's.
        return replace(
            program,
            points=via_points(program.name, program.statements, program.chains, recipe.robot, recipe.tool),
            frames={recipe.dialect.frame_names["tool"]: tool_frame(recipe.tool)},
        )

    def run(self, program: PlannedProgram, log: Path, motion: str, place: MotionOfMany = MotionOfMany()) -> Recording:
        """Upload, check, start once, and record until the program ends.

        A program that is new to a machine runs slowly first, into a separate log.

        Args:
            program: what `plan` returned; its set-points are written to the log together with the controller's.
            `place`: index of this motion in the run, for the progress line.

        Raises:
            ControllerError, SafetyError, InputError: not ready to move, not allowed, or stopped while moving.
            DriverError: the link failed; what was received is in the log.
        """
        if self._guard.needs_slow_run(program):
            program = self._run_slowly(program, log)
        return self._record(program, log, motion, place)

    def _run_slowly(self, program: PlannedProgram, log: Path) -> PlannedProgram:
        """Run the slow version; returns the program planned anew, from where the arm stands now."""
        recipe, start = self._recipe, self.position()
        text = slow_text(program, recipe.robot, recipe.dialect, interpolator_of(recipe), start)
        slow = self.plan(text, f"first run of {program.name}", start, stands_for=program.checksum)
        self._console.step(
            f"{program.name} is new to serial {self.identity.serial}: first at no more than {FIRST_SPEED:g} m/s, "
            f"{slow.duration:.0f} s of motion; watch it"
        )
        self._record(slow, _free(log.with_suffix(".first_run.mcap")), "first_run")
        return self.plan(program.text, program.name)

    def _record(
        self, program: PlannedProgram, log: Path, motion: str, place: MotionOfMany = MotionOfMany()
    ) -> Recording:
        from agent.recording import LogWriter

        guard, robot, total = self._guard, self._recipe.robot, program.duration
        guard.send(program)
        aligner = Aligner(program.chains, self.identity.period, program.approaches)
        limits = {"watch_only": self.identity.watch_only} if self.identity.watch_only else {}
        try:
            with LogWriter(
                log,
                robot.joint_names,
                robot=robot.name,
                motion=motion,
                sample_rate=1.0 / self.identity.period,
                facts={**self._machine, **self._facts, **limits},
                tell=self._console.say,
            ) as writer:

                def keep(block: SampleBlock) -> None:
                    writer.write(block)
                    aligner.take(block.time, block.reference_position)

                try:
                    with guard.motion(program, keep) as samples:
                        for block in samples:
                            keep(block)
                            self._console.progress(
                                f"{place.text}{motion}: {aligner.elapsed:6.1f} of about {total:.0f} s of motion, "
                                f"{max(0.0, total - aligner.elapsed) + place.after:.0f} s left in all"
                            )
                finally:
                    writer.note(guard.facts)
                    writer.missed(guard.lost)
                    writer.write_temperatures(guard.temperatures)
                    for start in aligner.finish(writer.write_planned):
                        writer.cycle_start(start)
        except BaseException:
            if aligner.samples:
                self._console.warn(f"{log}: holds the {aligner.samples} samples up to the stop")
            raise
        finally:
            if aligner.samples == 0:
                log.unlink(missing_ok=True)  # there is nothing to look at
        felt = [tuple(values.tolist()) for _, values in guard.temperatures]
        ends = (felt[0], felt[-1]) if felt else ()
        return Recording(log, aligner.samples, writer.lost, aligner.elapsed, tuple(aligner.cycle_starts), ends)


@contextmanager
def open_link(
    recipe: Recipe,
    console: Console,
    yes: bool,
    runs: Path,
    authorisation: Authorisation | None = None,
    watching: bool = False,
    facts: Mapping[str, str] = MappingProxyType({}),
    limits: TorqueLimits | None = None,
) -> Iterator[RobotLink]:
    """Lock the robot, connect, and check who is there.

    Args:
        runs: folder with the list of programs that have had their slow first run.
        authorisation: written permission for unattended motion.
        watching: nothing will be identified from the recording.
        facts: further facts for the logs.
        limits: torque limits that programs are checked against, where a mass is at the flange.

    Raises:
        BusyError: another run holds this robot.
        ControllerError: another robot, another period than the recipe's rate, or samples that are too few.
        InputError: nobody confirmed that the cell is clear.
        DriverError: nobody there, silent, or another protocol.
    """
    controller = recipe.controller
    with robot_lock(controller.driver, controller.address):
        driver = create_driver(recipe, console.say)
        guard = GuardedLink(
            driver,
            recipe.robot,
            controller.public_address,
            recipe.record.rate,
            Permission(CheckedPrograms(runs / FILE), yes, authorisation, watching),
            console.confirm,
            console.warn,
            Surroundings(recipe.tool, recipe.motion.settings.fly_distance),
        )
        try:
            guard.open()
            who = guard.identity
            console.detail(f"{who.robot}, serial {who.serial}, {who.controller} {who.version}")
            if remark := check_effort(driver, recipe.robot, recipe.tool, controller.public_address):
                console.warn(remark)
            yield RobotLink(guard, recipe, console, {**torque_facts(recipe, driver), **facts}, limits)
        finally:
            guard.close()


def record_program_file(
    recipe: Recipe,
    program: Path,
    log: Path | None,
    console: Console,
    yes: bool,
    runs: Path = Path("logs"),
    payload: str | None = None,
) -> Recording:
    """Run a program that a person wrote, and record it (None: next to it, as .mcap); `runs` as in `open_link`.

    `payload` is a mass that is mounted at the flange on purpose; the log contains it.

    Args:
        recipe: of robot, controller, cell and speed.
        program: file in the dialect of the driver.
        log: to write; None: next to the program.
        console: where progress is shown, and questions are asked.
        yes: whether motion may begin without a question.
        runs: folder of runs.
        payload: mass at the flange, as of `--payload`.

    Raises:
        InputError: the program cannot be parsed or planned, or the log exists; a payload that is none, or a motion
            that was planned with another, or with one that nobody has confirmed.
    """
    from agent.link.mounted_mass import check_payload, known_of
    from agent.model import known_payload

    if program.is_dir():
        raise InputError(f"{program}: is a folder; name the program to run with --program")
    log = log or program.with_suffix(".mcap")
    if log.exists():
        raise InputError(f"{log}: exists already; name another log with -o")
    text = read_text(program, LARGEST_PROGRAM)
    facts = known_of(program, text, payload, console.confirm)
    load = known_payload(facts)
    if load is not None:
        check_payload(recipe.robot, recipe.tool, load)
    limits = None if load is None else torque_limits(recipe, load, console)
    with open_link(recipe, console, yes, runs, watching=True, facts=facts, limits=limits) as link:
        planned = link.plan(text, str(program))
        if not planned.chains:
            raise InputError(f"{program}: the program moves nothing, so there is nothing to record; add a MOVE")
        recording = link.run(planned, log, program.stem)
    report_losses(recording, console)
    return recording


def _free(path: Path) -> Path:
    """The path, with a number appended if the file exists already."""
    free, number = path, 1
    while free.exists():
        number += 1
        free = path.with_suffix(f".{number}{path.suffix}")
    return free


def report_losses(recording: Recording, console: Console) -> None:
    """Say what the link lost; nothing if there was no loss."""
    if recording.lost:
        console.warn(
            f"{recording.path.name}: {recording.lost} of {recording.samples + recording.lost} samples were lost"
        )
