"""What a URScript text has to have before the driver sends it: a way to be stopped, and a way to be recognised.

A program that runs goes on when every client is gone, and nobody can read it back. So each program stops the arm where
the heartbeat stops, writes its number into a register first, and waits until that number is allowed to move.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from drivers.errors import RefusedError
from drivers.transports.base.link import WATCHDOG
from drivers.transports.base.poses import rotation
from drivers.wire.ur_rtde import INERTIA

#: How a program that may be sent begins; `N` is a number that belongs to its text.
LINES = (
    "write_output_integer_register(25, N)",
    f'rtde_set_watchdog("input_int_register_24", {1 / WATCHDOG:g}, "stop")',
    "while read_input_integer_register(25) != N: sync() end",
    "write_output_integer_register(25, 0)",
)
#: The rows of these lines in order, and how often each may stand there.
_PREAMBLE = (
    (r"write_output_integer_register\(25, *(?P<number>[1-9]\d{0,9})\)", 1, 1),
    (r"write_output_integer_register\(24, *-1\)", 0, 1),
    (r'rtde_set_watchdog\("input_int_register_24", *(?P<hertz>\d+\.?\d*), *"stop"\)', 1, 1),
    (r"set_tcp\([^()]*\)", 0, 1),
    (r"set_(?:target_)?payload\([^()]*\)", 0, 1),
    (r"while read_input_integer_register\(25\) *!= *(?P<permit>[1-9]\d{0,9}):", 1, 1),
    (r"sync\(\)", 1, 1),
    (r"end", 1, 1),
    (r"write_output_integer_register\(25, *0\)", 1, 1),
)
#: What no later row holds: another watchdog, tool or payload, another answer to the driver, another meaning of the
#: words above.
_LATER = re.compile(
    r"(?i)rtde_set_watchdog|write_output_integer_register(?!\(\s*(?!0*25\b)\d+\s*,)"
    r"|\b(?:def|thread|sec)\s+(?:read_|write_|set_|sync\b)|\b(?:thread|sec)\b|\bset_(?:tcp|(?:target_)?payload)\b"
)
_OPENS = re.compile(r"(?:def|thread|sec|while|if)\b")
_ENDS = re.compile(r"\bend\b")
_NAME = re.compile(r"def ([A-Za-z]\w{0,30})\(\):", re.ASCII)
_COMMENT = re.compile(r"""("[^"]*")|#.*""")
_TOOL = re.compile(r"(?m)^set_tcp\(p\[([^\]]+)\]\)")
_LOAD = re.compile(r"(?m)^set_(?:target_)?payload\(([^,)\[]+)(?:, *\[([^\]]+)\])?")
#: Tool frames and loads this near are the same [m or rad, kg, m].
_SAME_TOOL, _SAME_MASS, _SAME_CENTRE = 1e-4, 0.005, 0.001


@dataclass(frozen=True, eq=False)
class UrProgram:
    """A program that may be sent: `name` on the controller, `number`, and the tool and load that it sets (or None).

    tool (6,): x, y, z [m] and rotation vector [rad]; load (4,): mass [kg] and its centre [m].
    """

    text: str
    name: str
    number: int
    tool: np.ndarray | None
    load: np.ndarray | None

    @classmethod
    def of(cls, text: str) -> UrProgram:
        """Of a text.

        Raises:
            RefusedError: no program, or one that could not be stopped or recognised.
        """
        rows = [_COMMENT.sub(lambda match: match[1] or "", row).rstrip() for row in text.split("\n")]
        code = [row for row in rows if row] or [""]
        head, body = _NAME.fullmatch(code[0]), [row.strip() for row in code[1:-1]]
        indented = all(row[0] in " \t" for row in code[1:-1])
        if not _readable(text, "".join(code)) or head is None or code[-1] != "end" or not indented:
            raise RefusedError(
                "this is no URScript program: `def NAME():` comes first, the name of at most 31 letters, digits and _, "
                "and `end` at the beginning of a line last; all between them is indented, and ASCII but for comments"
            )
        preamble, later = _preamble(body)
        if (
            not later
            or preamble["number"] != preamble["permit"]
            or int(preamble["number"]) >= 2**31
            or not 1 / WATCHDOG <= float(preamble["hertz"]) <= 4 / WATCHDOG
            or any(_LATER.search(row) for row in later)
            or not _closed(later)
        ):
            raise RefusedError(
                f"program {head[1]} would go on when this end is gone, or could be taken for another: it has to begin "
                f"with {'; '.join(LINES)}, and nothing later may change that"
            )
        tool, load = (pattern.search("\n".join(body)) for pattern in (_TOOL, _LOAD))
        try:
            frame = None if tool is None else _numbers(tool[1], 6)
            mass = None if load is None else _numbers(f"{load[1]},{load[2] or '0,0,0'}", 4)
        except ValueError:
            raise RefusedError(f"program {head[1]}: set_tcp and the payload need numbers, not expressions") from None
        return cls(text, head[1], int(preamble["number"]), frame, mass)

    def restoring(self, before: np.void) -> str:
        """A script that moves nothing and sets again what this program changes.

        `before` is a sample of RTDE with TCP and payload as they were; empty where the program sets neither.
        """
        lines = []
        if self.tool is not None:
            lines.append(f"set_tcp(p{_literal(before['tcp_offset'])})")
        if self.load is not None:
            known = INERTIA in (before.dtype.names or ())
            inertia = f", {_literal(before[INERTIA])}" if known else ""
            mass, centre = float(before["payload"]), _literal(before["payload_cog"])
            lines.append(f"set_target_payload({mass:.9g}, {centre}{inertia})")
        return "\n".join(["sec restore():", *(f"  {line}" for line in lines), "end", ""]) if lines else ""

    def differs(self, tool: np.ndarray, mass: float, centre: np.ndarray) -> str | None:
        """What the pendant has (tool (6,), mass [kg], centre (3,) [m]) where it is not what the program sets."""
        if self.tool is not None and not (
            np.abs(self.tool[:3] - tool[:3]).max() <= _SAME_TOOL
            and np.abs(rotation(self.tool[3:]) - rotation(tool[3:])).max() <= _SAME_TOOL
        ):
            return (
                f"the TCP at the pendant is {number_text(tool)}, the program is for {number_text(self.tool)} [m, rad]"
            )
        if self.load is None:
            return None
        same_centre = np.abs(self.load[1:] - centre).max() <= _SAME_CENTRE or max(mass, self.load[0]) <= _SAME_MASS
        if abs(self.load[0] - mass) <= _SAME_MASS and same_centre:
            return None
        return (
            f"the payload at the pendant is {payload_text(mass, centre)}, the program is for "
            f"{payload_text(self.load[0], self.load[1:])}"
        )


def _literal(values: np.ndarray) -> str:
    return f"[{', '.join(f'{float(value):.9g}' for value in values)}]"


def _preamble(body: list[str]) -> tuple[dict[str, str], list[str]]:
    """What the first rows of a program say, and the rows after them; none where they are not `LINES`."""
    preamble: dict[str, str] = {}
    for pattern, least, most in _PREAMBLE:
        count = 0
        while count < most and body and (match := re.fullmatch(pattern, body[0], re.ASCII)):
            preamble |= match.groupdict()
            body, count = body[1:], count + 1
        if count < least:
            return preamble, []
    return preamble, body


def _closed(rows: list[str]) -> bool:
    """Whether blocks begin and end in rows of their own, and none ends that of the program itself."""
    depth = 0
    for row in rows:
        if _OPENS.match(row):
            depth += 1
            if not row.endswith(":") or _ENDS.search(row):
                return False
        elif _ENDS.search(row):
            depth -= 1
            if row != "end" or depth < 0:
                return False
    return depth == 0


def _readable(text: str, code: str) -> bool:
    """Whether no character means something else to the controller than here."""
    return code.replace("\t", " ").isascii() and all(char.isprintable() or char in "\t\n" for char in text)


def _numbers(text: str, count: int) -> np.ndarray:
    values = np.array([float(part) for part in text.split(",")])
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(text)
    return values


def payload_text(mass: float, centre: np.ndarray) -> str:
    """A mass [kg] and its centre (3,) [m]."""
    return f"{mass:.3f} kg at {number_text(centre)} [m]"


def number_text(values: np.ndarray) -> str:
    """A few numbers in brackets."""
    return f"[{', '.join(f'{value:.4g}' for value in values + 0.0)}]"
