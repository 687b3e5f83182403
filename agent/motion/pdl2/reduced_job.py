"""Programs as people have them: what moves is kept, what does not move is passed over and counted.

A recipe's `like` asks where a job goes, not when or under which condition. So the statements of a program beyond the
motion subset are taken in the order of the text, each branch and each loop of unknown length once. Lines keep their
numbers, so a move that is not understood is reported with its line.

The initial values of variables are in a file of their own (`.var`), whose listing as text is an `.lsv`. An entry is
`name POS Priv X:… Y:… Z:… A:… E:… R:… CNFG: 'flags'`, `name JNTP Arm: 1 Ax: 6 Priv 1:… 2:… …`,
`name XTND Arm: 1 Ax: 1 Priv X:… … R:… 7:… CNFG: 'flags'`, or `name INT Priv 3`, on one line or on several. Public
post-processors and editors write them so; no listing by a controller was available.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from itertools import zip_longest
from typing import TYPE_CHECKING, NamedTuple

from agent.motion.pdl2.reader import parse_program
from agent.motion.pdl2.syntax import OUTSIDE_SUBSET, Pdl2Error, TextPosition
from agent.motion.pdl2.variables import FRAMES

if TYPE_CHECKING:
    from agent.robot import RobotDescription

_MOVES = re.compile(r"\b(?:SYNC)?MOVE(?:FLY)?\b", re.IGNORECASE)
_MOVE = re.compile(r"MOVE(?:FLY)?\b", re.IGNORECASE)
_ON_THE_WAY = re.compile(
    r"(?:\bWITH\s+|(?<=,)\s*)(?:CONDITION|EVENT)\s*\[[^\]]*\](?:\s*,\s*(?:CONDITION|EVENT)\s*\[[^\]]*\])*"
    r"|\bTIL\b(?:(?!\b(?:WITH|ENDMOVE|VIA|ADVANCE)\b)[^,])*",
    re.IGNORECASE,
)
_SETTING = re.compile(
    r"(?:(?P<with>\bWITH\s+)|,\s*|^[ \t]*)(?P<name>\$[\w.\[\]]+)\s*:?=\s*"
    r"(?:(?!\b(?:WITH|ENDMOVE|VIA|ADVANCE)\b)[^,\n;])+(?:(?=(?P<more>,\s*)\$))?",
    re.IGNORECASE | re.MULTILINE,
)
_OF_A_MOVE = re.compile(r"(?:WITH|ADVANCE|VIA|ENDMOVE)\b|,|\$\w+\s*=", re.IGNORECASE)
_ARM = re.compile(r"(?<=MOVE |EFLY )\s*ARM\s*\[\s*(\w+)\s*\]", re.IGNORECASE)
_STRING = re.compile(r"""'(?:[^']|'')*'|"[^"]*\"""")
_HEADER = re.compile(r"PROGRAM\s+(\w+)", re.IGNORECASE)
_SECTION = re.compile(r"(VAR|CONST|TYPE)\b\s*", re.IGNORECASE)
_VARIABLE = re.compile(
    r"([\w\s,]+):\s*((?:ARRAY\s*\[\s*\d+\s*\]\s*OF\s+)?(INTEGER|REAL|BOOLEAN|POSITION|POS|JOINTPOS|XTNDPOS)"
    r"(?:\s+FOR\s+ARM\s*\[\s*1\s*\])?)(\s*\([^()]*(?:\([^()]*\)[^()]*)*\))?",
    re.IGNORECASE,
)
_CONSTANT = re.compile(r"(\w+)\s*=\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?|TRUE|FALSE|ON|OFF)$", re.IGNORECASE)
_ROUTINE = re.compile(r"ROUTINE\s+(\w+)", re.IGNORECASE)
#: Statements other than moves that may be kept.
_KEPT = re.compile(r"(?:FOR|ENDFOR|END)\b|\$[\w.\[\]]+\s*:=|\w+\s*(?:\[[^\]]*\]\s*)?:=", re.IGNORECASE)
#: Words that begin a statement and are not in `OUTSIDE_SUBSET`, and forms of statements that begin with another word.
_BEGIN = {"delay", "cycle", "with", "for", "endfor", "endopen", "end"}
_CALL = re.compile(r"[$\w.]+(?:\[[^\]]*\][.$\w]*)*\s*(?:\(.*|:=.*|:|)$")
_FIRST = re.compile(r"\$?\w+")

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


def job_text(
    text: str, path: str = "", robot: RobotDescription | None = None, listing: str = ""
) -> tuple[str, dict[str, int]]:
    """The text of a program if it is of the motion subset, else the lines of it that move the arm.

    `listing` is the text of its variable file (`Pdl2.companion`), with the initial values. Also returns how often each
    word that does not move was passed over.

    Raises:
        Pdl2Error: something moves that is not understood.
    """
    listed = _read_listing(listing)
    if not listed:  # with a listing, the text alone does not say what the variables hold at first
        with suppress(Pdl2Error):
            parse_program(text, path, robot)
            return text, {}
    try:
        sieve = _Sieve(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), listed)
    except Pdl2Error as error:
        raise error.within(path) from None
    while True:
        reduced = "\n".join(sieve.out)
        try:
            parse_program(reduced, path, robot)
        except Pdl2Error as error:
            if sieve.passes_over(error.position):
                continue
        return reduced, dict(sieve.passed)  # if something in it still is not understood, reading it says where


def _read_listing(text: str) -> dict[str, Listed]:
    """Data type and value of each listed variable, by its name in small letters.

    Left out: other data types, other arms, arrays, and entries that do not give all their numbers, so that a move to
    one of them is listed as a move to a position without a value.
    """
    entries = list(_ENTRY.finditer(text))
    listed = {}
    for entry, following in zip_longest(entries, entries[1:]):
        kind = entry[2]
        value = _listed_value(kind, text[entry.end() : following.start() if following else None])
        if value is not None:
            listed[entry[1].lower()] = Listed(_TYPES[kind], value)
    return listed


def _listed_value(kind: str, text: str) -> str | None:
    head = _HEAD.match(text)
    if kind not in _TYPES or head is None or head[1] not in (None, "1"):
        return None
    body = text[head.end() :]
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


class _Sieve:
    """`out`: the text with everything blank that certainly does not move; `passed`: how often each word began a line
    that was passed over.

    Variables start with the values of the listing. An XTNDPOS is its pose: auxiliary axes are passed over and counted.

    Raises:
        Pdl2Error: something moves that the motion subset has no statement for, with its line.
    """

    def __init__(self, lines: list[str], listed: Mapping[str, Listed]) -> None:
        self._lines = lines
        self._listed = listed
        self._bare = [_without_comment(line) for line in lines]
        self.out = [""] * len(lines)
        self.passed: Counter[str] = Counter()
        self._constants: dict[str, str] = {}
        self._moving_routines: dict[str, int] = {}
        at = self._declarations(self.out)
        while at < len(lines):
            at = self._statement(at, self.out) + 1

    def passes_over(self, position: TextPosition) -> bool:
        """Blank the setting or the line at an error's position, if that changes no move's target.

        Controllers take values that the motion subset refuses, such as a `$FLY_DIST` below zero for none; and names of
        other programs hold nothing known here.
        """
        at = position.line - 1
        line = self.out[at] if 0 <= at < len(self.out) else ""
        setting = next(
            (match for match in _SETTING.finditer(line) if match.start() <= position.column - 1 < match.end()), None
        )
        first = _FIRST.match(line.strip())
        if setting is not None:
            name = setting["name"].upper().replace("$ARM_DATA[1].", "$")
            unknown = position.word.isidentifier() and position.word.upper() != "POS"
            if name in FRAMES.values() and not unknown:
                return False
            end = setting.end("more") if setting["with"] and setting["more"] else setting.end()
            keep = "WITH" if end > setting.end() else ""
            self.out[at] = (line[: setting.start()] + keep.ljust(end - setting.start()) + line[end:]).rstrip()
            self._pass(name.split("[")[0])
            return True
        if first is None or not _KEPT.match(line.strip()) or first[0].upper() == "END":
            return False
        self._blank(at)
        if first[0].upper() == "FOR":
            depth = 1
            while depth and at + 1 < len(self.out):
                at += 1
                word = _FIRST.match(self.out[at].strip())
                depth += {"FOR": 1, "ENDFOR": -1}.get(word[0].upper() if word else "", 0)
            self._blank(at)
        return True

    def _blank(self, at: int) -> None:
        first = _FIRST.match(self.out[at].strip())
        self.out[at] = self._pass(first[0].upper() if first else self.out[at])

    def _declarations(self, out: list[str]) -> int:
        """Header, declarations and routines; returns the line after the program's BEGIN."""
        section, at = "", 0
        while at < len(self._bare):
            bare = self._bare[at].strip()
            header, routine, opened = _HEADER.match(bare), _ROUTINE.match(bare), _SECTION.match(bare)
            if header:
                out[at] = f"PROGRAM {header[1]}"
            elif routine:
                at = self._routine(at, routine[1])
                section = ""
            elif re.match(r"BEGIN\b", bare, re.IGNORECASE):
                out[at] = "BEGIN"
                return at + 1
            elif bare:
                if opened:
                    section, bare = opened[1].upper(), bare[opened.end() :].strip()
                if bare:
                    out[at] = self._declared(section, bare)
            at += 1
        return at

    def _declared(self, section: str, bare: str) -> str:
        variable, constant = _VARIABLE.match(bare), _CONSTANT.match(bare)
        if section == "VAR" and variable:
            return "VAR " + "; ".join(self._variable(name.strip(), variable) for name in variable[1].split(","))
        if section == "CONST" and constant:
            self._constants[constant[1].lower()] = constant[2]
            return f"CONST {bare}"
        return self._pass(section or bare)

    def _variable(self, name: str, declared: re.Match[str]) -> str:
        """One variable of a declaration with its data type and its value at first."""
        data_type, named = declared[2], declared[3].upper()
        named = "POSITION" if named == "POS" else named
        if named == "XTNDPOS":
            self.passed["auxiliary axes"] += 1
            data_type = re.sub("XTNDPOS", "POSITION", data_type, flags=re.IGNORECASE)
        known = self._listed.get(name.lower())
        value = f" ({known.value})" if known is not None and known.type == named else declared[4] or ""
        return f"{name}: {data_type}{value}"

    def _routine(self, at: int, name: str) -> int:
        """Its last line; a routine of another program has no lines here."""
        self._pass("ROUTINE")
        if re.search(r"\bEXPORTED\s+FROM\b", self._bare[at], re.IGNORECASE):
            return at
        end = re.compile(rf"END\s+{name}\b", re.IGNORECASE)
        for last in range(at + 1, len(self._bare)):
            bare = self._bare[last].strip()
            if _MOVES.search(_STRING.sub("", bare)):
                self._moving_routines.setdefault(name.lower(), last)
            if end.match(bare):
                return last
        raise Pdl2Error("the routine does not end", TextPosition(at + 1, 1, name))

    def _statement(self, at: int, out: list[str]) -> int:
        """Keeps or passes over the statement of a line; returns its last line."""
        bare = self._bare[at].strip()
        if _MOVE.match(bare):
            return self._move(at, out)
        move = _MOVES.search(_STRING.sub("", self._bare[at]))
        if move:
            raise Pdl2Error("moves, but not in a statement of its own line", self._position_at(at, move[0]))
        word = _FIRST.match(bare)
        first = word[0].lower() if word else ""
        for name in re.findall(r"\w+", _STRING.sub("", bare)):
            if name.lower() in self._moving_routines:
                line = self._moving_routines[name.lower()] + 1
                reason = f"is a routine that moves, in line {line}: write its moves here instead"
                raise Pdl2Error(reason, self._position_at(at, name))
        if _KEPT.match(bare):
            out[at] = self._bare[at]
        elif bare:
            self._check_statement(at, first)
            self._pass(first.upper() or bare)
        return at

    def _check_statement(self, at: int, first: str) -> None:
        """A word that begins no statement may be a misspelt move, which is not to be passed over."""
        before = next((bare.rstrip() for bare in reversed(self._bare[:at]) if bare.strip()), "")
        continues = not first or before.endswith((",", "(", "&", "+", "-"))
        known = first in _BEGIN or OUTSIDE_SUBSET.fullmatch(first) is not None
        if not (continues or known or _CALL.match(_STRING.sub("", self._bare[at].strip()))):
            raise Pdl2Error("is not a statement known here", self._position_at(at, first))

    def _move(self, at: int, out: list[str]) -> int:
        start, line = at, self._bare[at]
        arm = _ARM.search(line)
        if arm:
            self._check_arm(at, arm[1])
            line = line[: arm.start()] + " " * (arm.end() - arm.start()) + line[arm.end() :]
        out[at] = line
        while at + 1 < len(self._bare):
            after = self._bare[at + 1].strip()
            open_ended = self._bare[at].rstrip().endswith((",", "&"))
            if after and not (open_ended or _OF_A_MOVE.match(after)):
                break
            out[at + 1] = self._bare[at + 1]
            at += 1
        out[start : at + 1] = map(self._without_conditions, out[start : at + 1])
        return at

    def _without_conditions(self, line: str) -> str:
        """A line of a move without the conditions that are enabled on the way, and those that end it: they move
        nothing, and where it is meant to go stays the same."""

        def blank(match: re.Match[str]) -> str:
            self.passed["TIL" if match[0].upper().startswith("TIL") else "WITH"] += 1
            return " " * len(match[0])

        return re.sub(r",(\s*),", r",\1 ", _ON_THE_WAY.sub(blank, line))

    def _check_arm(self, at: int, arm: str) -> None:
        """It is arm 1: by its number, a constant, or a variable that is never anything else."""
        values = {self._constants.get(arm.lower(), arm)}
        if values == {arm} and not arm.isdigit():
            pattern = re.compile(rf"\b{arm}\s*:=\s*(\w+)", re.IGNORECASE)
            values = {match[1] for bare in self._bare for match in pattern.finditer(bare)}
        if values != {"1"}:
            raise Pdl2Error("is another arm, or not known to be arm 1", self._position_at(at, arm))

    def _pass(self, word: str) -> str:
        self.passed[word.split()[0]] += 1
        return ""

    def _position_at(self, at: int, word: str) -> TextPosition:
        return TextPosition(at + 1, self._lines[at].lower().find(word.lower()) + 1, word)


def _without_comment(line: str) -> str:
    """The line without its comment; two dashes in a string begin none."""
    blind = _STRING.sub(lambda match: "x" * len(match[0]), line)
    at = blind.find("--")
    return line if at < 0 else line[:at].rstrip()
