"""Loops kept for later runs: one JSON file each, found by robot, tool, sub-region and checksum."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, read_json, sha256_text
from agent.recipe import Recipe
from agent.runs.approved import digest, problem
from agent.runs.folder import from_plain, make_folder, write_json
from agent.runs.past_run import controller_key

#: Where loops are kept by default: among the runs.
FOLDER = Path("logs") / "trajectories"
_SCHEMA = "loop/1"


@dataclass(frozen=True)
class StoredLoop:
    """A loop with the program that runs it.

    `key` is the digest of the problem that it solves, `checksum` the SHA-256 of the program's text, as a controller
    reports it. `tool` and `sub_region` are plain data; poses (K) (4, 4), start (n,) [rad]; `created` in UTC, ISO 8601.
    """

    key: str
    robot: str
    tool: dict[str, Any] | None
    sub_region: dict[str, Any]
    search: dict[str, Any]
    fitness: float
    genome: tuple[float, ...]
    poses: tuple[tuple[tuple[float, ...], ...], ...]
    start: tuple[float, ...]
    program_name: str
    program: str
    checksum: str
    created: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data, as in the file."""
        return {"schema": _SCHEMA, **asdict(self)}

    def line(self) -> str:
        """One line for a list."""
        kind = next(iter(self.sub_region))
        tool = "no tool" if self.tool is None else f"tool {self.tool['mass']:g} kg"
        return (
            f"{self.created}  {self.robot}  {tool}  {len(self.poses)} points in {kind} {self.key[:8]}  "
            f"fitness {self.fitness:.2f}  program {self.program_name} {self.checksum[:12]}"
        )


def keep_loop(
    recipe: Recipe,
    genome: np.ndarray,
    poses: np.ndarray,
    start: np.ndarray,
    fitness: float,
    program_name: str,
    program: str,
    folder: Path = FOLDER,
    now: datetime | None = None,
) -> StoredLoop:
    """Keep a loop; the same loop found again replaces its file.

    Args:
        recipe: that the loop was searched for.
        genome: (g,) of the loop in [0, 1].
        poses: via-points (K, 4, 4) [m].
        start: joint positions (n,) [rad or m] of the first.
        fitness: log10 det(HᵀH/M).
        program_name, program: as the controller gets it.
        folder: of stored loops.
        now: time of storing; None: of the clock.

    Raises:
        AgentError: the folder cannot be written.
    """
    purpose = problem(recipe)
    loop = StoredLoop(
        key=digest(purpose),
        robot=recipe.robot.name,
        tool=purpose["tool"],
        sub_region=purpose["sub_region"],
        search=recipe.search.model_dump(),
        fitness=float(fitness),
        genome=_tuples(genome),
        poses=_tuples(poses),
        start=_tuples(start),
        program_name=program_name,
        program=program,
        checksum=sha256_text(program),
        created=(now or datetime.now(UTC)).isoformat(timespec="seconds"),
    )
    make_folder(folder, "loops")
    name = f"{loop.robot}_{loop.key[:12]}_{loop.checksum[:12]}.json"
    write_json(folder / name, loop.to_dict())
    return loop


def stored_loops(folder: Path = FOLDER, damaged: list[str] | None = None) -> list[StoredLoop]:
    """All loops in a folder, by robot, sub-region and age, newest first; none where there is no folder.

    Args:
        damaged: collects messages about files that cannot be read; without it, they are an error.

    Raises:
        InputError: a file that is damaged, or whose program is not the one of its checksum.
    """
    loops = []
    for path in sorted(folder.glob("*.json")) if folder.is_dir() else []:
        try:
            loops.append(_read(path))
        except InputError as error:
            if damaged is None:
                raise
            damaged.append(str(error))
    loops.sort(key=lambda loop: loop.created, reverse=True)
    loops.sort(key=lambda loop: (loop.robot, loop.key))
    return loops


def find_loop(recipe: Recipe, folder: Path = FOLDER, program: str | None = None) -> StoredLoop | None:
    """The newest loop kept for a recipe's robot, tool, sub-region and motion settings, or None.

    Args:
        program: SHA-256 (hex) of the program's text, to accept only that one.

    Raises:
        InputError: there is none among those that can be read, and some cannot; or what the file says of the tool and
            the sub-region is not the recipe's.
    """
    parts = problem(recipe)
    key = digest(parts)
    damaged: list[str] = []
    for loop in stored_loops(folder, damaged):
        if loop.key == key and program in (None, loop.checksum):
            for name in ("tool", "sub_region"):
                if getattr(loop, name) != parts[name]:
                    raise InputError(
                        f"{folder}: the stored loop {loop.checksum[:12]} was changed: its {name} is not the one that "
                        "its key stands for; move it away and calibrate again"
                    )
            return loop
    if damaged:
        raise InputError("; ".join(damaged))
    return None


def run_key(recipe: Recipe) -> dict[str, str]:
    """The loop's key and the controller, by which later runs find this one."""
    controller = controller_key(f"{recipe.controller.driver} {recipe.controller.address}")
    return {"loop": digest(problem(recipe)), "controller": controller}


def _read(path: Path) -> StoredLoop:
    try:
        data = read_json(path)
        if data.pop("schema") != _SCHEMA:
            raise ValueError("another schema")
        loop = from_plain(StoredLoop, data)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a stored loop ({error}); move it away") from None
    if sha256_text(loop.program) != loop.checksum:
        raise InputError(f"{path}: its program is not the one that was stored (checksum differs); move it away")
    return loop


def _tuples(array: np.ndarray) -> Any:
    rows = array.tolist()
    return tuple(tuple(map(tuple, row)) if array.ndim == 3 else row for row in rows)
