"""From a folder or an object store to tasks: a robot, a run, its logs, and the description and model that go with them.

A task is a folder with logs. Whose it is says the folder of the nearest `robot.yaml` below the source; where there is
none (one description for all), the folder above the run's; where there is none of these either, the serial or name that
a run folder of the agent tells, or the folder's own name.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import json
import posixpath
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

from agent.core import InputError
from agent.fleet.store import Store, StoredFile

KINDS = ("estimate", "validate", "diagnose")
#: Which logs of a run folder of the agent go into what; of any other folder all do.
_OF_A_RUN = {
    "estimate": ("excitation.mcap",),
    "validate": ("validation_*.mcap",),
    "diagnose": ("excitation.mcap", "validation_*.mcap"),
}
_STATE, _ROBOT, _PAGE = "state.json", "robot.yaml", "report.html"
#: In a run folder of the agent: says what the robot was, too.
RUN_MODEL = "model.json"
#: Packages of the agent on which no figure hangs, and libraries on which all do.
_NO_FIGURES, _LIBRARIES = ("cli", "notebook", "report"), ("numpy", "scipy", "pin", "clarabel")


@dataclass(frozen=True)
class Given:
    """A file that the command line names for all robots, on its way to the workers."""

    name: str
    content: bytes


@dataclass(frozen=True)
class RunQuestion:
    """What is asked of every run: the options of the single command, with the same meaning.

    `robot` is a built-in robot's name, or "" where the description is in the store or among `given`; `model` is the
    name of the model file to look for in or above each run, or of the one among `given`; "" for none.
    """

    kind: str
    robot: str = ""
    model: str = ""
    cutoff: float | None = None
    method: str | None = None
    structure: str = "rigid"
    without: tuple[str, ...] = ()
    allow_mixed: bool = False
    force: bool = False
    given: tuple[Given, ...] = ()

    @property
    def key(self) -> str:
        """Of everything but the inputs that the figures hang on (16 hex digits)."""
        asked = asdict(replace(self, given=()))
        asked["given"] = [(one.name, hashlib.sha256(one.content).hexdigest()) for one in self.given]
        asked["version"] = figures_version()
        return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()[:16]

    def gives(self, name: str) -> bool:
        """Whether the command line gives a file of this name."""
        return any(PurePosixPath(one.name).name == name for one in self.given)


@dataclass(frozen=True)
class Task:
    """One robot and run. `run` is the folder below the source, "." for the source itself; `files` are its logs, and
    description (or a run folder's model), model and state where the store has them; `known` the SHA-256
    of the inputs of the row that is there already, by path."""

    question: RunQuestion
    source: str
    robot: str
    run: str
    logs: tuple[StoredFile, ...]
    description: StoredFile | None = None
    model: StoredFile | None = None
    state: StoredFile | None = None
    page: str = ""
    known: tuple[tuple[str, str], ...] = ()

    @property
    def files(self) -> tuple[StoredFile, ...]:
        """Everything of the store that was found for it."""
        return (*self.logs, *(one for one in (self.description, self.model, self.state) if one is not None))


@dataclass(frozen=True)
class SourceTasks:
    """What a source holds: tasks in the order of robot and run, and the listing (size and stamp by path) that tells
    whether a file is the one that was read."""

    tasks: tuple[Task, ...]
    listing: dict[str, tuple[int, str]]


@cache
def figures_version() -> str:
    """A name for everything that figures hang on besides their inputs (16 hex digits): another program, or another
    version of a library, may give other ones."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(" ".join(version(library) for library in _LIBRARIES).encode())
    for path in sorted(package.rglob("*")):
        name = path.relative_to(package)
        if path.suffix in (".py", ".yaml", ".urdf", ".json") and name.parts[0] not in _NO_FIGURES:
            digest.update(f"{name}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def make_question(kind: str, robot: str | None, model: str | None, **options: Any) -> RunQuestion:
    """A question, with the files that `robot` and `model` name on this machine read.

    A `model` that is no file here is a name to look for in or above every run.

    Raises:
        InputError: a robot or a file that cannot be used, or an unknown effect, method, structure or cut-off.
    """
    from agent.diagnosis import check_effects
    from agent.estimation import EstimationSettings
    from agent.pipeline import check_structure
    from agent.robot import builtin_robots, load_robot

    # what no run can answer is reported once, before any is run
    check_effects(options.get("without", ()))
    EstimationSettings.create(cutoff=options.get("cutoff"), method=options.get("method"))
    check_structure(options.get("structure", "rigid"))
    given: list[Given] = []
    if robot is not None:
        load_robot(robot)
        if robot not in builtin_robots():
            given += _description(Path(robot))
    described = bool(given)
    if model and Path(model).is_file():
        given.append(Given(Path(model).name, Path(model).read_bytes()))
        model = Path(model).name
    elif model and ("/" in model or "\\" in model):
        raise InputError(f"{model}: no such model file; name one, or the name that it has in or above every run")
    return RunQuestion(kind, robot if robot and not described else "", model or "", given=tuple(given), **options)


def find_tasks(store: Store, question: RunQuestion) -> SourceTasks:
    """All tasks of a source.

    Raises:
        InputError: there is no folder with logs, or none of them has the model that was named.
    """
    wanted = {_STATE, _ROBOT, _PAGE, RUN_MODEL, question.model}
    folders: dict[str, dict[str, StoredFile]] = {}
    listing: dict[str, tuple[int, str]] = {}
    for file in store.files():
        if file.name in wanted or file.name.endswith(".mcap"):
            folders.setdefault(file.folder, {})[file.name] = file
        if file.name in wanted or file.name.endswith((".mcap", ".urdf", ".xml")):
            listing[file.path] = (file.size, file.stamp)
    found = (_task(store, question, folders, folder) for folder in folders)
    tasks = sorted((task for task in found if task.logs), key=lambda task: (task.robot, task.run))
    if not tasks:
        raise InputError(f"{store.url}: no folder in it has logs (*.mcap) for {question.kind}")
    # what robot it is, a validation's model says, and a diagnosis's
    told = question.robot or question.gives(_ROBOT) or question.kind == "validate" or question.model
    if not told and all(task.description is None and task.state is None for task in tasks):
        raise InputError(
            f"{store.url}: there is no {_ROBOT} in or above any run; put one there, or name the robot with --robot"
        )
    model = question.model
    if model and not question.gives(model) and all(task.model is None for task in tasks):
        raise InputError(
            f"{store.url}: no run in it has {model} in or above it; name a model file with --model, or the name that "
            "it has there"
        )
    return SourceTasks(tuple(tasks), listing)


def _task(store: Store, question: RunQuestion, folders: Mapping[str, Mapping[str, StoredFile]], folder: str) -> Task:
    """The task of a folder; without logs where it is none."""
    here = folders[folder]
    state = here.get(_STATE)
    patterns = _OF_A_RUN[question.kind] if state is not None else ("*.mcap",)
    # as a shell sorts them, within each pattern
    logs = tuple(here[name] for pattern in patterns for name in sorted(fnmatch.filter(here, pattern)))
    asked = question.robot or question.gives(_ROBOT)
    above = None if asked else _nearest(folders, folder, _ROBOT)
    described = above or (here.get(RUN_MODEL) if state is not None and not asked else None)
    model = question.model and not question.gives(question.model) and _nearest(folders, folder, question.model)
    page = here[_PAGE].path if _PAGE in here else ""
    robot = _whose(store, folder, above, state) if logs else ""
    return Task(question, store.url, robot, folder, logs, described, model or None, state, page)


def _whose(store: Store, folder: str, described: StoredFile | None, state: StoredFile | None) -> str:
    if described is not None and described.folder != ".":
        return described.folder
    parent = str(PurePosixPath(folder).parent)
    if parent != ".":
        return parent
    if state is not None:
        # a state that is none says nothing of the run
        with contextlib.suppress(ValueError, RecursionError, AttributeError, FileNotFoundError):
            told = json.loads(store.read(state.path))
            found = told.get("serial") or told.get("robot")
            if isinstance(found, str):
                return found
    return folder if folder != "." else PurePosixPath(store.url.rstrip("/")).name


def _nearest(folders: Mapping[str, Mapping[str, StoredFile]], folder: str, name: str) -> StoredFile | None:
    """A file of this name in a folder or the nearest one above it, within the source."""
    path = PurePosixPath(folder)
    places = (folders.get(str(place), {}) for place in (path, *path.parents))
    return next((files[name] for files in places if name in files), None)


def _description(path: Path) -> Sequence[Given]:
    """A description and its URDF, at places as they have them to each other."""
    from agent.core import read_yaml

    path = path / _ROBOT if path.is_dir() else path
    urdf = PurePosixPath(str(read_yaml(path)["urdf"]))
    described = Given("/".join(["above"] * urdf.parts.count("..") + [_ROBOT]), path.read_bytes())
    if urdf.is_absolute():  # the workers have to have it there, too
        return [described]
    return [described, Given(posixpath.normpath(f"{described.name}/../{urdf}"), (path.parent / urdf).read_bytes())]
