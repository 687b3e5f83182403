"""The first run of a program on a machine: every stretch of it once, at no more than 250 mm/s.

That is the speed at which a person in the cell can still step aside, as ISO 10218-1 has it for manual operation.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError, read_json, write_atomically
from agent.motion import Move, Statement, stop_to_stop, way_key
from agent.safety.planned_program import PlannedProgram

if TYPE_CHECKING:
    from agent.motion import Dialect, Interpolator, Trajectory
    from agent.robot import RobotDescription

#: Highest speed of the tool centre point in a first run [m/s].
FIRST_SPEED = 0.25
_ATTEMPTS, _SLOWEST = 12, 0.01  # PDL2 takes whole percents of speed
#: Beside the runs.
FILE = "checked_programs.json"
_SCHEMA = "checked_programs/1"


class CheckedPrograms:
    """Programs by their SHA-256 (hex), machines by their serial, or by their address if they tell none.

    Args:
        path: the file; read when it is asked, so that what another run adds counts.
    """

    def __init__(self, path: Path):
        self.path = path

    def has(self, serial: str, checksum: str) -> bool:
        """Whether the program has run slowly on this machine.

        Raises:
            InputError: the file is damaged.
        """
        return any(entry["serial"] == serial and entry["program"] == checksum for entry in self._entries())

    def add(self, serial: str, checksum: str) -> None:
        """Remember it.

        Raises:
            AgentError: the file cannot be written, or it is damaged.
        """
        if self.has(serial, checksum):
            return  # writing nothing cannot undo an entry that another run adds now
        now = datetime.now(UTC).isoformat(timespec="seconds")
        entries = [*self._entries(), {"serial": serial, "program": checksum, "at": now}]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path, json.dumps({"schema": _SCHEMA, "programs": entries}, indent=2) + "\n")

    def _entries(self) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        try:
            data = read_json(self.path)
            if data["schema"] != _SCHEMA:
                raise ValueError(f"schema {data['schema']!r}")
            return [{key: str(entry[key]) for key in ("serial", "program", "at")} for entry in data["programs"]]
        except (InputError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{self.path}: this list of checked programs is damaged ({error}); move it away, every program will "
                "then run slowly once more"
            ) from None


def slow_text(
    program: PlannedProgram, robot: RobotDescription, dialect: Dialect, interpolator: Interpolator, start: np.ndarray
) -> str:
    """Text of a program that makes every different stretch of a program, from stop to stop, slowly.

    Stretches that come again are left out where they lead back to where they begin. The way from its end to its first
    point is one: the program itself begins there next.

    Args:
        start: (n,) where the arm stands.

    Raises:
        InputError: it cannot be planned, or not so slowly.
    """
    statements: list[Statement] = []
    again: list[Move] = []  # stretches since the last of `statements` that are in there already
    ways: dict[tuple[bytes, tuple[object, ...]], tuple[list[Move], Trajectory]] = {}
    stand = start  # at the end of `statements`
    stretches = list(stop_to_stop(program.statements))
    back = [replace(stretches[0][0], fly=False)]
    for moves in [*stretches, back]:
        key = _place(start), way_key(moves)
        if new := key not in ways:
            ways[key] = _slowed(moves, interpolator, start, program.name)
        slow, trajectory = ways[key]
        if moves is back and not np.ptp(trajectory.q, axis=0).any():
            break
        if new:
            statements += slow if _place(start) == _place(stand) else [*again, *slow]
            again, stand = [], trajectory.q[-1]
        else:
            again += slow
        start = trajectory.q[-1]
    if _place(stand) != _place(start) and (_place(stand), way_key(back)) not in ways:
        statements += again
    return dialect.write(f"{program.name[:26]}_slow", statements, robot)


def _place(position: np.ndarray) -> bytes:
    return (np.round(position, 6) + 0.0).tobytes()


def _slowed(
    moves: list[Move], interpolator: Interpolator, start: np.ndarray, name: str
) -> tuple[list[Move], Trajectory]:
    for attempt in range(_ATTEMPTS):
        trajectory = interpolator.plan(tuple(moves), start)
        peak = float(np.max(trajectory.path_speed))
        if peak <= FIRST_SPEED:
            return moves, trajectory
        if not np.isfinite(peak):
            break
        # A short move does not reach its programmed speed, and hardly gets slower at first: of 150 random programs 20
        # are refused without the power of 0.9, and none with that of 0.95 to 0.8.
        moves = [_with_speed(move, 0.98 * 0.9**attempt * FIRST_SPEED / peak) for move in moves]
    raise InputError(
        f"program {name}: its first run cannot be planned at {FIRST_SPEED:g} m/s (it still reaches {peak:.2f} m/s); "
        "lower the speeds in the program"
    )


def _with_speed(move: Move, factor: float) -> Move:
    percent = math.floor(100 * move.settings.speed_override * factor + 1e-9) / 100
    return replace(move, settings=move.settings.changed(speed_override=max(_SLOWEST, percent)))
