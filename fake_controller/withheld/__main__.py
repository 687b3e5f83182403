"""`… draw` prints the truth of runs, `… write` records one; both take an object on stdin, as JSON.

That of `draw` holds `count`, `seed` and `options`: `robot` (comau_ns16 if absent) and `cycle`, the duration of one
cycle of every motion [s]. That of `write` holds the `truth` of a run and a `folder`; it prints how large the effects
are.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import AgentError, read_yaml, write_atomically
from agent.recording import Log, read_log, write_log
from agent.robot import description_file, load_robot
from drivers.errors import DriverError
from fake_controller.withheld.cases import draw_cases
from fake_controller.withheld.runs import between_stops, draw_programs, link_recipe, record_motions, torque_change

#: One robot, and about 20 s of each of three motions.
_USUAL = {"robot": "comau_ns16", "cycle": 10.0}


def main(arguments: Sequence[str]) -> int:
    """Returns the exit code: 0, or 1 with a message where a run cannot be recorded."""
    job = json.load(sys.stdin)
    if arguments[0] == "draw":
        options = _USUAL | job["options"]
        drawn = draw_cases(job["count"], job["seed"], load_robot(options["robot"]))
        print(json.dumps([{**asdict(case), **options} for case in drawn]))
        return 0
    try:
        print(json.dumps({"size": write(job["truth"], Path(job["folder"]))}))
    except (AgentError, DriverError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def write(truth: Mapping[str, Any], folder: Path) -> float | None:
    """Record a run: description, `baseline/` of the healthy machine, `logs/`; returns the size of its effects.

    The controller's interpolator differs from ours, so our plan does not describe a healthy run. The planned set-points
    of a log are those that this controller executes for the same programs without an effect.
    """
    folder.mkdir(parents=True, exist_ok=True)
    source = description_file(truth["robot"])
    for path in (source, source.parent / read_yaml(source)["urdf"]):
        write_atomically(folder / path.name, path.read_text(encoding="utf-8"))
    recipe = link_recipe(truth["robot"])
    usual, moved = (draw_programs(recipe, truth[seed], truth["cycle"]) for seed in ("machine", "motion"))
    for log in _run(truth, usual, (), folder / "baseline"):
        write_log(log.path, replace(log, planned_position=None))
    logs = plain = _run(truth, moved, truth["effects"], folder / "logs")
    size = None
    if truth["effects"]:
        plain = _run(truth, moved, (), folder / "without")
        size = torque_change(load_robot(truth["robot"]), logs, plain)
    for log, other in zip(logs, plain, strict=True):
        write_log(log.path, _planned_as(log, other))
    return size


def _run(
    truth: Mapping[str, Any], programs: Mapping[str, str], effects: Sequence[Mapping[str, Any]], folder: Path
) -> list[Log]:
    paths = record_motions(truth["robot"], truth["machine"], effects, programs, folder)
    return [read_log(path, load_robot(truth["robot"])) for path in paths]


def _planned_as(log: Log, other: Log) -> Log:
    """The log with the executed set-points of another run as its plan.

    Both are aligned from stop to stop, and a stop holds the last set-point. Where the stops differ in number, the plan
    begins with the log and is not aligned again.
    """
    stretches, other_stretches, set_points = between_stops(log), between_stops(other), other.reference_position
    assert set_points is not None
    planned = set_points[np.minimum(np.arange(len(log.t)), len(set_points) - 1)]
    if len(stretches) == len(other_stretches):
        for (start, _), (first, last) in zip(stretches, other_stretches, strict=True):
            part = set_points[first:last][: len(planned) - start]
            planned[start : start + len(part)] = part
            planned[start + len(part) :] = set_points[last - 1]
    return replace(log, planned_position=planned)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
