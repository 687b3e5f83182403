"""Which joint a name is of: `q_pan`, `right_pan.tau` and `/drives/pan/torque` are columns of pan, `arm1_pan` is pan of
an arm."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

_TOKEN = re.compile(r"[a-z]+|\d+")
#: Words of a joint's name that do not say which one it is.
_COMMON = {"joint", "axis", "link", "motor"}


def _tokens(name: str) -> list[str]:
    return _TOKEN.findall(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())


def _common_part(column: list[str], joint: list[str]) -> int:
    """Tokens at the end of a joint's name that a column has in a row; 0 where they do not name a joint."""
    for size in range(len(joint), 0, -1):
        part = joint[-size:]
        if any(column[k : k + size] == part for k in range(len(column) - size + 1)):
            own = any(token.isalpha() and token not in _COMMON for token in part)
            return size if own or size > 1 else 0  # a number alone, or `joint` alone, names none
    return 0


def named_joints(columns: Sequence[str], joints: Sequence[str]) -> list[str] | None:
    """The joint of each column by its name; None where a column names none, or two columns the same."""
    named = []
    for column in map(_tokens, columns):
        sizes = []
        for joint in map(_tokens, joints):
            bare = [token for token in joint if token not in _COMMON]
            sizes.append(max(_common_part(column, joint), _common_part(column, bare) if bare else 0))
        best = max(sizes, default=0)
        if best == 0 or sizes.count(best) > 1:
            return None
        named.append(joints[sizes.index(best)])
    return named if len(set(named)) == len(named) else None


def prefixed(joints: Sequence[str], known: Collection[str]) -> dict[str, str]:
    """Joint → its name among known ones, where these have one and the same prefix more, or less; empty else."""
    prefixes = prefixes_of(joints, known)
    if len(prefixes) == 1:
        return {joint: prefixes[0] + joint for joint in joints}
    for size in range(1, min(map(len, joints), default=0)):
        bare = [joint[size:] for joint in joints]
        if all(joint.startswith(joints[0][:size]) for joint in joints) and set(bare) <= set(known):
            return dict(zip(joints, bare, strict=True))
    return {}


def prefixes_of(joints: Sequence[str], known: Collection[str]) -> list[str]:
    """What stands before all of the joints in known names, such as `left_` and `right_`."""
    prefixes = {name.removesuffix(joints[0]) for name in known if joints and name.endswith(joints[0])}
    return sorted(prefix for prefix in prefixes if all(prefix + joint in known for joint in joints))
