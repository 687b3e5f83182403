"""From a folder or object store to tasks: a robot, a run, its logs, and their description and model.

A task is a folder with logs. Its robot is named after the folder of the nearest `robot.yaml` below the source; without
one (one description for all), after the folder above the run; without that, after the serial or robot in the state of a
run folder, or after the folder itself.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

from agent.core import InputError, sha256_text
from agent.diagnosis import check_effects
from agent.estimation import EstimationSettings
from agent.fleet.store import Store, StoredFile
from agent.pipeline import check_structure
from agent.robot import RobotDescription, load_robot

#: Logs of a run folder of the agent that each kind of task uses; of any other folder all are used.
_OF_A_RUN = {
    "estimate": ("excitation.mcap",),
    "validate": ("validation_*.mcap",),
    "diagnose": ("excitation.mcap", "validation_*.mcap"),
}
_STATE, _ROBOT, _PAGE = "state.json", "robot.yaml", "report.html"
#: In a run folder of the agent; it holds the robot's description as well.
RUN_MODEL = "model.json"
#: Packages of the agent that no figure depends on, and libraries that all depend on.
_NO_FIGURES, _LIBRARIES = ("cli", "notebook", "pages"), ("numpy", "scipy", "pin", "clarabel")


@dataclass(frozen=True)
class RunQuestion:
    """The question to every run: the options of the single command, with the same meaning.

    `robot` is None where the description is in the store. `model` is the name of the model file to look for in or above
    each run, or, with its `model_content`, that of the one for all; "" for none.
    """

    kind: str
    robot: RobotDescription | None = None
    model: str = ""
    model_content: bytes | None = None
    cutoff: float | None = None
    method: str | None = None
    structure: str = "rigid"
    without: tuple[str, ...] = ()
    allow_mixed: bool = False
    force: bool = False

    @property
    def key(self) -> str:
        """Digest of everything that the figures depend on except the inputs (16 hex digits)."""
        asked = {
            **vars(self),
            "robot": None if self.robot is None else self.robot.to_dict(),
            "model_content": hashlib.sha256(self.model_content or b"").hexdigest(),
            "version": figures_version(),
        }
        return sha256_text(json.dumps(asked, sort_keys=True))[:16]

    @property
    def wanted_model(self) -> str:
        """Name of the model file that every run has to have; "" where there is one for all, or none."""
        return self.model if self.model_content is None else ""


@dataclass(frozen=True)
class Task:
    """One robot and run. `run` is the folder below the source, "." for the source itself; `description` is the robot's,
    or a run folder's model."""

    question: RunQuestion
    source: str
    robot: str
    run: str
    logs: tuple[StoredFile, ...]
    description: StoredFile | None = None
    model: StoredFile | None = None
    state: StoredFile | None = None
    page: str = ""

    @property
    def files(self) -> tuple[StoredFile, ...]:
        """All its files in the store."""
        return (*self.logs, *(path for path in (self.description, self.model, self.state) if path is not None))


@dataclass(frozen=True)
class SourceTasks:
    """Tasks of a source, sorted by robot and run, and the listing (size and stamp by path) by which files are compared
    with those of an earlier run."""

    tasks: tuple[Task, ...]
    listing: dict[str, tuple[int, str]]


@cache
def figures_version() -> str:
    """Digest of the agent's source and of library versions (16 hex digits): other ones may give other figures."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(" ".join(version(library) for library in _LIBRARIES).encode())
    for path in sorted(package.rglob("*")):
        name = path.relative_to(package)
        if path.suffix in (".py", ".yaml", ".urdf", ".json") and name.parts[0] not in _NO_FIGURES:
            digest.update(f"{name}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def make_question(kind: str, robot: str | None, model: str | None, **options: Any) -> RunQuestion:
    """A question, with the robot and the model file that are named.

    A `model` that is no local file is a name to look for in or above every run.

    Args:
        kind: of the question, as the command is called.
        robot: name or file of the description; None: that of each run.
        model: file, or name in or above each run.
        options: of the kind.

    Raises:
        InputError: a robot or a file that cannot be used, or an unknown effect, method, structure or cut-off.
    """
    # what no run can answer is reported once, before any is run
    check_effects(options.get("without", ()))
    EstimationSettings.create(cutoff=options.get("cutoff"), method=options.get("method"))
    check_structure(options.get("structure", "rigid"))
    content = None
    if model and Path(model).is_file():
        content, model = Path(model).read_bytes(), Path(model).name
    elif model and ("/" in model or "\\" in model):
        raise InputError(f"{model}: no such model file; name one, or the name that it has in or above every run")
    described = None if robot is None else load_robot(robot)
    return RunQuestion(kind, described, model or "", content, **options)


def find_tasks(store: Store, question: RunQuestion) -> SourceTasks:
    """All tasks of a source.

    Raises:
        InputError: there is no folder with logs, or none of them has the model that was named.
    """
    wanted = {_STATE, _ROBOT, _PAGE, RUN_MODEL, question.wanted_model}
    folders: dict[str, dict[str, StoredFile]] = {}
    listing: dict[str, tuple[int, str]] = {}
    for file in store.files():
        if file.name in wanted or file.name.endswith(".mcap"):
            folders.setdefault(file.folder, {})[file.name] = file
        if file.name in wanted or file.name.endswith((".mcap", ".urdf", ".xml")):
            listing[file.path] = (file.size, file.stamp)
    every = (_task(store, question, folders, folder) for folder in folders)
    tasks = sorted((task for task in every if task.logs), key=lambda task: (task.robot, task.run))
    if not tasks:
        raise InputError(f"{store.url}: no folder in it has logs (*.mcap) for {question.kind}")
    # what robot it is, a validation's model says, and a diagnosis's
    has_robot = question.robot is not None or question.kind == "validate" or question.model
    if not has_robot and all(task.description is None and task.state is None for task in tasks):
        raise InputError(
            f"{store.url}: there is no {_ROBOT} in or above any run; put one there, or name the robot with --robot"
        )
    model = question.wanted_model
    if model and all(task.model is None for task in tasks):
        raise InputError(
            f"{store.url}: no run in it has {model} in or above it; name a model file with --model, or the name that "
            "it has there"
        )
    return SourceTasks(tuple(tasks), listing)


def _task(store: Store, question: RunQuestion, folders: Mapping[str, Mapping[str, StoredFile]], folder: str) -> Task:
    """The task of a folder; without logs where it is none."""
    files = folders[folder]
    state = files.get(_STATE)
    patterns = _OF_A_RUN[question.kind] if state is not None else ("*.mcap",)
    # as a shell sorts them, within each pattern
    logs = tuple(files[name] for pattern in patterns for name in sorted(fnmatch.filter(files, pattern)))
    above = described = None
    if question.robot is None:
        above = _nearest(folders, folder, _ROBOT)
        described = above or (files.get(RUN_MODEL) if state is not None else None)
    model = _nearest(folders, folder, question.wanted_model)
    page = files[_PAGE].path if _PAGE in files else ""
    robot = _machine_of(store, folder, above, state) if logs else ""
    return Task(question, store.url, robot, folder, logs, described, model, state, page)


def _machine_of(store: Store, folder: str, described: StoredFile | None, state: StoredFile | None) -> str:
    if described is not None and described.folder != ".":
        return described.folder
    parent = str(PurePosixPath(folder).parent)
    if parent != ".":
        return parent
    if state is not None:
        # a state that is none says nothing of the run
        with contextlib.suppress(ValueError, RecursionError, AttributeError, FileNotFoundError):
            stored = json.loads(store.read(state.path))
            machine = stored.get("serial") or stored.get("robot")
            if isinstance(machine, str):
                return machine
    return folder if folder != "." else PurePosixPath(store.url.rstrip("/")).name


def _nearest(folders: Mapping[str, Mapping[str, StoredFile]], folder: str, name: str) -> StoredFile | None:
    """A file of this name in a folder or the nearest one above it, within the source."""
    path = PurePosixPath(folder)
    places = (folders.get(str(place), {}) for place in (path, *path.parents))
    return next((files[name] for files in places if name in files), None)
