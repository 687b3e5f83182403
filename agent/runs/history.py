"""Past runs in one SQLite file beside their folders: what was found, how sure it is, under which conditions.

The file is an index: all of it is read from the run folders, so it may be deleted, and folders that were copied here
turn up by themselves. Nothing heavy is imported, so that listing a thousand runs is quick.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from agent.core import AgentError, InputError
from agent.runs.past_run import PastParameter, PastRun, read_run

FILE = "history.sqlite"
_VERSION = 5
#: Result codes of SQLite with which the system says no; what else goes wrong is damage.
_REFUSALS = (
    sqlite3.SQLITE_PERM,
    sqlite3.SQLITE_BUSY,
    sqlite3.SQLITE_LOCKED,
    sqlite3.SQLITE_READONLY,
    sqlite3.SQLITE_IOERR,
    sqlite3.SQLITE_FULL,
    sqlite3.SQLITE_CANTOPEN,
)
_TABLES = """
CREATE TABLE runs (
    run TEXT PRIMARY KEY, changed INTEGER, robot TEXT, serial TEXT, kind TEXT, started TEXT, status TEXT,
    controller TEXT, loop TEXT, program TEXT, reference TEXT, reason TEXT, worst REAL, data TEXT);
CREATE TABLE parameters (
    run TEXT REFERENCES runs(run) ON DELETE CASCADE, place INTEGER, name TEXT, unit TEXT, value REAL, deviation REAL,
    PRIMARY KEY (run, place)) WITHOUT ROWID;
CREATE INDEX by_robot ON runs (robot, serial, started);
"""


class History:
    """The runs of one folder; opened by `open_history`. `damaged` says which folders cannot be read, and why."""

    def __init__(self, folder: Path, connection: sqlite3.Connection):
        self.folder = folder
        self.damaged: list[str] = []
        self._connection = connection

    def runs(self, robot: str | None = None, serial: str | None = None) -> list[PastRun]:
        """All runs, oldest first."""
        wanted = {"robot": robot, "serial": serial}
        wanted = {key: value for key, value in wanted.items() if value is not None}
        where = " AND ".join(f"{key} = ?" for key in wanted) or "1"
        columns = "run, robot, serial, kind, started, status, controller, loop, program, reference, reason, worst, data"
        rows = self._connection.execute(
            f"SELECT {columns} FROM runs WHERE {where} ORDER BY started, run", tuple(wanted.values())
        )
        return [PastRun(*(*row[:-1], json.loads(row[-1]))) for row in rows]

    def why_none(self, robot: str | None, serial: str | None) -> str:
        """What to say where `runs` of this robot and serial are none."""
        if not (there := len(self.runs())):
            return "no runs yet: `agent calibrate RECIPE` makes the first"
        return f"none of the runs here ({there}) is of {which_machine(robot, serial)}; `agent history` lists them all"

    def parameters(self, runs: Iterable[str] | None = None) -> dict[str, list[PastParameter]]:
        """Parameters by run, of all or of some, in the model's order."""
        chosen = None if runs is None else set(runs)
        found: dict[str, list[PastParameter]] = {}
        for run, *values in self._connection.execute(
            "SELECT run, name, unit, value, deviation FROM parameters ORDER BY run, place"
        ):
            if chosen is None or run in chosen:
                found.setdefault(run, []).append(PastParameter(*values))
        return found

    def last_accepted(self, robot: str, loop: str, controller: str, now: datetime | None = None) -> PastRun | None:
        """The newest accepted run of a loop: of the robot at this controller if there is one, else of any.

        One that is dated in the future counts only where there is no other: nobody knows when it was."""
        accepted = [run for run in self.runs(robot) if run.accepted and run.loop == loop]
        here = [run for run in accepted if run.controller == controller] or accepted
        here = [run for run in here if not run.in_future(now)] or here
        return here[-1] if here else None

    def update(self) -> None:
        """Take in run folders that are new or have changed, and forget those that are gone."""
        known = dict(self._connection.execute("SELECT run, changed FROM runs"))
        present = {name: changed for name, changed in _folders(self.folder)}
        stale = [name for name in known if name not in present]
        fresh = [name for name, changed in present.items() if known.get(name) != changed]
        with self._connection:
            self._connection.executemany("DELETE FROM runs WHERE run = ?", [(name,) for name in [*stale, *fresh]])
            for name in fresh:
                self._add(name, present[name])

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    def _add(self, name: str, changed: int) -> None:
        try:
            run, parameters = read_run(self.folder / name)
        except InputError as error:
            self.damaged.append(str(error))  # it is looked at again next time
            return
        row = [name, changed, run.robot, run.serial, run.kind, run.started, run.status, run.controller, run.loop]
        row += [run.program, run.reference, run.reason, run.worst, json.dumps(run.data)]
        self._connection.execute(f"INSERT INTO runs VALUES ({', '.join('?' * len(row))})", row)
        self._connection.executemany(
            "INSERT INTO parameters VALUES (?, ?, ?, ?, ?, ?)",
            [(name, place, p.name, p.unit, p.value, p.deviation) for place, p in enumerate(parameters)],
        )


@contextlib.contextmanager
def open_history(folder: Path) -> Iterator[History]:
    """The history of a folder of runs, brought up to date with it.

    Raises:
        InputError: there is no such folder.
        AgentError: the file cannot be written.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no runs are kept there; name the folder with --logs")
    path = folder / FILE
    try:
        try:
            history = _open(folder)
        except (sqlite3.DatabaseError, ValueError, TypeError) as error:
            if _refused(error):
                raise
            path.replace(path.with_suffix(".damaged"))  # the folders have all that was in it
            history = _open(folder)
        try:
            yield history
        finally:
            history.close()
    except sqlite3.DatabaseError as error:
        if _refused(error):
            why = f"the history cannot be kept there: {error}; free space or rights?"
        else:
            why = f"damaged ({error}); delete it, it is made again from the run folders"
        raise AgentError(f"{path}: {why}") from None


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


def history_table(runs: Sequence[PastRun], current: Collection[str] = ()) -> str:
    """A line a run, newest last, with the runs that current models are of marked; then what the trends said last."""
    header = ("run", "serial", "kind", "result", "worst axis", "cycles")
    rows = [header] + [
        (
            run.run,
            run.serial or "-",
            run.kind,
            run.outcome_with(current),
            run.worst_text,
            str(run.data["conditions"].get("cycles", "-")),
        )
        for run in runs
    ]
    widths = [max(len(row[k]) for row in rows) for k in range(len(header))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    latest = {(run.robot, run.serial): run for run in runs if run.complete and run.kind != "diagnose"}
    told = [f"{robot} {serial}: {line}" for (robot, serial), run in latest.items() for line in run.data["watch"]]
    return "\n".join([*lines, *([""] if told else []), *told])


def history_json(history: History, runs: Sequence[PastRun], current: Collection[str] = ()) -> dict[str, Any]:
    """Everything the history knows of these runs, as plain data."""
    parameters = history.parameters(run.run for run in runs)
    return {
        "schema": "history/1",
        "runs": [
            {
                "run": run.run,
                "robot": run.robot,
                "serial": run.serial,
                "kind": run.kind,
                "started": run.started,
                "status": run.status,
                "accepted": run.accepted if run.judged else None,
                "current": run.run in current,
                "reason": run.reason,
                "reference": run.reference,
                "program_sha256": run.program,
                "joints": run.data["joints"],
                "normalised_rmse": run.data["normalised_rmse"],
                "gate": run.data["gate"],
                "conditions": run.data["conditions"],
                "parameters": [
                    {"name": p.name, "unit": p.unit, "value": p.value, "standard_deviation": p.deviation}
                    for p in parameters.get(run.run, [])
                ],
            }
            for run in runs
        ],
    }


def which_machine(robot: str | None, serial: str | None) -> str:
    """A machine as it was asked for, in words."""
    named = {"robot": robot, "serial": serial}
    return ", ".join(f"{key} {value}" for key, value in named.items() if value is not None)


def _refused(error: Exception) -> bool:
    """Whether it is the system that says no, and not the file that is damaged."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF in _REFUSALS


def _open(folder: Path) -> History:
    connection = sqlite3.connect(folder / FILE, timeout=30.0)
    try:
        connection.execute("PRAGMA foreign_keys = ON")
        version = connection.execute("PRAGMA user_version").fetchone()[0]
        if version != _VERSION:
            with connection:
                connection.executescript(
                    "BEGIN; DROP TABLE IF EXISTS parameters; DROP TABLE IF EXISTS runs;"
                    f"{_TABLES} PRAGMA user_version = {_VERSION}; COMMIT;"
                )
        history = History(folder, connection)
        history.update()
        history.runs()  # a damaged file shows
    except (sqlite3.DatabaseError, ValueError, TypeError):
        connection.close()
        raise
    return history


def _folders(folder: Path) -> Iterator[tuple[str, int]]:
    """Names of run folders, and when each last finished a step [ns]; 0 where that cannot be told."""
    for entry in os.scandir(folder):
        if not entry.name.isprintable():  # none of ours, and no text for the database
            continue
        try:
            yield entry.name, os.stat(f"{entry.path}/state.json").st_mtime_ns
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError:  # no rights, a link to itself: `read_run` says which
            yield entry.name, 0


def last_accepted(run: Path) -> Path | None:
    """The newest accepted run of the same machine and loop that is older than this one."""
    with open_history(run.parent) as history:
        runs = history.runs()
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
