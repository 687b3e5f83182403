"""What a worker does: fetch the inputs of one run, call what the single command calls, and return a row.

No run can stop the fleet: whatever goes wrong is a row with its reason.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import resource
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from agent.core import (
    AgentError,
    Console,
    InputError,
    finite,
    one_blas_thread,
    read_json,
    read_yaml,
    sha256_file,
    swept_folder,
)
from agent.fleet.store import SCRATCH, Store, StoredFile, StoreError
from agent.fleet.tasks import RUN_MODEL, RunQuestion, Task
from agent.model import IdentifiedModel
from agent.pipeline import FitQuestion, GapQuestion, conditions, diagnose_files, fit_files, validate_files
from agent.recording import Log, read_log
from agent.robot import SHARE, RobotDescription, builtin_robots

#: Statuses that may pass; a rerun tries these rows again.
PASSING = ("unavailable", "memory", "killed")


class Notes(Console):
    """Keeps warnings and shows nothing."""

    def __init__(self) -> None:
        super().__init__(verbosity=-1)
        self.warnings: list[str] = []

    def warn(self, text: str) -> None:
        """Keep a warning."""
        self.warnings.append(text)


@dataclass(frozen=True)
class TaskRow:
    """The row of a task, without the columns known from the task, and its model file.

    `inputs` are the files that were read, with their SHA-256.
    """

    row: dict[str, Any]
    inputs: list[dict[str, Any]]
    model: bytes = b""
    cpu_s: float = 0.0
    read_bytes: int = 0


@dataclass
class _Inputs:
    """The files of a task on this machine, and what was read of them."""

    store: Store
    folder: Path
    read: list[dict[str, Any]] = field(default_factory=list)

    def fetch(self, file: StoredFile) -> Path:
        """Path of a file of the store; what was read is noted once."""
        if file.path in (entry["path"] for entry in self.read):
            return (self.store.local or self.folder / "source") / file.path
        path = self.store.fetch(file, self.folder / "source")
        self.read.append({"path": file.path, "size": file.size, "stamp": file.stamp, "sha256": sha256_file(path)})
        return path

    def optional(self, file: StoredFile | None) -> Path | None:
        """The same as `fetch` where there is one."""
        return None if file is None else self.fetch(file)


def run_task(task: Task) -> TaskRow:
    """The row of one task; no input makes it raise."""
    began = time.process_time()
    with swept_folder(SCRATCH) as folder:
        inputs = _Inputs(Store(task.source), folder)
        row: dict[str, Any]
        model = b""
        try:
            with one_blas_thread():
                row, model = _work(task, inputs)
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
        # messages name files as they are called in the source, not where a worker had them
        places = (f"{folder}/source/", f"{folder}/", f"{inputs.store.absolute}/")
        local_path = re.compile("|".join(re.escape(path) for path in places))
        row = {"started": _named_date(task.run), "warnings": [], **row}
        row |= {
            "reason": local_path.sub("", row["reason"]),
            "warnings": [local_path.sub("", text) for text in row["warnings"]],
        }
        size = sum(entry["size"] for entry in inputs.read)
        return TaskRow(row, inputs.read, model, time.process_time() - began, size)


def _work(task: Task, inputs: _Inputs) -> tuple[dict[str, Any], bytes]:
    robot = _robot(task, inputs)
    model = inputs.optional(task.model)
    if task.question.model_content is not None:
        model = inputs.folder / task.question.model
        model.write_bytes(task.question.model_content)
    logs = [inputs.fetch(file) for file in task.logs]
    state = inputs.optional(task.state)
    row, content = answer(task.question, robot, model, logs)
    return row | {"status": "ok", "exit_code": 0, "reason": ""} | _date_and_machine(task, state, logs), content


def _robot(task: Task, inputs: _Inputs) -> str | RobotDescription | None:
    """The robot of all, or the path of the description with its URDF; of a run folder of the agent without one, the
    robot of its model, or the built-in one that it names."""
    if task.question.robot is not None:
        return task.question.robot
    if task.description is None:
        name = _read_state(inputs.optional(task.state)).get("robot")
        return name if name in builtin_robots() else None
    path = inputs.fetch(task.description)
    if path.name == RUN_MODEL:
        return IdentifiedModel.load(path).robot
    with contextlib.suppress(InputError, FileNotFoundError):  # whoever reads the description will say so
        data = read_yaml(path)
        if isinstance(data, dict) and isinstance(data.get("urdf"), str):
            urdf = os.path.normpath(f"{task.description.folder}/{data['urdf']}")
            if not urdf.startswith(("..", "/")):
                inputs.optional(inputs.store.find(urdf))
    return str(path)


def answer(question: RunQuestion, robot: Any, model: Path | None, logs: list[Path]) -> tuple[dict[str, Any], bytes]:
    """Columns of a row, with its warnings, and its model file, by the same functions as the single command.

    Raises:
        AgentError: as the single command does.
    """
    notes, content = Notes(), b""
    if question.kind == "estimate":
        row, content = _estimate(question, robot, logs, notes)
    elif question.kind == "validate":
        row = _validate(question, model, logs, notes)
    else:
        row = _diagnose(question, robot, model, logs, notes)
    return row | {"warnings": notes.warnings}, content


def _estimate(question: RunQuestion, robot: Any, logs: list[Path], notes: Notes) -> tuple[dict[str, Any], bytes]:
    """The columns, and the model file without its date, so that the same inputs give the same file."""
    if robot is None:
        raise InputError("there is no robot.yaml in or above this run; put one there, or name the robot with --robot")
    keys = ("cutoff", "method", "structure", "allow_mixed", "force")
    fitted, read = fit_files(robot, logs, FitQuestion(**{key: getattr(question, key) for key in keys}), notes)
    content = finite(fitted.to_dict())
    content["provenance"].pop("created", None)
    nominal = fitted.robot.nominal_torque
    row = {
        "joints": list(fitted.robot.joint_names),
        "rmse": fitted.held_out_rmse.tolist(),
        "normalised_rmse": finite(fitted.held_out_rmse / nominal),
        "nominal_torque": finite(nominal),
        "method": fitted.method,
        "cutoff_hz": float(fitted.cutoff),
        "condition_number": content["condition_number"],
        "parameters": [
            {key: entry[key] for key in ("name", "unit", "value", "standard_deviation")}
            for entry in (*content["base_parameters"], *content["friction"])
        ],
        **_conditions(fitted, read),
    }
    return row, (json.dumps(content, allow_nan=False) + "\n").encode()


def _conditions(model: IdentifiedModel, logs: list[Log]) -> dict[str, Any]:
    """Friction and its change during the longest log, as a run folder has them."""
    met = conditions(max(logs, key=lambda log: len(log.t)), model)
    rates = zip(*met["warm_up"].values(), strict=True) if met["cycles"] > 2 else ()
    warm_up = finite([{"rate_per_s": rate, "standard_deviation": deviation} for rate, deviation in rates])
    return {"friction": met["friction"], "warm_up": warm_up}


def _validate(question: RunQuestion, model: Path | None, logs: list[Path], notes: Notes) -> dict[str, Any]:
    if model is None:
        raise InputError(f"there is no {question.model or 'model'} in or above this run; name a model with --model")
    result = finite(validate_files(model, logs, question.cutoff, notes, question.allow_mixed).to_dict())
    columns = ("rmse", "normalised_rmse", "relative_error", "relative_error_all_joints")
    row = {key: result["overall"][key] for key in columns} | {key: result[key] for key in ("joints", "cutoff_hz")}
    return row | {"result": json.dumps(result, allow_nan=False)}


def _diagnose(question: RunQuestion, robot: Any, model: Path | None, logs: list[Path], notes: Notes) -> dict[str, Any]:
    if question.model and model is None:
        raise InputError(f"there is no {question.model} in or above this run; leave --model out, or name another")
    asked = GapQuestion(
        model,
        cutoff=question.cutoff,
        without=question.without,
        allow_mixed=question.allow_mixed,
        force=question.force,
    )
    result = finite(diagnose_files(robot, logs, asked, notes))
    gap = result["gap"]
    return {
        "joints": gap["joints"],
        "normalised_rmse": [b if u == SHARE else None for b, u in zip(gap["before"], gap["units"], strict=True)],
        "gap_before": gap["before"],
        "gap_after": gap["after"],
        "gap_floor": gap["floor"] or [None] * len(gap["joints"]),
        "gap_units": gap["units"],
        "verdict": result["verdict"],
        "closure": result["closure"],
        "causes": [
            {key: cause[key] for key in ("effect", "joints", "closure", "probability")} for cause in result["causes"]
        ],
        "result": json.dumps(result, allow_nan=False),
    }


def _read_state(state: Path | None) -> dict[str, Any]:
    """The state of a run; empty where there is none, or it is damaged."""
    if state is not None:
        with contextlib.suppress(InputError):
            stored = read_json(state)
            return stored if isinstance(stored, dict) else {}
    return {}


def _date_and_machine(task: Task, state: Path | None, logs: list[Path]) -> dict[str, Any]:
    """Date of the run (from its state, its first log or its name), and serial and tool (from its first log)."""
    stamp, log, started = _read_state(state).get("started"), read_log(logs[0]), None
    with contextlib.suppress(ValueError, OverflowError):  # no such day
        if isinstance(stamp, str):
            started = datetime.fromisoformat(stamp)
            started = started if started.tzinfo else started.replace(tzinfo=UTC)
        else:
            started = log.date
    machine = {key: log.metadata.get(key) or None for key in ("serial", "tool")}
    return {"started": started or _named_date(task.run), **machine}


def _named_date(run: str) -> datetime | None:
    """The date with which the name of a run's folder begins, as the agent writes it."""
    with contextlib.suppress(ValueError):
        return datetime.strptime(run.rpartition("/")[2][:16], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
    return None


def _limit() -> str:
    soft = resource.getrlimit(resource.RLIMIT_DATA)[0]
    return "there is" if soft == resource.RLIM_INFINITY else f"{soft >> 20} MiB"
