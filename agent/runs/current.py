"""The robot's current model: a link to one of its versions.

`logs/models/<robot>_<serial>/versions/<number>/` holds `model.json` and `about.json` and never changes. `current` is a
link to one of them and is replaced by a rename, so `logs/models/<robot>_<serial>/current/model.json` is always
complete. Nothing here writes to a controller.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from agent.core import AgentError, Console, InputError, read_json, sha256_file, sha256_text, written_whole
from agent.runs.folder import RunFolder, from_plain, write_json
from agent.runs.history import which_machine
from agent.runs.past_run import read_object, read_parameters, read_run, readable

_FOLDER = "models"
#: Characters of a folder's name before its digest.
_LONGEST_NAME = 200


@dataclass(frozen=True)
class Applied:
    """A model that was made current: its file, the run it comes from, and the version before it."""

    model: Path
    run: str
    robot: str
    serial: str
    sha256: str
    applied: str
    previous: str | None

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {"schema": "current/1", **self.__dict__, "model": str(self.model)}


def current_model(logs: Path, robot: str, serial: str) -> Applied | None:
    """The robot's current model, or None where nothing was applied yet.

    Args:
        logs: folder of runs.
        robot: name of the robot.
        serial: of the machine; empty where it has none.

    Raises:
        InputError: what is there is damaged.
    """
    folder = _model_folder(logs, robot, serial)
    return _about(folder / "current") if (folder / "current").is_symlink() else None


def apply_run(logs: Path, run: Path) -> Applied:
    """Make the model of an accepted run the current one of its robot. Applying it again changes nothing.

    Raises:
        InputError: not accepted, damaged, or the model is no longer the one that was accepted.
        AgentError: it cannot be written; the current model is what it was.
    """
    past = read_run(run)
    if past.kind == "diagnose":
        raise InputError(f"{run}: this run is a diagnosis and made no model; apply a calibration or a recalibration")
    if not past.accepted:
        why = f" ({past.reason})" if past.reason else ""
        raise InputError(f"{run}: this run is {past.status}{why}; only the model of an accepted run is made current")
    model = run / "model.json"
    if not model.is_file():
        raise InputError(f"{model}: no such file; the run has lost its model")
    sha256 = sha256_file(model)
    with readable(run):
        read_object(run / "result.json")["validation"]
        accepted = read_object(run / "state.json")["model_sha256"]
    read_parameters(run)  # refuses a damaged model
    if accepted != sha256:
        raise InputError(f"{model}: this is not the model that was accepted (SHA-256 differs); it was changed since")
    folder = _model_folder(logs, past.robot, past.serial)
    try:
        before = current_model(logs, past.robot, past.serial)
    except InputError:  # damaged: applying a run repairs it
        before = None
    if before is not None and before.sha256 == sha256 and before.run == past.run:
        return before
    with _writable(folder):
        version = _fresh(folder / "versions")
        with written_whole(version / "model.json") as fresh:
            shutil.copyfile(model, fresh)
        about = {
            "schema": "current/1",
            "run": past.run,
            "robot": past.robot,
            "serial": past.serial,
            "sha256": sha256,
            "applied": datetime.now(UTC).isoformat(timespec="seconds"),
            "previous": os.path.basename(os.readlink(folder / "current")) if before is not None else None,
        }
        write_json(version / "about.json", about)
        _point(folder, version.name)
    return _about(folder / "current")


def current_runs(logs: Path) -> tuple[set[str], list[str]]:
    """Names of the runs of a folder whose models are the current ones of their robots, and the damaged ones."""
    current, damaged = _all_current(logs)
    return {applied.run for applied in current.values()}, damaged


def _all_current(logs: Path) -> tuple[dict[Path, Applied], list[str]]:
    """Current models by their key, and the damaged ones."""
    current, damaged = {}, []
    for folder in sorted((logs / _FOLDER).glob("*")):
        try:
            if (folder / "current").is_symlink():
                current[folder] = _about(folder / "current")
        except InputError as error:
            damaged.append(str(error))
    return current, damaged


def apply_previous(logs: Path, robot: str | None = None, serial: str | None = None) -> Applied:
    """Go back to the model that was current before; every further call goes one more back.

    Args:
        logs: folder of runs.
        robot: name of the robot; None: the only one.
        serial: of the machine; None: the only one.

    Raises:
        InputError: nothing was applied before, or it is not clear on which robot.
    """
    current, damaged = _all_current(logs)
    applied = [
        entry for entry in current.items() if robot in (None, entry[1].robot) and serial in (None, entry[1].serial)
    ]
    if not applied and damaged:
        raise InputError("; ".join(damaged))
    machines = ", ".join(f"{about.robot} {about.serial}".strip() for about in current.values())
    if not current:
        raise InputError(f"{logs / _FOLDER}: no model was applied yet, so there is none to go back from")
    if not applied:
        raise InputError(
            f"{logs / _FOLDER}: no model was applied of {which_machine(robot, serial)}; there is: {machines}"
        )
    if len(applied) > 1:
        names = ", ".join(f"{about.robot} {about.serial}".strip() for _, about in applied)
        raise InputError(f"several robots have a current model ({names}); say which with --robot and --serial")
    folder, about = applied[0]
    if about.previous is None:
        raise InputError(f"{folder}: {about.run} was the first model applied; there is none before it")
    _about(folder / "versions" / about.previous)  # refuses a damaged one
    with _writable(folder):
        _point(folder, about.previous)
    return _about(folder / "current")


def register_run(run: RunFolder, console: Console) -> None:
    """The first accepted model of a robot becomes its current one.

    `agent apply` and recalibrations replace it.
    """
    logs = run.path.parent
    try:
        if run.state["status"] == "finished" and current_model(logs, run.state["robot"], run.state["serial"]) is None:
            apply_run(logs, run.path)
    except AgentError as error:  # the run itself is complete, and `agent history` finds it again
        console.warn(str(error))


def _about(version: Path) -> Applied:
    try:
        applied = from_plain(Applied, {**read_json(version / "about.json"), "model": version / "model.json"})
    except (InputError, OSError, ValueError, TypeError) as error:
        raise InputError(f"{version / 'about.json'}: cannot be read ({error}); apply a run again") from None
    if not applied.model.is_file() or sha256_file(applied.model) != applied.sha256:
        raise InputError(f"{applied.model}: missing or changed since it was applied; apply a run again")
    return applied


def _model_folder(logs: Path, robot: str, serial: str) -> Path:
    """The folder of one machine; a name that another machine could have too ends in a digest."""
    name = re.sub(r"[^A-Za-z0-9._-]", "_", f"{robot}_{serial}" if serial else robot)[:_LONGEST_NAME]
    unique = serial and name == f"{robot}_{serial}" and "_" not in serial
    return logs / _FOLDER / (name if unique else f"{name}~{sha256_text(json.dumps([robot, serial]))[:16]}")


def _fresh(versions: Path) -> Path:
    versions.mkdir(parents=True, exist_ok=True)
    number = 1 + max((int(entry.name) for entry in versions.iterdir() if entry.name.isdigit()), default=0)
    path = versions / f"{number:06d}"
    path.mkdir()
    return path


@contextlib.contextmanager
def _writable(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise AgentError(f"{folder}: the model cannot be applied: {error.strerror}; free space or rights?") from None


def _point(folder: Path, version: str) -> None:
    fresh = folder / f".current.{os.getpid()}"
    fresh.unlink(missing_ok=True)
    fresh.symlink_to(Path("versions") / version)
    os.replace(fresh, folder / "current")
