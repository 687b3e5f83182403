"""Which joints of a simulator's file are those of the robot or the logs, by name or by a map."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from agent.core import InputError, load_document


class JointMap(BaseModel):
    """A map file: `joints`, name in the simulator's file → name in the robot description or the logs."""

    model_config = ConfigDict(extra="forbid")
    joints: dict[str, str]


def load_joint_map(path: Path) -> dict[str, str]:
    """Read a map file.

    Raises:
        InputError: not such a file, or two joints with one name.
    """
    joints = load_document(path, JointMap).joints
    twice = {name for name in joints.values() if list(joints.values()).count(name) > 1}
    if twice:
        raise InputError(f"{path}: joints: {', '.join(sorted(twice))} stands for two joints of the simulator's file")
    return joints


def matched(
    path: Path, in_file: Sequence[str], wanted: Sequence[str], owner: str, names: Mapping[str, str] | None
) -> dict[str, str]:
    """File name → name for the joints used, in the file's order.

    `wanted` are the joints of `owner`; all must be found, unless a map (`names`) says which.

    Raises:
        InputError: with what matched and what did not.
    """
    unknown = [name for name in names or {} if name not in in_file]
    strange = [name for name in (names or {}).values() if name not in wanted]
    if unknown or strange:
        raise InputError(
            f"--map: {', '.join(unknown or strange)} is no joint of {path.name if unknown else owner}; "
            f"its joints are {', '.join(in_file if unknown else wanted)}"
        )
    taken = set((names or {}).values())
    found: dict[str, str] = {}
    for name in in_file:
        called = (names or {}).get(name, "" if name in taken else name)
        if called in wanted:
            found[name] = called
    missing = [name for name in wanted if name not in found.values()]
    if not found or (missing and names is None):
        left = [name for name in in_file if name not in found]
        example = ", ".join(f"{a}: {b}" for a, b in zip(left or ["joint_of_file"], missing, strict=False))
        raise InputError(
            f"{path}: its joints don't match those of {owner}: matched {', '.join(found.values()) or 'none'}; only in "
            f"{owner}: {', '.join(missing)}; only in the file: {', '.join(left) or 'none'}. Say which is which with "
            f"--map FILE, in YAML: joints: {{{example}}}"
        )
    return found


def leaving_out(used: Mapping[str, str], left_out: Collection[str]) -> str:
    """Advice, to end a message with: the map under which joints of the file are not compared."""
    kept = ", ".join(f"{name}: {called}" for name, called in used.items() if name not in left_out)
    it = "it" if len(left_out) == 1 else "them"
    return f"leave {it} out with --map FILE, in YAML: joints: {{{kept}}}" if kept else "none is left to compare"


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names for a message, not all of very many."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
