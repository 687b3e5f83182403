"""`--workers` and `--scheduler` of the benchmarks: their parallel work goes where that of the commands goes.

Workers of a cluster need the agent and this folder on their path.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from agent.cli.options import console_for, engine_for
from agent.core import AgentError


def add_options(parser: argparse.ArgumentParser) -> None:
    """The same two as of `agent plan`, but one process where none is named."""
    parser.add_argument("--workers", type=int, default=1, help="local processes")
    parser.add_argument("--scheduler", help="of a Dask cluster, tcp://…")


def worked(function: Callable[[Any], Any], tasks: Sequence[Any], arguments: argparse.Namespace) -> Iterator[Any]:
    """Answers in the order of the tasks, whoever does them, each as soon as all before it are there.

    Raises:
        AgentError: a task killed every worker that tried it.
    """
    waiting: dict[int, Any] = {}
    following = 0
    with engine_for(arguments.scheduler, arguments.workers, console_for(None)) as engine:
        for done in engine.map(function, tasks):
            if done.lost:
                raise AgentError(f"task {done.number + 1} of {len(tasks)}: {done.lost}")
            waiting[done.number] = done.answer
            while following in waiting:
                yield waiting.pop(following)
                following += 1
