"""Names of joints as recorders write them: `main_shoulder_pan`, `shoulder_pan.pos`, `left_waist`, `left/waist`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

#: What a column holds, by the end of its name; positions have none as often as `.pos`.
_QUANTITIES = {
    **dict.fromkeys(("pos", "position", "qpos", "q"), "position"),
    **dict.fromkeys(("vel", "velocity", "qvel", "dq"), "velocity"),
    **dict.fromkeys(("torque", "tau", "effort"), "effort"),
}
_ENDS = re.compile(rf"^(.*)[./]({'|'.join(_QUANTITIES)})$")
#: Beginnings of names that do not say which joint it is.
_ROLE = re.compile(r"^(?:main|follower|arm|observation\.state|state|action)[_./]+", re.IGNORECASE)
_SIDE = re.compile(r"^(left|right)(?:_?arm)?[_./]+", re.IGNORECASE)
#: Joints of one arm under the names of its makers' own files: SO-100 in MuJoCo Menagerie against LeRobot.
_ALSO = {
    "rotation": "shoulder_pan",
    "pitch": "shoulder_lift",
    "elbow": "elbow_flex",
    "wrist_pitch": "wrist_flex",
    "jaw": "gripper",
}
#: Number of a joint, at the end of its name.
_NUMBER = re.compile(r"(\d+)(?:_joint)?$")
#: Names of a column of which no servo takes a set-point: where a hand is, or how it turns.
_POSE = re.compile(
    r"^(?:(?:ee|eef|end_effector|tcp|delta|d|pos|rot|target)[_.]?)*(?:x|y|z|r|rx|ry|rz|roll|pitch|yaw|qx|qy|qz|qw)$",
    re.IGNORECASE,
)


def flat_names(names: Any) -> list[str]:
    """Names of columns from `info.json`: a list, a list in a list, a mapping of lists by what they name, or a mapping
    of names to their numbers; empty where it has none."""
    if isinstance(names, Mapping):
        lists = {key: flat_names(value) for key, value in names.items() if isinstance(value, (list, Mapping))}
        if lists:
            sides = all(_SIDE.match(f"{key}_") for key in lists)
            return [f"{key}_{name}" if sides else name for key, several in lists.items() for name in several]
        numbers = {name: value for name, value in names.items() if value is not None}
        numbered = all(isinstance(value, (int, float)) for value in numbers.values())
        names = sorted(numbers, key=numbers.__getitem__) if numbered else [*numbers]
    if isinstance(names, list):
        return [
            name
            for entry in names
            for name in (flat_names(entry) if isinstance(entry, (list, Mapping)) else [str(entry)])
        ]
    return []


def quantity_of(name: str) -> str:
    """`position`, `velocity` or `effort`, by the end of a column's name."""
    match = _ENDS.match(name.lower())
    return _QUANTITIES[match[2]] if match else "position"


def clean(name: str) -> str:
    """The joint's name without what says its role and quantity; the side stays."""
    match = _ENDS.match(name.lower())
    return _ROLE.sub("", name[: match.end(1)] if match else name)


def side_of(name: str) -> str:
    """`left`, `right` or nothing."""
    match = _SIDE.match(clean(name))
    return match[1].lower() if match else ""


def without_side(name: str) -> str:
    """The cleaned name of a joint of one arm of a pair."""
    return _SIDE.sub("", clean(name))


def poses(names: Sequence[str]) -> list[str]:
    """Those of the columns that are coordinates of a hand."""
    return [name for name in names if quantity_of(name) == "position" and _POSE.match(without_side(name))]


def same_joint(name: str, other: str) -> bool:
    """Whether two names mean one joint: but for role, side, namespace and case, or by its makers' two names."""
    return _key(name) == _key(other) and (not side_of(name) or not side_of(other) or side_of(name) == side_of(other))


def _key(name: str) -> str:
    plain = without_side(name.rsplit("/", 1)[-1]).lower().removesuffix("_joint").removeprefix("joint_")
    return _ALSO.get(plain, plain)


def joint_pairs(names: Sequence[str], others: Sequence[str]) -> dict[str, str]:
    """Name → other name of the same joint: the same text, else the only one on both sides that means it; none where
    one side counts its joints from 0 and the other from 1."""
    if counted_apart(names, others):
        return {}
    pairs = {name: name for name in names if name in others}
    unpaired = [name for name in names if name not in pairs]
    candidates = [other for other in others if other not in pairs]
    for name in unpaired:
        alike = [other for other in candidates if same_joint(name, other)]
        if len(alike) == 1 and sum(same_joint(each, alike[0]) for each in unpaired) == 1:
            pairs[name] = alike[0]
    return pairs


def counted_apart(names: Sequence[str], others: Sequence[str]) -> bool:
    """Whether joints are numbered from 0 on one side and from 1 on the other, so that equal numbers are no pairs."""
    first = (min((n for n in map(number_of, side) if n >= 0), default=-1) for side in (names, others))
    return {*first} == {0, 1}


def number_of(name: str) -> int:
    """The number at the end of a joint's name; -1 where it has none."""
    hit = _NUMBER.search(name)
    return int(hit[1]) if hit else -1


def columns_of(recorded: Sequence[str], wanted: Sequence[str]) -> list[int] | None:
    """The column of each wanted joint, by its name; None where one has none, or more than one."""
    pairs = joint_pairs(wanted, recorded)
    return [recorded.index(pairs[name]) for name in wanted] if len(pairs) == len(set(wanted)) else None
