"""A timer for `agent recalibrate`: a systemd service with its timer, or a line for cron.

A robot must never start to move because a computer was switched on. So the timer goes by the calendar alone
(`OnCalendar`, no `OnBootSec`) and skips runs missed while the computer was off (`Persistent=false`). cron does the
same; do not use anacron, which does not. `agent recalibrate` itself decides whether a run is due, so the timer may
call more often than the recipe's interval.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from agent.core import InputError, read_text, write_atomically
from agent.recipe import Recipe
from agent.runs import make_folder

_HOUR = 3600.0
_DAY = 24 * _HOUR
_LARGEST_UNIT = 1 << 20  # bytes


@dataclass(frozen=True)
class Schedule:
    """Texts of the units and the line for cron; `name` is the units' without their ending."""

    name: str
    service: str
    timer: str
    crontab: str

    def text(self) -> str:
        """Text for a terminal."""
        return (
            f"# {self.name}.service\n{self.service}\n# {self.name}.timer\n{self.timer}\n"
            f"# or, without systemd, a line for crontab -e\n{self.crontab}\n"
        )


def make_schedule(recipe: Recipe, logs: Path, folder: Path, at: str, authorisation: Path | None) -> Schedule:
    """Units and crontab line for a recipe.

    Parameters
    ----------
    logs : folder of the runs.
    folder : working folder of the agent, whose `logs` hold the loops.
    at : local time of day, HH:MM.
    authorisation : file that permits unattended motion.

    Raises
    ------
    InputError : not a time of day, an interval below an hour, or a name that no unit and no crontab can hold.
    """
    match = re.fullmatch(r"([01]?\d|2[0-3]):([0-5]\d)", at)
    if match is None:
        raise InputError(f"--at {at}: a time of day is expected, as 02:30")
    hour, minute = int(match[1]), int(match[2])
    every = recipe.recalibrate.every
    if every < _HOUR:
        raise InputError(f"{recipe.path}: recalibrate.every is {every:g} s; a schedule is for an hour or more")
    hourly = every < _DAY
    words = [sys.executable, "-m", "agent", "recalibrate", str(recipe.path.resolve()), "--logs", str(logs.resolve())]
    words += ["--quiet"]
    if authorisation is not None:
        words += ["--authorisation", str(authorisation.resolve())]
    name = "calibration-agent-" + re.sub(r"[^A-Za-z0-9_.-]", "-", recipe.path.stem)
    folder = folder.resolve()
    for word in (*words, str(folder), recipe.robot.name):
        _check_word(word)
    service = _unit("service").format(
        robot=_escaped(recipe.robot.name),
        recipe=_escaped(recipe.path.name),
        folder=_escaped(str(folder)),
        command=" ".join(_quoted(word) for word in words),
    )
    calendar = f"*-*-* *:{minute:02d}:00" if hourly else f"*-*-* {hour:02d}:{minute:02d}:00"
    when = f"{minute} * * * *" if hourly else f"{minute} {hour} * * *"
    command = f"cd {shlex.quote(str(folder))} && {shlex.join(words)}".replace("%", r"\%")
    return Schedule(name, service, _unit("timer").format(name=name, when=calendar), f"{when} {command}")


def _unit(kind: str) -> str:
    return (files("agent.pipeline.setup") / "assets" / f"recalibrate.{kind}").read_text(encoding="utf-8")


def install(schedule: Schedule, folder: Path | None = None) -> list[Path]:
    """Write the units where the user's systemd looks for them; nothing is started by that.

    Raises:
        InputError: units of this name are there already, for another recipe.
        AgentError: they cannot be written.
    """
    folder = folder or Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "systemd" / "user"
    make_folder(folder, "the units")
    service = folder / f"{schedule.name}.service"
    if service.exists() and _recipe_of(read_text(service, _LARGEST_UNIT)) != _recipe_of(schedule.service):
        raise InputError(f"{service}: is there already, for another recipe; rename this recipe, or delete those units")
    units = {f"{schedule.name}.service": schedule.service, f"{schedule.name}.timer": schedule.timer}
    return [write_atomically(folder / name, text) for name, text in units.items()]


def next_steps(schedule: Schedule) -> str:
    """Commands to run after `install`."""
    return (
        f"systemctl --user daemon-reload && systemctl --user enable --now {schedule.name}.timer\n"
        "loginctl enable-linger    # so that it also runs while nobody is logged in"
    )


def _recipe_of(service: str) -> str:
    """The recipe as a unit names it; the whole text of a unit that is not ours."""
    command = re.search(r"^ExecStart=.* recalibrate (.+) --logs ", service, re.M)
    return command[1] if command else service


def _check_word(word: str) -> None:
    """Units and crontabs are read by lines: a line feed in a name would be a directive, or a command, of its own."""
    if not word.isprintable() or word.endswith("\\"):
        raise InputError(
            f"{word!r}: a name with control characters, or a backslash at its end, cannot stand in a unit or a "
            "crontab; rename it"
        )


def _escaped(text: str) -> str:
    """A value of a unit file: % introduces a specifier there."""
    return text.replace("%", "%%")


def _quoted(word: str) -> str:
    """One word of ExecStart."""
    if re.fullmatch(r"[A-Za-z0-9_./:=@+-]+", word):
        return word
    return '"' + _escaped(word.replace("\\", "\\\\").replace('"', '\\"').replace("$", "$$")) + '"'
