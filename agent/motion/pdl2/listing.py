"""The variable file beside a program, as text: a listing (`.lsv`) of what the controller keeps in a `.var`.

An entry is `name POS Priv X:… Y:… Z:… A:… E:… R:… CNFG: 'flags'`, `name JNTP Arm: 1 Ax: 6 Priv 1:… 2:… …`,
`name XTND Arm: 1 Ax: 1 Priv X:… … R:… 7:… CNFG: 'flags'`, or `name INT Priv 3`, on one line or on several. That is how
public post-processors and editors of such files write them; no listing by a controller was at hand.
"""

from __future__ import annotations

import re
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

_ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]+([A-Z]{3,4})\b", re.MULTILINE)
_HEAD = re.compile(r"\s*(?:Arm:\s*(\d+))?\s*(?:Ax:\s*(\d+))?\s*(?:Priv\b)?", re.IGNORECASE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?"
_COORDINATE = re.compile(rf"(\w+):\s*({_NUMBER})(?![\w.])", re.IGNORECASE)
_FLAGS = re.compile(r"CNFG:\s*('[^']*')", re.IGNORECASE)
_PLAIN = re.compile(rf"\s*({_NUMBER}|TRUE|FALSE|ON|OFF)\s*$", re.IGNORECASE)
_POSE = ("X", "Y", "Z", "A", "E", "R")
#: Data types of PDL2 by the word of the listing.
_TYPES = {"POS": "POSITION", "JNTP": "JOINTPOS", "XTND": "XTNDPOS", "INT": "INTEGER", "REA": "REAL", "BOO": "BOOLEAN"}


class Listed(NamedTuple):
    """The data type and the value of a variable, as PDL2 writes them; of an XTNDPOS the pose alone."""

    type: str
    value: str


def listing_beside(program: Path) -> Path | None:
    """The listing of the program's variables, where one stands beside it."""
    candidates = (program.with_suffix(suffix) for suffix in (".lsv", ".LSV"))
    return next((file for file in candidates if file.is_file()), None)


def read_listing(text: str) -> dict[str, Listed]:
    """What a listing says of each variable, by its name in small letters.

    Left out: other data types, other arms, arrays, and entries that do not give all their numbers, so that a move to
    one of them is listed as a move to a position without a value.
    """
    entries = list(_ENTRY.finditer(text))
    found = {}
    for entry, following in zip_longest(entries, entries[1:]):
        kind = entry[2]
        value = _value(kind, text[entry.end() : following.start() if following else None])
        if value is not None:
            found[entry[1].lower()] = Listed(_TYPES[kind], value)
    return found


def _value(kind: str, rest: str) -> str | None:
    head = _HEAD.match(rest)
    if kind not in _TYPES or head is None or head[1] not in (None, "1"):
        return None
    body = rest[head.end() :]
    if kind in ("INT", "REA", "BOO"):
        plain = _PLAIN.match(body)
        return plain[1] if plain else None
    flags = _FLAGS.search(body)
    numbers = _COORDINATE.findall(body[: flags.start()] if flags else body)
    if kind == "JNTP":
        complete = bool(numbers) and (head[2] is None or len(numbers) == int(head[2]))
        return "{" + ", ".join(value for _, value in numbers) + "}" if complete else None
    by_name = {name.upper(): value for name, value in numbers}
    if not all(name in by_name for name in _POSE):
        return None
    return f"POS({', '.join(by_name[name] for name in _POSE)}, {flags[1] if flags else chr(39) * 2})"
