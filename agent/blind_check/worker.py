"""The diagnosing process: `python -m agent.blind_check.worker`, a job a line on stdin, an answer a line on stdout.

It is given logs, robot and model and nothing else, and refuses to open any other file near them, to start a process or
to use the network: it could not find the key if it wanted to.
"""

from __future__ import annotations

import json
import os
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.recording import Log


_FORBIDDEN = ("subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "os.fork", "socket.connect")
_LISTING = ("os.listdir", "os.scandir")


class Guard:
    """Lets a process open, below `folder`, only the files of its present job."""

    def __init__(self, folder: str):
        self._folder = os.path.realpath(folder) + os.sep
        self.allowed: set[str] = set()
        self.closed = False

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.closed:
            return
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if path.startswith(self._folder) and path not in self.allowed:
                raise PermissionError(f"the diagnosis of a blind check may not open {path}")
        elif event in _FORBIDDEN:
            raise PermissionError(f"the diagnosis of a blind check may not use {event}")
        elif event in _LISTING and isinstance(arguments[0], (str, bytes)):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if (path + os.sep).startswith(self._folder):
                raise PermissionError(f"the diagnosis of a blind check may not list {path}")


def main() -> int:
    """Answer jobs until stdin ends."""
    guard = Guard(sys.argv[1])
    sys.addaudithook(guard)
    for line in sys.stdin:
        job = json.loads(line)
        told = [*job["logs"], *job["planned"], job["model"], *job["description"]]
        guard.allowed = {os.path.realpath(path) for path in told}
        guard.closed = True
        print(json.dumps(_answer(job)), flush=True)
    return 0


def _answer(job: dict[str, Any]) -> dict[str, Any]:
    """The diagnosis, or why there is none."""
    from agent.core import AgentError, finite

    begin = time.process_time()
    try:
        found = diagnose_job(job)
    except AgentError as error:
        return {"error": str(error)}
    except Exception as error:  # one run that breaks the diagnosis is a result, not the end of the check
        traceback.print_exc()
        return {"error": f"internal error in the diagnosis: {type(error).__name__}: {error}"}
    return finite({"result": found.result, "seconds": time.process_time() - begin})


def diagnose_job(job: Mapping[str, Any], without: Sequence[str] = ()) -> Diagnosis:
    """Diagnose logs whose plan, if it is given, is in files of set-points.

    Raises:
        InputError: as in `diagnose`.
    """
    from agent.diagnosis import diagnose
    from agent.model import IdentifiedModel
    from agent.recording import read_log
    from agent.robot import load_robot

    robot = load_robot(job["robot"])
    logs = [read_log(Path(log), robot) for log in job["logs"]]
    if job["planned"]:
        logs = [_planned_as(log, np.load(planned)) for log, planned in zip(logs, job["planned"], strict=True)]
    return diagnose(robot, logs, IdentifiedModel.load(Path(job["model"])), without=without)


def _planned_as(log: Log, set_points: np.ndarray) -> Log:
    """The log with executed set-points (T, n) of another run as its plan, from stop to stop; none if stops differ."""
    from agent.blind_check.size import REST
    from agent.link import moving_segments

    assert log.reference_position is not None
    here, there = (moving_segments(points, REST) for points in (log.reference_position, set_points))
    if len(here) != len(there):
        return replace(log, planned_position=None)
    planned = np.full(log.position.shape, np.nan)
    for (start, _), (first, last) in zip(here, there, strict=True):
        stop = min(start + last - first, len(planned))
        planned[start:stop] = set_points[first : first + stop - start]
    return replace(log, planned_position=planned)


if __name__ == "__main__":
    sys.exit(main())
