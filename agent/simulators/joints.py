"""Joints of a simulator's file matched to those of the robot or the logs, by name or by a map."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from difflib import SequenceMatcher
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from agent.core import InputError, counted, load_document
from agent.recording import counted_apart, joint_pairs, number_of
from agent.robot import is_gripper

#: Similarity from which two names may mean one joint.
_ALIKE = 0.6
#: Joints of every branch of a file, base to tip.
Branches = Callable[[], list[list[str]]]
#: (joints of a file, its branches) → their names in the arm; joints without one are left out.
Match = Callable[[Sequence[str], Branches], Mapping[str, str]]


class JointMap(BaseModel):
    """A map file: `joints`, name in the simulator's file → name in the robot description or the logs, or null."""

    model_config = ConfigDict(extra="forbid")
    joints: dict[str, str | None]


def load_joint_map(path: Path) -> dict[str, str | None]:
    """Read a map file.

    Raises:
        InputError: not such a file, or two joints with one name.
    """
    joints = load_document(path, JointMap).joints
    called = [name for name in joints.values() if name is not None]
    duplicates = {name for name in called if called.count(name) > 1}
    if duplicates:
        raise InputError(
            f"{path}: joints: {', '.join(sorted(duplicates))} stands for two joints of the simulator's file"
        )
    return joints


def matched(
    path: Path,
    in_file: Sequence[str],
    wanted: Sequence[str],
    owner: str,
    names: Mapping[str, str | None] | None,
    arms: Callable[[], Sequence[Sequence[str]]] = tuple,
) -> dict[str, str]:
    """File name → name for the joints used, in the file's order.

    `wanted` are the joints of `owner`; all but grippers must be found, unless a map (`names`) says which. A joint is
    found by its name, whatever prefix says its side or role, unless the map leaves it out (None).
    `arms` are those of the file, base to tip.

    Raises:
        InputError: with what matched and what did not.
    """
    unknown = [name for name in names or {} if name not in in_file]
    strange = [name for name in (names or {}).values() if name is not None and name not in wanted]
    if unknown or strange:
        raise InputError(
            f"--map: {', '.join(unknown or strange)} is no joint of {path.name if unknown else owner}; "
            f"its joints are {', '.join(in_file if unknown else wanted)}"
        )
    mapped = {name: called for name, called in (names or {}).items() if called is not None}
    free = [name for name in in_file if name not in (names or {}) and name not in mapped.values()]
    pairs = mapped | joint_pairs(free, [name for name in wanted if name not in mapped.values()])
    matches = {name: pairs[name] for name in in_file if name in pairs}
    missing = [name for name in wanted if name not in matches.values() and not is_gripper(name)]
    if len(matches) == len(in_file) and _of_another_arm(missing, [*matches.values()]):
        missing = []
    if not matches or (missing and names is None):
        unmatched = [name for name in in_file if name not in matches]
        likeliest = max(
            (_proposed([name for name in arm if name in unmatched], missing) for arm in arms()), key=len, default=[]
        )
        example = _map_of(dict(likeliest or _proposed(unmatched, missing)) or matches)
        counts = f"{counted(len(in_file), 'joint')} in the file, {len(wanted)} in {owner}"
        fewer = f" {counts}: is it of this arm?" if len(in_file) < len(wanted) else ""
        raise InputError(
            f"{path}: its joints don't match those of {owner}: matched {', '.join(matches.values()) or 'none'}; only "
            f"in {owner}: {', '.join(missing)}; only in the file: {', '.join(unmatched) or 'none'}.{fewer} Say which "
            f"is which with --map FILE, in YAML: joints: {example}"
        )
    return matches


def _of_another_arm(names: Sequence[str], arm: Sequence[str]) -> bool:
    """Whether names are those of an arm's joints, but for another beginning: right_joint_1 for left_joint_1."""
    if not names or not arm:
        return False
    own, other = _beginning(arm), _beginning(names)
    return own != other and {name[len(other) :] for name in names} <= {name[len(own) :] for name in arm} - {""}


def _beginning(names: Sequence[str]) -> str:
    """What all names begin with."""
    first, last = min(names), max(names)
    return first[: next((k for k, pair in enumerate(zip(first, last, strict=False)) if len({*pair}) > 1), len(first))]


def _map_of(pairs: Mapping[str, str | None]) -> str:
    """A map in YAML, names in quotes where they would be no text without."""
    plain = re.compile(r"(?!(?i:y|n|yes|no|on|off|true|false|null)$)[A-Za-z_][\w./-]*", re.ASCII)

    def text(name: str | None) -> str:
        return "null" if name is None else name if plain.fullmatch(name) else json.dumps(name)

    return f"{{{', '.join(f'{text(name)}: {text(called)}' for name, called in pairs.items())}}}"


def _proposed(in_file: Sequence[str], wanted: Sequence[str]) -> list[tuple[str, str]]:
    """Likely pairs in the file's order. Similar names first, because logs are often in alphabetical order."""
    if counted_apart(in_file, wanted):
        return list(zip(in_file, sorted(wanted, key=number_of), strict=False))
    plain = {name: name.lower().replace("_", "") for name in (*in_file, *wanted)}
    plain = {name: own.replace("joint", "") or own for name, own in plain.items()}  # which does not identify one
    likeness = {(a, b): SequenceMatcher(None, plain[a], plain[b]).ratio() for a in in_file for b in wanted}
    pairs: dict[str, str] = {}
    for (a, b), alike in sorted(likeness.items(), key=lambda entry: -entry[1]):
        if alike > _ALIKE and a not in pairs and b not in pairs.values():
            pairs[a] = b
    unpaired = [name for name in wanted if name not in pairs.values()]
    pairs |= zip((name for name in in_file if name not in pairs), unpaired, strict=False)
    return [(name, pairs[name]) for name in in_file if name in pairs]


def leaving_out(used: Mapping[str, str], left_out: Collection[str]) -> str:
    """The end of a message: the map that leaves some joints of the file out."""
    if not set(used) - set(left_out):
        return "none is left to compare"
    it = "it" if len(left_out) == 1 else "them"
    return f"leave {it} out with --map FILE, in YAML: joints: {_map_of(dict.fromkeys(left_out))}"


def listed(names: Sequence[str], most: int = 6) -> str:
    """Names for a message; only the first `most` of a long list."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
