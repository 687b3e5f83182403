"""What a verdict promises (CONTRACTS.md, 6), in one place: nothing leaves the procedure that breaks it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

CLOSES = 0.75  # of the gap, by all causes together, or it is not explained
HARDLY = 0.25  # of the gap: causes that close less are not named, whatever equals them
PART = 0.03  # of the gap: a cause that closes less has no size


def has_size(cause: Mapping[str, Any]) -> bool:
    """Whether a cause has parameters that are not all zero, and closes a part of its gap by itself."""
    closure = cause["closure"]
    return closure is not None and closure >= PART and any(value != 0 for value in cause["parameters"].values())


def settle(
    verdict: str, causes: Sequence[Mapping[str, Any]], closure: float | None
) -> tuple[str, list[Mapping[str, Any]]]:
    """The verdict that the figures allow, and the causes that may be named with it.

    - `explained` has causes, and they close three quarters of the gap;
    - `ambiguous` has causes that close a good part of it, and something that equals the first;
    - `unknown` and `no_gap` have none, and where there is nothing to close (None) there is no gap;
    - a cause without a size is none.
    """
    if verdict in ("no_gap", "unknown"):
        return verdict, []
    if closure is None:
        return "no_gap", []
    named = [cause for cause in causes if has_size(cause)]
    if not named or closure < HARDLY:
        return "unknown", []
    if named[0]["equivalent_to"]:
        return "ambiguous", named
    return ("explained", named) if verdict == "explained" and closure >= CLOSES else ("unknown", [])
