"""A job that records: its run folder, the steps and motions in it, and what it comes to."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.core import AgentError, Console, ControllerError, InputError, counted, sha256_file
from agent.link import MotionOfMany, Recording, RobotLink, open_link, report_losses
from agent.pipeline.ending import ending_text, resume_advice
from agent.pipeline.planning.loop_program import LoopMotion
from agent.pipeline.planning.plan import Plan
from agent.pipeline.reports import refresh_index
from agent.recipe import Recipe
from agent.robot import not_judged_text
from agent.runs import RunFolder, approve
from agent.safety import Authorisation, PlannedProgram

EXCITATION = "excitation.mcap"


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a job came to: its run folder (None: nothing was done), its JSON document, and the same for people."""

    run: Path | None
    result: dict[str, Any]
    text: str

    @property
    def accepted(self) -> bool:
        """Whether no gate rejected the model; a gate that can judge no joint rejects none."""
        return self.result.get("accepted") is not False


@dataclass(frozen=True, eq=False)
class Job:
    """A recipe at work in a run folder.

    `yes` answers the question before the first motion; `allowed` permits motion while nobody is there.
    """

    recipe: Recipe
    run: RunFolder
    console: Console
    yes: bool = False
    allowed: Authorisation | None = None

    @classmethod
    def start(
        cls,
        kind: str,
        recipe: Recipe,
        console: Console,
        logs: Path,
        facts: Mapping[str, Any],
        yes: bool,
        allowed: Authorisation | None = None,
    ) -> Job:
        """A job in a new run folder below `logs`, with `facts` for its state.

        Raises:
            AgentError: the folder cannot be written.
        """
        run = RunFolder.create(logs, recipe.robot.name, recipe.path)
        run.note(kind=kind, **facts)
        approve(run, recipe)
        return cls(recipe, run, console, yes, allowed)

    @property
    def logs(self) -> Path:
        """Folder of the runs."""
        return self.run.path.parent

    def announce(self) -> None:
        """Name the run folder and the joints that the gate cannot judge."""
        self.console.say(f"run {self.run.path}")
        if not_judged := not_judged_text(self.recipe.robot, self.recipe.gate.normalised_rmse):
            self.console.warn(not_judged)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Note in the run folder whatever ends the run inside this step, and say how to go on.

        A step that an earlier start finished stays as it is.
        """
        try:
            yield
        except BaseException as error:
            try:
                self.run.stopped(name, str(error) or type(error).__name__)
            except AgentError as unsaved:  # a full disk: the message about the run still comes last
                self.console.warn(f"that it was stopped could not be noted: {unsaved}")
            self.console.warn(resume_advice(self.run, name, error))
            raise
        if self.run.finished(name) is None:
            self.run.finish(name)

    def record(self, plan: Plan) -> list[Recording]:
        """Record one log per motion. Keeps finished logs; renames one that was cut short and records it again.

        Raises:
            InputError, ControllerError, SafetyError, DriverError: not ready to move, not allowed, or stopped while
                moving.
        """
        run, console = self.run, self.console
        motions = {EXCITATION: plan.excitation}
        motions |= {f"validation_{k + 1:02d}.mcap": motion for k, motion in enumerate(plan.validation)}
        done = {name: earlier for name in motions if (earlier := _recorded(run, name))}
        missing = {name: motion for name, motion in motions.items() if name not in done}
        if missing:
            with open_link(self.recipe, console, self.yes, self.logs) as link:
                if done:
                    _check_machine(run, link)
                run.note(serial=link.identity.serial)
                ready = self._programs(link, missing.values())
                remaining = sum(program.duration for program in ready)
                console.step(f"recording {counted(len(missing), 'motion')}, {remaining:.0f} s in all")
                for (name, motion), program in zip(missing.items(), ready, strict=True):
                    _set_aside(run.file(name))
                    remaining -= program.duration
                    place = MotionOfMany(f"motion {list(motions).index(name) + 1} of {len(motions)}, ", remaining)
                    recording = link.run(program, run.file(name), motion.kind, place)
                    done[name] = self._keep(recording)
        return [done[name] for name in motions]

    def record_program(self, link: RobotLink, text: str, path: str, motion: str, log: str, what: str) -> Recording:
        """Run the program `text` of the file `path` once from where the arm stands, and keep its log in the run folder.

        `motion` is its kind in the log, `what` its name for people.

        Raises:
            InputError: an approach or a loop breaks a limit.
            ControllerError, SafetyError, DriverError: not ready to move, or stopped while moving.
        """
        program = link.plan(text, path)
        self.console.step(f"recording {what}, {program.duration:.0f} s of motion")
        return self._keep(link.run(program, self.run.file(log), motion))

    def _programs(self, link: RobotLink, motions: Iterable[LoopMotion]) -> list[PlannedProgram]:
        """Programs that run one after the other, all of them planned and checked before the first one moves."""
        programs, start = [], link.position()
        for motion in motions:
            path = f"{motion.name}{self.recipe.dialect.suffix}"
            programs.append(link.plan(motion.program, path, start))
            start = programs[-1].chains[-1].q[-1]
        return programs

    def _keep(self, recording: Recording) -> Recording:
        report_losses(recording, self.console)
        self.run.finish(recording.path.name, **recording.to_dict(), sha256=sha256_file(recording.path))
        return recording

    def end(self, result: dict[str, Any], text: str) -> Outcome:
        """Bring the page over all runs up to date, and add to `text` the current model and the next command."""
        refresh_index(self.logs, self.console)
        return Outcome(self.run.path, result, f"{text}\n{ending_text(self.run, self.recipe)}")


def validation_logs(run: Path) -> list[Path]:
    """Logs of the validation motions in a run folder."""
    return sorted(run.glob("validation_[0-9][0-9].mcap"))


def _check_machine(run: RunFolder, link: RobotLink) -> None:
    known, serial = run.state.get("serial"), link.identity.serial
    if known and serial and known != serial:
        raise ControllerError(
            f"{link.address}: this machine has serial {serial}; the motions that {run.path.name} has recorded are of "
            f"{known}, and one model is of one machine. Connect that one, or start a new run without --resume"
        )


def _recorded(run: RunFolder, name: str) -> Recording | None:
    entry = run.finished(name)
    if not entry or not run.file(name).exists():
        return None
    run.check_file(name, entry.get("sha256"))
    try:
        return Recording.from_dict(run.file(name), entry)
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{run.path}/state.json: what it says of {name} is damaged ({error}); start a new run"
        ) from None


def _set_aside(log: Path) -> None:
    """Rename a log that a stopped run left: it may be the only record of an incident."""
    number = 1
    while log.exists():
        aside = log.with_suffix(f".stopped{number}.mcap")
        if not aside.exists():
            log.rename(aside)
        number += 1
