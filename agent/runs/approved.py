"""The inputs a motion was approved with: everything that decides where the arm goes, by part and as one digest.

A plan, a stored loop, a run and an authorisation carry the digest. Before the arm moves, it is compared with the recipe
and its files, and every difference is named. This protects against mistakes and changed files, not against somebody who
may write all of them (docs/security.md).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from agent.core import InputError, read_json, sha256_file, sha256_text
from agent.motion import ARM, CONTROLLER, ENTRY_POINTS, LIBRARY, dialect_of, is_file_name
from agent.recipe import Recipe, ViaPointsSection
from agent.runs.folder import RunFolder

FILE = "approved.json"
_SCHEMA = "approved/1"
#: Names of the parts of a problem for people.
_NAMES = {
    "robot": "robot.yaml",
    "tool": "the recipe's tool",
    "cell": "the recipe's cell",
    "sub_region": "the recipe's motion.via_points",
    "settings": "the recipe's motion",
    "rate": "the recipe's record.rate",
    "interpolator": "the recipe's search.interpolator",
}
_MAX_LISTED = 5  # differences that are listed; the others are counted
_ABSENT = object()


def problem(recipe: Recipe) -> dict[str, Any]:
    """Everything a loop is searched, checked and planned with, as plain data.

    Files count by their content, not by their path.
    """
    parts = {
        # no loop depends on what a person may mount for another motion
        "robot": {key: value for key, value in recipe.robot.to_dict().items() if key != "rated_payload"},
        "tool": recipe.tool,
        "cell": recipe.cell,
        "sub_region": _sub_region(recipe.motion.via_points),
        "settings": recipe.motion.settings,
        "rate": recipe.record.rate,
        "interpolator": _interpolator(recipe.interpolator),
    }
    return to_jsonable_python(parts, fallback=np.ndarray.tolist)  # as it comes back from a file


def _sub_region(via: ViaPointsSection) -> dict[str, Any]:
    """Its kind, and what it is made of."""
    if via.points is not None:
        return {"pointlist": {"points": [point.model_dump() for point in via.points]}}
    if via.like is None:
        kind = "tube" if via.box is None else "box"
        return {kind: {"count": via.count, **getattr(via, kind).model_dump()}}

    like = Path(via.like)
    region = {"count": via.count, "path": _file_digest(like), "around": via.around or 0.0}
    language = dialect_of(like)
    listing = None if language is None else language.companion(like)
    return {"like": region if listing is None else {**region, "variables": _file_digest(listing)}}


def digest(parts: Any) -> str:
    """SHA-256 (hex) of plain data."""
    return sha256_text(json.dumps(parts, sort_keys=True))


def approve(run: RunFolder, recipe: Recipe) -> None:
    """Write what this run is planned with into its folder, and its digests into the state."""
    parts = problem(recipe)
    run.write_json(FILE, {"schema": _SCHEMA, "parts": parts})
    robot = {key: value for key, value in parts["robot"].items() if key != "urdf"}
    inputs = {
        "robot.yaml": digest(robot),
        "URDF": sha256_text(recipe.robot.urdf),
        **{key: digest(parts[key]) for key in parts if key != "robot"},
    }
    run.note(approved=digest(parts), inputs_sha256={**run.state["inputs_sha256"], **inputs})


def check_approved(run: RunFolder, recipe: Recipe) -> None:
    """Check that a recipe still means the same as when the run was planned.

    Raises:
        InputError: it does not (every part that differs is named), or the record is missing or was changed.
    """
    then, now = approved_parts(run.path, run.state), problem(recipe)
    if digest(then) != digest(now):
        raise InputError(f"{run.path}: {differences(then, now)}; start a new run without --resume")


def approved_parts(run: Path, state: dict[str, Any]) -> dict[str, Any]:
    """The inputs that a run was planned with.

    Raises:
        InputError: missing, damaged, or not what its state says.
    """
    path = run / FILE
    if not path.is_file():
        raise InputError(f"{run}: nothing says what this run was planned with ({FILE} is missing); start a new run")
    data = read_json(path)
    parts = data.get("parts") if isinstance(data, dict) and data.get("schema") == _SCHEMA else None
    if not isinstance(parts, dict) or digest(parts) != state.get("approved"):
        raise InputError(f"{path}: it was changed since the run was planned (SHA-256 differs); start a new run")
    return parts


def differences(then: dict[str, Any], now: dict[str, Any]) -> str:
    """Differences between two problems, in one sentence for people."""
    by_part: dict[str, list[str]] = {}
    for keys, before, after in _differing(then, now):
        part, detail = _where(keys)
        by_part.setdefault(part, []).append(f"{detail} {_change(before, after)}".strip())
    return "; ".join(
        f"{part} differs from the one this run was planned with: {', '.join(changes[:_MAX_LISTED])}"
        + (f" and {len(changes) - _MAX_LISTED} more" if len(changes) > _MAX_LISTED else "")
        for part, changes in by_part.items()
    )


def _where(keys: tuple[str, ...]) -> tuple[str, str]:
    """The file or part, and the key in it."""
    if keys[:2] == ("robot", "urdf"):
        return "the URDF", ""
    if keys[:2] == ("robot", "joints"):
        inner = keys[2:]
        return ("the URDF" if inner[1:] and inner[1] in ("lower", "upper") else _NAMES["robot"]), " ".join(inner)
    return _NAMES.get(keys[0], keys[0]), ".".join(keys[1:])


def _change(before: Any, after: Any) -> str:
    if before is _ABSENT:
        return f"is new ({_short(after)})"
    if after is _ABSENT:
        return f"is gone ({_short(before)})"
    if isinstance(before, str) and len(before) > 40:
        return "(another content)"
    return f"was {_short(before)}, is {_short(after)}"


def _short(value: Any) -> str:
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 40 else f"{text[:37]}…"


def _differing(then: Any, now: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, Any]]:
    """(key, before, after) of every leaf that differs."""
    if then == now:
        return
    before, after = _by_name(then), _by_name(now)
    if before is None or after is None:
        yield keys, then, now
        return
    for key in [*before, *(key for key in after if key not in before)]:
        yield from _differing(before.get(key, _ABSENT), after.get(key, _ABSENT), (*keys, key))


def _by_name(value: Any) -> dict[str, Any] | None:
    """Items of a mapping or a list by their names or numbers; None where it is neither."""
    if isinstance(value, dict):
        return value
    if not isinstance(value, list) or not value:
        return None
    if all(isinstance(item, dict) and isinstance(item.get("name"), str) for item in value):
        return {item["name"]: {key: inner for key, inner in item.items() if key != "name"} for item in value}
    return {str(number + 1): item for number, item in enumerate(value)}


def _interpolator(name: str) -> Any:
    """Its name, with the files or the package version that identify it."""
    if is_file_name(name):
        return {"name": "learned", "file": _file_digest(Path(name))}
    if name == "orl":
        files = {"library": os.environ.get(LIBRARY, ""), "controller": os.environ.get(CONTROLLER, "")}
        digests = {what: _file_digest(Path(path)) for what, path in files.items() if os.path.isfile(path)}
        return {"name": name, **digests, "arm": os.environ.get(ARM, "1")}
    for entry in entry_points(group=ENTRY_POINTS, name=name):
        if entry.dist is not None and not entry.value.startswith("agent."):
            return {"name": name, "package": f"{entry.dist.name} {entry.dist.version}"}
    return name


def _file_digest(path: Path) -> str:
    try:
        return sha256_file(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
