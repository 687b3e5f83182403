"""Configuration flags and turns of a COMAU arm with a spherical wrist, as in the string of a POS.

`S E W T1:n T2:n T3:n`. A flag that is absent is off, a turn that is absent is 0. The meaning chosen here:

- `S` the wrist centre is behind the shoulder: the arm reaches back over axis 1 instead of forward;
- `E` the elbow is bent the other way: the forearm comes back from the upper arm against the sense in which it does with
  axis 3 at -90° (on the NS16, axis 3 beyond the stretched arm);
- `W` axis 5 is negative (on other arms: beyond the position with axes 4 and 6 in line);
- `T1`, `T2`, `T3` are round(q₄ / 360°), round(q₆ / 360°), round((q₃ + 180°) / 360°), halves upwards.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from agent.core import InputError

#: Joint (from 0) and offset [turns] of T1, T2, T3.
_TURNS = ((3, 0.0), (5, 0.0), (2, 0.5))
#: A joint this near [turns] below the border of a turn counts as on it: a pose's round-off must not add a turn.
_BORDER = 1e-9
_TURN = re.compile(r"T([123])\s*:\s*([+-]?\d{1,4})(?!\S)", re.IGNORECASE)


@dataclass(frozen=True)
class Configuration:
    """Flags `shoulder`, `elbow`, `wrist` and `turns` (T1, T2, T3)."""

    shoulder: bool = False
    elbow: bool = False
    wrist: bool = False
    turns: tuple[int, int, int] = (0, 0, 0)

    @classmethod
    def of(cls, branch: tuple[int, int, int], q: np.ndarray) -> Configuration:
        """From the signs of the branch (-1 sets the flag) and joint positions (6,) [rad]."""
        turns = tuple(int(np.floor(q[joint] / (2 * np.pi) + offset + 0.5 + _BORDER)) for joint, offset in _TURNS)
        return cls(branch[0] < 0, branch[1] < 0, branch[2] < 0, (turns[0], turns[1], turns[2]))

    @property
    def signs(self) -> tuple[int, int, int]:
        """Signs of the branch: -1 where the flag is set."""
        return (-1 if self.shoulder else 1, -1 if self.elbow else 1, -1 if self.wrist else 1)

    def turned(self, q: np.ndarray) -> np.ndarray:
        """(6,) joint positions with the full turns of joints 3, 4 and 6 that these turns ask for."""
        q = q.copy()
        for (joint, offset), wanted in zip(_TURNS, self.turns, strict=True):
            has = np.floor(q[joint] / (2 * np.pi) + offset + 0.5 + _BORDER)
            q[joint] += 2 * np.pi * (wanted - has)
        return q

    def __str__(self) -> str:
        flags = [name for name, on in (("S", self.shoulder), ("E", self.elbow), ("W", self.wrist)) if on]
        return " ".join(flags + [f"T{k + 1}:{count}" for k, count in enumerate(self.turns)])


def parse_configuration(text: str) -> Configuration:
    """Read a configuration string: any order, case and spacing.

    Raises:
        InputError: a word that is neither a flag nor a turn, or one that is given twice.
    """
    turns = [0, 0, 0]
    flags: list[str] = []
    for match in _TURN.finditer(text):
        turns[int(match[1]) - 1] = int(match[2])
        flags.append(f"T{match[1]}")
    flags += _TURN.sub(" ", text).upper().split()
    for word in flags:
        if word not in ("S", "E", "W", "T1", "T2", "T3") or flags.count(word) > 1:
            raise InputError(f"configuration {text!r}: {word!r}; allowed are S E W T1:n T2:n T3:n, each once")
    return Configuration("S" in flags, "E" in flags, "W" in flags, (turns[0], turns[1], turns[2]))
