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

#: How a program that may be sent begins; `N` is a number that belongs to its text.
LINES = (
    "write_output_integer_register(25, N)",
    f'rtde_set_watchdog("input_int_register_24", {1 / WATCHDOG:g}, "stop")',
    "while read_input_integer_register(25) != N: sync() end",
    "write_output_integer_register(25, 0)",
)
_HEAD = re.compile(r"(?m)\A(?:#.*\n|\s*\n)*def ([A-Za-z]\w{0,30})\(\):[ \t]*$", re.ASCII)
_END = re.compile(r"(?m)^end[ \t]*$")
_NUMBER = re.compile(r"(?m)^[ \t]+write_output_integer_register\(25, *(\d{1,10})\)")
_PERMIT = r"(?s)read_input_integer_register\(25\) *!= *{}\b.*\n[ \t]+write_output_integer_register\(25, *0\)"
_WATCHDOG = re.compile(r'(?m)^[ \t]+rtde_set_watchdog\("input_int_register_24", *([\d.]+), *"stop"\)')
_TOOL = re.compile(r"(?m)^[ \t]+set_tcp\(p\[([^\]]+)\]\)")
_LOAD = re.compile(r"(?m)^[ \t]+set_(?:target_)?payload\(([^,)\[]+)(?:, *\[([^\]]+)\])?")
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
        head = _HEAD.match(text)
        if head is None or _END.search(text) is None:
            raise RefusedError(
                "this is no URScript program: `def NAME():` comes first, the name of at most 31 letters, digits and _, "
                "and `end` at the beginning of a line last"
            )
        number, watchdog = _NUMBER.search(text), _WATCHDOG.search(text)
        permit = None if number is None else re.search(_PERMIT.format(number[1]), text)
        if (
            number is None
            or watchdog is None
            or permit is None
            or not 1 / WATCHDOG <= float(watchdog[1]) <= 4 / WATCHDOG
        ):
            raise RefusedError(
                f"program {head[1]} would go on when this end is gone, or could be taken for another: it has to begin "
                f"with {'; '.join(LINES)}"
            )
        tool, load = _TOOL.search(text), _LOAD.search(text)
        try:
            frame = None if tool is None else _numbers(tool[1], 6)
            mass = None if load is None else _numbers(f"{load[1]},{load[2] or '0,0,0'}", 4)
        except ValueError:
            raise RefusedError(f"program {head[1]}: set_tcp and the payload need numbers, not expressions") from None
        return cls(text, head[1], int(number[1]), frame, mass)

    def differs(self, tool: np.ndarray, mass: float, centre: np.ndarray) -> str | None:
        """What the pendant has (tool (6,), mass [kg], centre (3,) [m]) where it is not what the program sets."""
        if self.tool is not None and not (
            np.abs(self.tool[:3] - tool[:3]).max() <= _SAME_TOOL
            and np.abs(rotation(self.tool[3:]) - rotation(tool[3:])).max() <= _SAME_TOOL
        ):
            return f"the TCP at the pendant is {_text(tool)}, the program is for {_text(self.tool)} [m, rad]"
        if self.load is None:
            return None
        near = np.abs(self.load[1:] - centre).max() <= _SAME_CENTRE or max(mass, self.load[0]) <= _SAME_MASS
        if abs(self.load[0] - mass) <= _SAME_MASS and near:
            return None
        return (
            f"the payload at the pendant is {mass:.3f} kg at {_text(centre)}, the program is for {self.load[0]:.3f} kg "
            f"at {_text(self.load[1:])} [m]"
        )


def _numbers(text: str, count: int) -> np.ndarray:
    values = np.array([float(part) for part in text.split(",")])
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(text)
    return values


def _text(values: np.ndarray) -> str:
    return f"[{', '.join(f'{value:.4g}' for value in values + 0.0)}]"
