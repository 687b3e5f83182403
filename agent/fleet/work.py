"""What a worker does: fetch the inputs of one run, call what the single command calls, and answer with a row.

Nothing that a run can bring along is an error of the fleet: whatever goes wrong is a row with its reason.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import resource
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import AgentError, InputError, read_json, read_yaml, swept_folder
from agent.fleet.store import SCRATCH, Store, StoredFile, StoreError
from agent.fleet.tasks import RUN_MODEL, Task

if TYPE_CHECKING:
    from agent.robot import RobotDescription

#: Statuses of rows that another try may mend; a rerun tries them again.
PASSING = ("unavailable", "memory", "killed")
_DATE = re.compile(r"(?<!\d)((?:19|20)\d\d)-?([01]\d)-?([0-3]\d)(?:[T_ ]([0-2]\d)[:-]?([0-5]\d))?")


@dataclass(frozen=True)
class TaskRow:
    """The row of a task, without what the task itself says, and its model file; `row` is None where the inputs are
    still what they were. `inputs`: everything that was read, with its SHA-256. `cpu_s`, `read_bytes`: what it took."""

    row: dict[str, Any] | None
    inputs: list[dict[str, Any]]
    model: bytes = b""
    cpu_s: float = 0.0
    read_bytes: int = 0


@dataclass
class _Inputs:
    """The files of a task on this machine."""

    store: Store
    folder: Path
    read: list[dict[str, Any]] = field(default_factory=list)

    def fetch(self, file: StoredFile) -> Path:
        if file.path in (entry["path"] for entry in self.read):
            return (self.store.local or self.folder) / file.path
        path = self.store.fetch(file, self.folder)
        with open(path, "rb") as content:
            digest = hashlib.file_digest(content, "sha256").hexdigest()
        self.read.append({"path": file.path, "size": file.size, "stamp": file.stamp, "sha256": digest})
        return path

    @property
    def size(self) -> int:
        return sum(entry["size"] for entry in self.read)


def run_task(task: Task) -> TaskRow:
    """The answer to one task; no input makes it raise."""
    from agent.excitation import one_blas_thread

    began = time.process_time()
    with swept_folder(SCRATCH) as folder:
        inputs = _Inputs(Store(task.source), folder / "source")
        row: dict[str, Any] | None
        model = b""
        try:
            with one_blas_thread():
                row, model = _work(task, inputs, folder)
        except AgentError as error:
            status = {2: "unreadable", 3: "rejected"}.get(error.exit_code, "unavailable")
            status = "unavailable" if isinstance(error, StoreError) else status
            row = {"status": status, "exit_code": error.exit_code, "reason": str(error)}
        except OSError as error:
            reason = f"{error.filename or task.run}: {error.strerror or error}"
            row = {"status": "unavailable", "exit_code": 1, "reason": reason}
        except MemoryError:
            row = {"status": "memory", "exit_code": 1, "reason": f"this run needs more memory than {_limit()}"}
        except Exception as error:  # a fault of the agent: of this run alone
            reason = f"internal error: this is a fault of the agent: {type(error).__name__}: {error}"
            row = {"status": "error", "exit_code": 1, "reason": reason}
        if row is not None:
            row = {"started": _named_date(task.run), **row}
            row = _readable(row, [f"{folder}/source/", f"{folder}/given/", f"{inputs.store.local}/"])
        return TaskRow(row, inputs.read, model, time.process_time() - began, inputs.size)


def _work(task: Task, inputs: _Inputs, folder: Path) -> tuple[dict[str, Any] | None, bytes]:
    from agent.fleet.figures import WORK, Notes

    robot = _robot(task, inputs, folder)
    model = _model(task, inputs, folder)
    logs = [inputs.fetch(file) for file in task.logs]
    state = None if task.state is None else inputs.fetch(task.state)
    if task.known and dict(task.known) == {entry["path"]: entry["sha256"] for entry in inputs.read}:
        return None, b""
    notes = Notes()
    question = task.question
    row, content = WORK[question.kind](question, robot, model, logs, notes)
    row |= {"status": "ok", "exit_code": 0, "reason": "", "warnings": notes.warnings}
    return row | _when(task, state, logs), content


def _robot(task: Task, inputs: _Inputs, folder: Path) -> str | RobotDescription | None:
    """What `--robot` would be: a name, or the path of the description with its URDF beside it; of a run folder of the
    agent without one, the robot of its model, or the built-in one that it names."""
    if task.question.robot:
        return task.question.robot
    for one in task.question.given:
        if one.name.endswith("robot.yaml"):
            _lay_out(task, folder)
            return str(folder / "given" / one.name)
    if task.description is None:
        return None if task.state is None else _builtin(inputs.fetch(task.state))
    path = inputs.fetch(task.description)
    if path.name == RUN_MODEL:
        from agent.model import IdentifiedModel

        return IdentifiedModel.load(path).robot
    with contextlib.suppress(InputError, FileNotFoundError):  # whoever reads the description will say so
        data = read_yaml(path)
        if isinstance(data, dict) and isinstance(data.get("urdf"), str):
            urdf = os.path.normpath(f"{task.description.folder}/{data['urdf']}")
            if not urdf.startswith(("..", "/")):
                inputs.fetch(inputs.store.find(urdf))
    return str(path)


def _builtin(state: Path) -> str | None:
    from agent.robot import builtin_robots

    name = _told(state).get("robot")
    return name if name in builtin_robots() else None


def _told(state: Path) -> dict[str, Any]:
    """What the state of a run says; nothing where it is none."""
    with contextlib.suppress(InputError):
        told = read_json(state)
        return told if isinstance(told, dict) else {}
    return {}


def _model(task: Task, inputs: _Inputs, folder: Path) -> Path | None:
    for one in task.question.given:
        if task.question.model and one.name == task.question.model:
            _lay_out(task, folder)
            return folder / "given" / one.name
    return None if task.model is None else inputs.fetch(task.model)


def _lay_out(task: Task, folder: Path) -> None:
    for one in task.question.given:
        path = folder / "given" / one.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(one.content)


def _when(task: Task, state: Path | None, logs: list[Path]) -> dict[str, Any]:
    """When the run was: by its state, by the stamps of its first log, or by a date in its name; and on which machine,
    by its first log."""
    from agent.recording import read_log

    told = {} if state is None else _told(state)
    log = read_log(logs[0])
    machine = {key: log.metadata.get(key) or None for key in ("serial", "tool")}
    started = None
    with contextlib.suppress(ValueError, OverflowError):  # no such day
        if isinstance(told.get("started"), str):
            started = datetime.fromisoformat(told["started"])
            started = started if started.tzinfo else started.replace(tzinfo=UTC)
        else:
            started = log.date
    return {"started": started or _named_date(task.run), **machine}


def _named_date(run: str) -> datetime | None:
    """The date in the name of a run's folder."""
    named = _DATE.search(run.rpartition("/")[2])
    if named is None:
        return None
    with contextlib.suppress(ValueError):  # no such day
        time = "".join(part or "00" for part in named.group(4, 5))
        return datetime.fromisoformat("".join(named.group(1, 2, 3)) + "T" + time).replace(tzinfo=UTC)
    return None


def _readable(row: dict[str, Any], places: list[str]) -> dict[str, Any]:
    """Messages name files as they are called in the source, not where a worker had them."""

    def plain(text: str) -> str:
        for place in places:
            text = text.replace(place, "")
        return text

    return row | {"reason": plain(row["reason"]), "warnings": [plain(text) for text in row.get("warnings", [])]}


def _limit() -> str:
    soft = resource.getrlimit(resource.RLIMIT_DATA)[0]
    return "there is" if soft == resource.RLIM_INFINITY else f"{soft >> 20} MiB"
