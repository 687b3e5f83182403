"""Record what was planned into a run folder: the excitation loop, then the validation motions."""

from __future__ import annotations

from pathlib import Path

from agent.core import Console, ControllerError, InputError, counted, sha256_file
from agent.link import MotionOfMany, Recording, RobotLink, open_link, report_losses
from agent.pipeline.plan import Plan, checked_chains, programs
from agent.recipe import Recipe
from agent.runs import RunFolder

EXCITATION = "excitation.mcap"


def record_plan(recipe: Recipe, plan: Plan, run: RunFolder, console: Console, logs: Path, yes: bool) -> list[Recording]:
    """Record one log per motion. Keeps finished logs; renames one that was cut short and records the motion again.

    Raises:
        InputError, ControllerError, SafetyError, DriverError: not ready to move, not allowed, or stopped while moving.
    """
    motions = {EXCITATION: plan.excitation}
    motions |= {f"validation_{k + 1:02d}.mcap": motion for k, motion in enumerate(plan.validation)}
    done = {name: found for name in motions if (found := _recorded(run, name))}
    missing = {name: motion for name, motion in motions.items() if name not in done}
    if missing:
        with open_link(recipe, console, yes, logs) as link:
            if done:
                _check_machine(run, link)
            run.note(serial=link.identity.serial)
            ready = programs(recipe, list(missing.values()), link.position())
            console.step(
                f"recording {counted(len(missing), 'motion')}, {sum(total for *_, total in ready):.0f} s in all"
            )
            left = sum(total for *_, total in ready)
            for (name, motion), (text, chains, total) in zip(missing.items(), ready, strict=True):
                _set_aside(run.file(name))
                left -= total
                place = MotionOfMany(f"motion {list(motions).index(name) + 1} of {len(motions)}, ", left)
                recording = link.run(motion.name, text, run.file(name), motion.kind, chains, place)
                done[name] = _keep(run, console, name, recording)
    return [done[name] for name in motions]


def record_program(
    link: RobotLink,
    run: RunFolder,
    recipe: Recipe,
    console: Console,
    text: str,
    path: str,
    motion: str,
    log: str,
    what: str,
) -> Recording:
    """Run the program `text` of the file `path` once from where the arm stands, and keep its log in the run folder.

    `motion` is its kind in the log, `what` its name for people.

    Raises:
        InputError: an approach or a loop breaks a limit.
        ControllerError, SafetyError, DriverError: not ready to move, or stopped while moving.
    """
    name, chains = checked_chains(recipe, text, path, link.position())
    console.step(f"recording {what}, {link.planned(name, text, chains).duration:.0f} s of motion")
    return _keep(run, console, log, link.run(name, text, run.file(log), motion, chains))


def _keep(run: RunFolder, console: Console, name: str, recording: Recording) -> Recording:
    report_losses(recording, console)
    run.finish(name, **recording.to_dict(), sha256=sha256_file(recording.path))
    return recording


def validation_logs(run: Path) -> list[Path]:
    """Logs of the validation motions in a run folder."""
    return sorted(run.glob("validation_[0-9][0-9].mcap"))


def _check_machine(run: RunFolder, link: RobotLink) -> None:
    known, here = run.state.get("serial"), link.identity.serial
    if known and here and known != here:
        raise ControllerError(
            f"{link.address}: this machine has serial {here}; the motions that {run.path.name} has recorded are of "
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
