"""Past runs, read from their folders: results, uncertainties and conditions.

Listing a thousand runs is quick: nothing heavy is imported, and models are read only where parameters are asked for.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from agent.core import InputError
from agent.runs.past_run import PastParameter, PastRun, read_parameters, read_run


class History:
    """The runs of one folder. `damaged` says which folders cannot be read, and why.

    Raises:
        InputError: there is no such folder.
    """

    def __init__(self, folder: Path):
        if not folder.is_dir():
            raise InputError(f"{folder}: no runs are kept there; name the folder with --logs")
        self.folder = folder
        self.damaged: list[str] = []
        runs = []
        for entry in os.scandir(folder):
            if not entry.name.isprintable():  # not a run folder of the agent
                continue
            try:
                os.stat(f"{entry.path}/state.json")
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError:  # no rights, a link to itself: `read_run` says which
                pass
            try:
                runs.append(read_run(folder / entry.name))
            except InputError as error:
                self.damaged.append(str(error))
        self._runs = sorted(runs, key=lambda run: (run.started, run.run))

    def runs(self, robot: str | None = None, serial: str | None = None) -> list[PastRun]:
        """All runs, or those of a robot and serial; oldest first."""
        return [run for run in self._runs if robot in (None, run.robot) and serial in (None, run.serial)]

    def why_none(self, robot: str | None, serial: str | None) -> str:
        """Message for when no run is of this robot and serial."""
        if not (count := len(self._runs)):
            return "no runs yet: `agent calibrate RECIPE` makes the first"
        return f"none of the runs here ({count}) is of {which_machine(robot, serial)}; `agent history` lists them all"

    def parameters(self, runs: Iterable[str] | None = None) -> dict[str, list[PastParameter]]:
        """Parameters by run in the model's order, of all runs or some; a model that cannot be read is `damaged`."""
        parameters: dict[str, list[PastParameter]] = {}
        for run in [run.run for run in self._runs] if runs is None else runs:
            try:
                parameters[run] = read_parameters(self.folder / run)
            except InputError as error:
                self.damaged.append(str(error))
        return parameters

    def last_accepted(self, robot: str, loop: str, controller: str, now: datetime | None = None) -> PastRun | None:
        """The newest accepted run of a loop: of the robot at this controller if there is one, else of any.

        A run dated in the future counts only if there is no other.
        """
        accepted = [run for run in self.runs(robot) if run.accepted and run.loop == loop]
        candidates = [run for run in accepted if run.controller == controller] or accepted
        candidates = [run for run in candidates if not run.in_future(now)] or candidates
        return candidates[-1] if candidates else None


def find_run(logs: Path, name: str) -> Path:
    """The folder of a run, named by its path or, in the folder of the runs, by its name.

    Raises:
        InputError: there is no such run.
    """
    for path in (Path(name), logs / name):
        try:
            if (path / "state.json").is_file():
                return path
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    raise InputError(f"{name}: no such run here or in {logs}; `agent history` lists them")


def last_accepted(run: Path) -> Path | None:
    """The newest accepted run of the same machine and loop that is older than this one."""
    runs = History(run.parent).runs()
    this = next((past for past in runs if past.run == run.name), None)
    if this is None:
        return None
    older = [
        past
        for past in runs
        if past.accepted
        and (past.robot, past.serial, past.loop) == (this.robot, this.serial, this.loop)
        and (past.started, past.run) < (this.started, this.run)
        and (run.parent / past.run / "model.json").is_file()
    ]
    return run.parent / older[-1].run if older else None


def history_table(runs: Sequence[PastRun], current: Collection[str] = ()) -> str:
    """One line per run, newest last, current models marked; then the latest messages of the trends."""
    rows = [("run", "serial", "kind", "result", "worst axis", "cycles")]
    for run in runs:
        cycles = str(run.data["conditions"].get("cycles", "-"))
        rows.append((run.run, run.serial or "-", run.kind, run.outcome_with(current), run.worst_text, cycles))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    latest = {(run.robot, run.serial): run for run in runs if run.complete and run.kind != "diagnose"}
    warnings = [f"{robot} {serial}: {line}" for (robot, serial), run in latest.items() for line in run.data["watch"]]
    return "\n".join([*lines, *([""] if warnings else []), *warnings])


def history_json(history: History, runs: Sequence[PastRun], current: Collection[str] = ()) -> dict[str, Any]:
    """Everything the history knows of these runs, as plain data.

    Args:
        history: of a folder.
        runs: that are shown.
        current: runs of current models.
    """
    parameters = history.parameters(run.run for run in runs)
    return {
        "schema": "history/1",
        "runs": [
            {
                **{key: getattr(run, key) for key in ("run", "robot", "serial", "kind", "started", "status")},
                "accepted": run.accepted if run.judged else None,
                "current": run.run in current,
                "reason": run.reason,
                "reference": run.reference,
                "program_sha256": run.program,
                **{key: run.data[key] for key in ("joints", "normalised_rmse", "gate", "conditions")},
                "parameters": [vars(parameter) for parameter in parameters.get(run.run, [])],
            }
            for run in runs
        ],
    }


def which_machine(robot: str | None, serial: str | None) -> str:
    """The robot and serial that were asked for, in words."""
    named = {"robot": robot, "serial": serial}
    return ", ".join(f"{key} {value}" for key, value in named.items() if value is not None)
