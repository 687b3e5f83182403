"""The run folder: records every finished step, so that a stopped run can be resumed."""

from __future__ import annotations

import json
import platform
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Literal, TypeVar

from agent.core import (
    FULL_OR_READ_ONLY,
    AgentError,
    InputError,
    finite,
    fit_to_show,
    package_version,
    read_json,
    sha256_file,
    sha256_text,
    write_atomically,
)

_STATE = "state.json"
Kind = TypeVar("Kind")


@dataclass
class RunState:
    """State of a run."""

    schema: Literal["run/1"]
    robot: str
    started: str
    status: str
    steps: dict[str, dict[str, Any]]
    inputs_sha256: dict[str, str]
    versions: dict[str, str]


class RunFolder:
    """`logs/<UTC>_<robot>/`: files are written whole or not at all; an existing run is never overwritten.

    `state.json` holds the finished steps with what they found, the status (`running`, `finished`, `rejected`,
    `stopped`) and, for a stopped run, where and why.
    """

    def __init__(self, path: Path, state: dict[str, Any]):
        self.path = path
        self.state = state

    @classmethod
    def create(cls, root: Path, robot: str, recipe: Path, now: datetime | None = None) -> RunFolder:
        """Make a new run folder with a copy of the recipe.

        Raises:
            AgentError: the folder cannot be written.
        """
        stamp = (now or datetime.now(UTC)).strftime("%Y%m%dT%H%M%SZ")
        make_folder(root, "the run")
        path = _fresh_folder(root, f"{stamp}_{robot}")
        text = recipe.read_text(encoding="utf-8")
        state = {
            "schema": "run/1",
            "robot": robot,
            "recipe": str(recipe.resolve()),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "status": "running",
            "steps": {},
            "inputs_sha256": {"recipe.yaml": sha256_text(text)},
            "versions": versions(),
        }
        run = cls(path, state)
        try:
            run.write_text("recipe.yaml", text)
            run._save()
        except AgentError:  # a full disk; nobody is to take it for a run
            shutil.rmtree(path, ignore_errors=True)
            raise
        return run

    @classmethod
    def open(cls, path: Path, recipe_sha256: str, check: Callable[[RunFolder], None] = lambda run: None) -> RunFolder:
        """Open a calibration to resume it; `check` may refuse it before anything is written.

        Raises:
            InputError: no such run or one of another kind, a damaged state, or the recipe changed since.
        """
        if not (path / _STATE).is_file():
            raise InputError(f"{path}: not a run folder (it has no {_STATE})")
        state = read_json(path / _STATE)
        kind = state.get("kind") if isinstance(state, dict) else None
        if kind in ("recalibrate", "diagnose"):
            raise InputError(f"{path}: only a calibration can be resumed; start this one again: `agent {kind}`")
        try:
            from_plain(RunState, state)
        except ValueError as error:
            raise InputError(
                f"{path / _STATE}: damaged, or of another version of the agent ({error}); start a new run without "
                "--resume"
            ) from None
        if state["inputs_sha256"].get("recipe.yaml") != recipe_sha256:
            raise InputError(f"{path}: this run was started with another recipe; start a new run without --resume")
        if state["status"] in ("finished", "rejected"):
            raise InputError(f"{path}: this run is complete ({state['status']}); there is nothing to resume")
        run = cls(path, state)
        check(run)
        run.state.pop("stopped", None)
        run.note(status="running")
        return run

    def finished(self, step: str) -> dict[str, Any] | None:
        """Values noted by a finished step; None if it has not finished."""
        return self.state["steps"].get(step)

    def finish(self, step: str, **facts: Any) -> dict[str, Any]:
        """Note a step as finished, with what a resumed run needs to know of it."""
        self.state["steps"][step] = {"finished": datetime.now(UTC).isoformat(timespec="seconds"), **finite(facts)}
        self._save()
        return self.state["steps"][step]

    def note(self, **facts: Any) -> None:
        """Add facts about the whole run to its state, e.g. the robot's serial."""
        self.state |= finite(facts)
        self._save()

    def stopped(self, step: str, reason: str) -> None:
        """Note where and why the run ended before its end."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self.note(status="stopped", stopped={"step": step, "reason": fit_to_show(reason), "at": now})

    def complete(self, accepted: bool) -> None:
        """Note that the run reached its end."""
        self.note(status="finished" if accepted else "rejected")

    def file(self, name: str) -> Path:
        """Path of a file of this run."""
        return self.path / name

    def check_file(self, name: str, sha256: str | None) -> None:
        """Check that a file of this run has not changed since its step finished.

        Raises:
            InputError: it is missing, was changed, or has no recorded checksum.
        """
        path = self.path / name
        if not path.is_file() or sha256 is None or sha256_file(path) != sha256:
            what = "it is gone" if not path.is_file() else "it was changed since, or by another version of the agent"
            raise InputError(f"{path}: not the file that this run finished with ({what}); start a new run")

    def write_text(self, name: str, text: str) -> Path:
        """Write a file whole or not at all."""
        return write_atomically(self.path / name, text)

    def write_json(self, name: str, data: Any) -> Path:
        """Write JSON whole or not at all."""
        return write_json(self.path / name, data)

    def _save(self) -> None:
        self.write_json(_STATE, self.state)


def make_folder(folder: Path, what: str) -> None:
    """Make a folder for `what`, and those above it, where it is not there.

    Raises:
        AgentError: full, read-only or no rights; InputError for other reasons, such as a file of that name.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        kind = AgentError if error.errno in FULL_OR_READ_ONLY else InputError
        reason = f"{error.strerror}; free space or rights? Otherwise name another folder"
        raise kind(f"{folder}: no folder for {what} can be made there: {reason}") from None


def check_output(out: Path, paths: Sequence[Path]) -> None:
    """Refuse a file that cannot be written before the work starts, or that is one of the inputs (`paths`).

    Raises:
        InputError: a folder, a file in no folder, or an input.
        AgentError: the folder is read-only, or full.
    """
    folder = out.absolute().parent
    if out.is_dir():
        raise InputError(f"{out}: is a folder; name the file to write")
    if not folder.is_dir():
        raise InputError(f"{out}: there is no folder {out.parent} to write it in")
    if out.is_file() or not out.exists():  # not a device or a pipe
        try:
            with TemporaryFile(dir=folder):
                pass
        except OSError as error:
            kind = AgentError if error.errno in FULL_OR_READ_ONLY else InputError
            raise kind(f"{out}: cannot be written there: {error.strerror}; name another file") from None
    if out.exists() and any(path.exists() and path.samefile(out) for path in paths):
        raise InputError(f"{out}: is one of the logs or models that are read; name another file to write")


def write_json(path: Path, data: Any) -> Path:
    """Write JSON as `write_atomically` does; a number that is not finite becomes null."""
    return write_atomically(path, json.dumps(finite(data), indent=2, allow_nan=False) + "\n")


def from_plain(kind: type[Kind], data: dict[str, Any]) -> Kind:
    """A dataclass from what a file said.

    Raises:
        ValueError: a value is missing, or of the wrong type.
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        fault = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}") from None


def versions() -> dict[str, str]:
    """Versions of the agent and of what its figures depend on."""
    packages = ("calibration-agent", "numpy", "scipy", "pin", "mcap")
    return {"python": platform.python_version(), **{package: package_version(package) for package in packages}}


def _fresh_folder(root: Path, name: str) -> Path:
    for suffix in ("", *(f"_{k}" for k in range(2, 1000))):
        path = root / f"{name}{suffix}"
        try:
            path.mkdir()
        except FileExistsError:
            continue
        return path
    raise AgentError(f"{root / name}: a thousand runs of this second already")
