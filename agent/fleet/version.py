"""What the figures of a result hang on: the source of the rooms that make them, and the libraries they calculate with.

A result that another version made is made again only where this says that it could be another one.
"""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from typing import Any

_ESTIMATE = ("robot", "recording", "model", "estimation")
_FILES = ("pipeline/identify.py", "pipeline/conditions.py", "fleet/figures.py")
_ROOMS = {
    "estimate": _ESTIMATE,
    "validate": (*_ESTIMATE, "validation"),
    "diagnose": (*_ESTIMATE, "validation", "simulation", "diagnosis"),
}
_LIBRARIES = ("numpy", "scipy", "pin", "clarabel")


@cache
def figures_version(kind: str, structure: bool = False) -> str:
    """A name for everything that the figures of a kind of task hang on beside its inputs (16 hex digits).

    `structure`: an estimate that looks for effects as well.
    """
    digest = hashlib.sha256()
    package = files("agent")
    more = ("pipeline/diagnose.py",) if kind == "diagnose" else ()
    for room in _ROOMS["diagnose" if structure else kind]:
        _add(digest, package / room, room)
    for name in (*_FILES, *more):
        digest.update(name.encode() + b"\0" + (package / name).read_bytes())
    for library in _LIBRARIES:
        digest.update(f"{library} {version(library)}\0".encode())
    return digest.hexdigest()[:16]


def _add(digest: Any, folder: Any, name: str) -> None:
    for entry in sorted(folder.iterdir(), key=lambda one: one.name):
        if entry.is_dir():
            if not entry.name.startswith(("__", ".")):
                _add(digest, entry, f"{name}/{entry.name}")
        elif entry.name.endswith((".py", ".yaml", ".urdf", ".json")):
            digest.update(f"{name}/{entry.name}".encode() + b"\0" + entry.read_bytes())
