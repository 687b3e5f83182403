"""Many tasks at once: one small interface, whoever does the work.

`Engine.map` calls a function once for each task and hands the answers out as they come, with the number of the task
they are of: whoever puts them in order gets the same result from any engine. Function and tasks travel, so both must
pickle; what a task is worth must depend on nothing but itself.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

Task = TypeVar("Task")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class TaskDone(Generic[Answer]):
    """What came of task `number`: its `answer`, or why it has none (`lost`: it killed every worker that tried it)."""

    number: int
    answer: Answer | None
    lost: str = ""


class TaskEngine(Protocol):
    """Where tasks are done."""

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in the order in which they come; an error of `function` is raised here."""
        ...


class InProcess:
    """One task after the other, in this process."""

    def __enter__(self) -> InProcess:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def map(self, function: Callable[[Task], Answer], tasks: Iterable[Task]) -> Iterator[TaskDone[Answer]]:
        """Answers in order."""
        for number, task in enumerate(tasks):
            yield TaskDone(number, function(task))


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def needed(module: str, what: str, extra: str = "fleet") -> Any:
    """An optional package, imported.

    Raises:
        InputError: it is not installed; says how to install it.
    """
    from importlib import import_module

    from agent.core.errors import InputError

    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{what} needs {error.name or module}, which is not installed: pip install 'calibration-agent[{extra}]'"
        ) from None
