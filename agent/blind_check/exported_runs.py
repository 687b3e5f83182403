"""Runs for any tool: recorded where nobody looks, then copied so that nothing but the samples says what they hold."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agent.blind_check.key import NAME, VERSION, Key
from agent.blind_check.worlds import Truth, World
from agent.core import AgentError, Console, InProcess, InputError, TaskEngine, read_yaml, write_atomically
from drivers.errors import DriverError

#: Describes the runs of a folder; written last, so a folder with it is complete.
INDEX = "benchmark.json"
#: When every session of a run seems to have been recorded, and every file to have been written [s since 1970].
_SESSIONS = {"baseline": 1_600_000_000, "logs": 1_600_086_400}
_PAUSE = 5.0  # s between the motions of a session
_PADDING = 0.15  # of a log's size, at most: file sizes do not tell how well the samples compress


def export_runs(
    world: World,
    folder: Path,
    key_file: Path,
    count: int,
    seed: int | None = None,
    console: Console | None = None,
    engine: TaskEngine | None = None,
) -> Key:
    """Write the runs to `folder` and the key to `key_file`. An interrupted export continues where it stopped.

    A key that is there already draws its own runs again.

    Parameters
    ----------
    world : World
        Where the runs come from.
    folder, key_file : Path
        The key must lie outside the folder.
    count : int
        Runs to make.
    seed : int, optional
        Of a draw by laws of development; from the operating system if absent, for a draw by laws of judgement.
    console, engine : optional
        What to tell a person, and who does the recordings.

    Raises
    ------
    InputError
        No runs, a key inside the folder, a folder with other files, or a key of another draw.
    """
    console, engine = console or Console(verbosity=-1), engine or InProcess()
    key = _stored_or_drawn(world, folder, key_file, count, seed)
    staging = key_file.with_name(f"{key_file.name}.parts")
    staging.mkdir(0o700, parents=True, exist_ok=True)
    lock = os.open(staging, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        key = _fill(key, world, staging, folder, key_file, console, engine)
    except BlockingIOError:
        raise InputError(f"{key_file}: another export is recording these runs; wait for it") from None
    finally:
        os.close(lock)
    shutil.rmtree(staging)
    return key


def _fill(
    key: Key, world: World, staging: Path, folder: Path, key_file: Path, console: Console, engine: TaskEngine
) -> Key:
    """Record what is missing, publish all runs, and save the key with them."""
    truths = world.draw(key.count, key.entropy, key.laws)
    rng = np.random.default_rng([key.entropy, 1])
    labels = _labels(rng, 2 * len(truths))
    tasks = [(truth, staging / f"{number:04d}") for number, truth in enumerate(truths)]
    for count, done in enumerate(engine.map(partial(_recorded, world), tasks), start=1):
        if done.answer is None:
            raise AgentError(f"blind check: {done.lost}")
        console.progress(f"{count} of {len(tasks)} runs recorded", count / len(tasks))
    runs: list[dict[str, Any]] = []
    failed: list[dict[str, Any]] = []
    for (truth, folder_of_run), label, serial in zip(tasks, labels[::2], labels[1::2], strict=True):
        outcome = json.loads((folder_of_run / "truth.json").read_text(encoding="utf-8"))
        made = {"run": label, "serial": f"SN-{serial}", **truth, **outcome, "number": int(folder_of_run.name)}
        (failed if "error" in outcome else runs).append(made)
    runs.sort(key=lambda run: run["run"])  # the order of the files says nothing about the draw
    for run in runs:
        _publish(staging / f"{run['number']:04d}", folder / "runs" / run["run"], run["serial"], rng)
    key = replace(key, runs=runs, not_recorded=failed)
    about: dict[str, Any] = {
        "schema": "blind-benchmark/1",
        "name": NAME,
        "version": VERSION,
        "world": world.name,
        "laws": key.laws,
    }
    about |= {"runs": len(runs), "key_sha256": key.save(key_file)}
    write_atomically(folder / INDEX, json.dumps(about, indent=1) + "\n")
    for path in (folder, *folder.rglob("*")):
        os.utime(path, (_SESSIONS["logs"],) * 2)
    return key


def _stored_or_drawn(world: World, folder: Path, key_file: Path, count: int, seed: int | None) -> Key:
    """The draw of a key that is there, or a fresh one, which is saved at once.

    Raises:
        InputError: see `export_runs`.
    """
    if count < 1:
        raise InputError(f"blind check: --cases {count}: at least one run is needed")
    if key_file.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{key_file}: the key must lie outside {folder}, which is handed on; name another --key")
    if folder.exists() and (not folder.is_dir() or (folder / INDEX).exists()):
        raise InputError(f"{folder}: holds a benchmark already, or is a file; name another folder")
    if not key_file.exists():
        if folder.exists() and any(folder.iterdir()):
            raise InputError(f"{folder}: is not empty; name another folder")
        key = Key.fresh(world.name, count, seed)
        key.save(key_file)
        return key
    return Key.load(key_file, (world.name, count, seed))


def _labels(rng: np.random.Generator, count: int) -> list[str]:
    """Distinct random names."""
    labels: dict[str, None] = {}
    while len(labels) < count:
        labels[rng.bytes(4).hex()] = None
    return list(labels)


def _recorded(world: World, task: tuple[Truth, Path]) -> bool:
    """Record a run into a folder, unless that is done; its `truth.json` says how large the effects are, or why not."""
    truth, folder = task
    note = folder / "truth.json"
    if not note.exists():
        shutil.rmtree(folder, ignore_errors=True)  # of an export that was stopped in the middle of it
        folder.mkdir(parents=True)
        outcome: dict[str, Any]
        try:
            outcome = world.write(truth, folder)
        except (AgentError, DriverError) as error:
            outcome = {"error": str(error)}
        write_atomically(note, json.dumps(outcome))
    return True


def _publish(source: Path, target: Path, serial: str, rng: np.random.Generator) -> None:
    """Copy a recorded run: description as it is, logs under common dates and a serial of no meaning."""
    from agent.recording import LogCopy

    shutil.rmtree(target, ignore_errors=True)
    if not (source / "baseline").exists():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("truth.json"))
        return
    for session, begins in _SESSIONS.items():
        (target / session).mkdir(parents=True)
        at = float(begins)
        for log in sorted(map(LogCopy, (source / session).glob("*.mcap")), key=lambda log: log.first_stamp):
            padding = int(rng.uniform(0, _PADDING) * log.source.stat().st_size)
            at = _PAUSE + log.write(target / session / log.source.name, at, {"serial": serial}, padding)
    for name in ("robot.yaml", str(read_yaml(source / "robot.yaml")["urdf"])):
        shutil.copyfile(source / name, target / name)
