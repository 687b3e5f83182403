"""Which joint a name is of: `q_pan`, `right_pan.tau` and `/drives/pan/torque` are columns of pan, `arm1_pan` is pan of
an arm."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from itertools import pairwise

_TOKEN = re.compile(r"[a-z]+|\d+")
#: Words of a joint's name that do not say which one it is.
_COMMON = {"joint", "axis", "link", "motor"}
#: Words that say which of several arms a column is of: these alone, others before a number.
_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_NUMBERED = {"arm", "robot"}


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


def contradiction(columns: Sequence[str], others: Sequence[str], quantity: str) -> str | None:
    """What speaks against columns being of the same joints, in the same order, as those of another quantity, if
    anything does."""
    arms, other_arms = _arms(columns), _arms(others)
    if arms and other_arms and not arms & other_arms:
        return f"are of {min(arms)}, those of {quantity} of {min(other_arms)}"
    own, other = _own_tokens(columns), _own_tokens(others)
    if own != other and sorted(own) == sorted(other):
        k = next(k for k, tokens in enumerate(own) if tokens != other[k])
        return f"are in another order than those of {quantity}: {columns[k]} stands where {others[k]} does"
    return None


def _arms(columns: Sequence[str]) -> set[str]:
    """Words of which arm all of the columns are."""
    of_each = []
    for tokens in map(_tokens, columns):
        sides = {_SIDES[token] for token in tokens if token in _SIDES}
        numbered = {word + number for word, number in pairwise(tokens) if word in _NUMBERED and number.isdigit()}
        of_each.append(sides | numbered)
    return set.intersection(*of_each)


def _own_tokens(columns: Sequence[str]) -> list[list[str]]:
    """Of each column, the tokens that not all of them have."""
    tokens = [_tokens(column) for column in columns]
    shared = set.intersection(*map(set, tokens))
    return [[token for token in each if token not in shared] for each in tokens]


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
