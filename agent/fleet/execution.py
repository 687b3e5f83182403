"""The whole job: find the tasks of a source, skip what is known, run the rest, write the result."""

from __future__ import annotations

import contextlib
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

from agent.core import BusyError, Console, TaskEngine, counted, without_secrets
from agent.fleet.result_file import SCHEMA_NAME, Result, open_result
from agent.fleet.store import Store
from agent.fleet.tasks import RunQuestion, SourceTasks, Task, find_tasks
from agent.fleet.worker import PASSING, TaskRow, run_task
from agent.runs import robot_lock

#: Longest time between two saves of finished rows [s].
_KEEP = 10.0
#: Characters of a reason or warning in a row.
_LONGEST = 2000


@dataclass
class Summary:
    """Outcome of a run over the fleet.

    `done` runs were computed, `kept` rows were still valid, `failed` are all rows of this source without figures.
    """

    kind: str
    source: str
    result: str
    runs: int = 0
    robots: int = 0
    rows: int = 0
    done: int = 0
    kept: int = 0
    cpu_s: float = 0.0
    seconds: float = 0.0
    read_bytes: int = 0
    written_bytes: int = 0
    failed: list[dict[str, str]] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {"schema": SCHEMA_NAME, **self.__dict__}

    def text(self) -> str:
        """For people."""
        lines = [
            f"{counted(self.runs, 'run')} of {counted(self.robots, 'robot')}: {self.done} done, {self.kept} known; "
            f"{counted(self.rows, 'row')} in {self.result}",
            f"{self.cpu_s:.1f} CPU s in {self.seconds:.1f} s, {self.read_bytes / 1e6:.1f} MB read, "
            f"{self.written_bytes / 1e6:.1f} MB written",
        ]
        if self.failed:
            statuses = Counter(failure["status"] for failure in self.failed)
            lines.append("without figures: " + ", ".join(f"{count} {status}" for status, count in statuses.items()))
            lines += [f"  {failure['run']}: {failure['reason']}" for failure in self.failed[:5]]
        if len(self.failed) > 5:
            lines.append("  …; all are in the column `reason`")
        return "\n".join(lines)


def run_fleet(
    source: str,
    question: RunQuestion,
    out: str,
    engine: Callable[[int], AbstractContextManager[TaskEngine]],
    console: Console,
) -> Summary:
    """Bring a result up to date with a source; `engine` makes one for a number of tasks, if there are any.

    Args:
        source: folder or URL of machines and logs.
        question: what is asked of each run.
        out: folder or URL of the result.
        engine: makes one for a number of tasks.
        console: where progress is shown.

    Raises:
        InputError: source, result or a file that was named cannot be used.
        BusyError: another run writes this result.
        AgentError: the result cannot be written, or the workers are gone; what is done is kept.
    """
    began = time.monotonic()
    with _only_run(out), open_result(out, question.kind, source) as result:
        console.step(f"looking for runs in {source}")
        plant = find_tasks(Store(source), question)
        known = result.known()
        todo = list(_to_do(plant, question.key, known))
        runs, robots = len(plant.tasks), len({task.robot for task in plant.tasks})
        summary = Summary(question.kind, source, out, runs, robots, kept=runs - len(todo))
        console.say(f"{counted(runs, 'run')} of {counted(robots, 'robot')}; {len(todo)} to be done")
        wanted = {task.run for task in plant.tasks}
        failed = {run: _failure(row) for run, row in known.items() if run in wanted and row["status"] != "ok"}
        if todo:
            with engine(len(todo)) as workers:
                _work(todo, workers, result, summary, failed, console)
        summary.rows = result.commit()
        summary.failed = sorted(failed.values(), key=lambda failure: failure["run"])
        summary.written_bytes = result.written
        summary.seconds = time.monotonic() - began
    return summary


def _failure(row: Mapping[str, Any]) -> dict[str, str]:
    return {key: row[key] for key in ("run", "status", "reason")}


def _work(
    todo: list[Task],
    engine: TaskEngine,
    result: Result,
    summary: Summary,
    failed: dict[str, dict[str, str]],
    console: Console,
) -> None:
    last_saved = time.monotonic()
    for number, done in enumerate(engine.map(run_task, todo), 1):
        task = todo[done.number]
        answer = done.answer or TaskRow({"status": "killed", "exit_code": 1, "reason": done.lost}, [])
        failed.pop(task.run, None)
        summary.cpu_s += answer.cpu_s
        summary.read_bytes += answer.read_bytes
        row = _row(task, answer.row, answer.inputs)
        if answer.model:
            row["model"] = result.add_model(answer.model)
        result.add(row)
        summary.done += 1
        if row["status"] != "ok":
            failed[task.run] = _failure(row)
        console.progress(f"{number} of {counted(len(todo), 'run')}, {len(failed)} without figures", number / len(todo))
        if time.monotonic() - last_saved > _KEEP:
            result.keep()
            last_saved = time.monotonic()


def _row(task: Task, answer: dict[str, Any], inputs: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        **answer,
        "robot": task.robot,
        "run": task.run,
        "reason": without_secrets(answer["reason"], _LONGEST),
        "warnings": [without_secrets(text, _LONGEST) for text in answer.get("warnings", [])],
        "logs": [file.name for file in task.logs],
        "page": task.page or None,
        "asked": task.question.key,
        "inputs": inputs,
    }


def _to_do(plant: SourceTasks, asked: str, known: Mapping[str, Mapping[str, Any]]) -> Iterator[Task]:
    """Every task that has to run, with what is known of its inputs.

    A row is still valid where it answers the same question and all its input files have the same size and stamp.
    """
    for task in plant.tasks:
        row = known.get(task.run)
        if row is None or row["asked"] != asked or row["status"] in PASSING:
            yield task
            continue
        inputs = {entry["path"]: entry for entry in row["inputs"] or ()}
        unchanged = all(plant.listing.get(path) == (entry["size"], entry["stamp"]) for path, entry in inputs.items())
        if not unchanged or not {file.path for file in task.files} <= inputs.keys():
            yield task


@contextlib.contextmanager
def _only_run(out: str) -> Iterator[None]:
    """Only one run of this machine writes a result at a time."""
    try:
        with robot_lock("fleet", os.path.realpath(local) if (local := Store(out).local) else out):
            yield
    except BusyError:
        raise BusyError(f"{out}: another run writes this result; wait for it to end, or stop it") from None
