"""The first run of a program on a machine: every stretch of it once, at no more than 250 mm/s.

That is the speed at which a person in the cell can still step aside, as ISO 10218-1 has it for manual operation.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import InputError, write_atomically
from agent.motion import Move, Statement, stop_to_stop, way_key
from agent.safety.planned_program import PlannedProgram
from agent.safety.preconditions import START_TOLERANCE, frames_text

if TYPE_CHECKING:
    from agent.motion import Dialect, Interpolator, Trajectory
    from agent.robot import RobotDescription

#: Highest speed of the tool centre point in a first run [m/s].
FIRST_SPEED = 0.25
_ATTEMPTS, _SLOWEST = 12, 0.01  # PDL2 takes whole percents of speed
#: Beside the runs.
FILE = "checked_programs.json"
_SCHEMA = "checked_programs/2"
#: What makes a motion another one: the machine, the text, and the frames that it leaves to the controller.
_KEY = ("serial", "program", "frames")


class CheckedPrograms:
    """Programs by their SHA-256 (hex), machines by their serial, or by their address if they tell none.

    The file `path` is read at each question, so that what another run adds counts."""

    def __init__(self, path: Path):
        self.path = path

    def has(self, serial: str, program: PlannedProgram) -> bool:
        """Whether it has run slowly on this machine from a stop of its plan before that first exceeds `FIRST_SPEED`.

        Raises:
            InputError: the file is damaged.
        """
        key = serial, program.checksum, frames_text(program.frames)
        places = self._entries().get(key, {"places": []})["places"]
        for chain in program.chains:
            if _among(places, chain.q[0]) or not np.max(chain.path_speed) <= FIRST_SPEED:
                return _among(places, chain.q[0])
        return bool(places)

    def add(self, serial: str, program: PlannedProgram) -> None:
        """Remember the program, or the one that it stands for, and where its motion began and ended.

        Raises:
            AgentError: the file cannot be written, or it is damaged.
        """
        entries = self._entries()
        key = serial, program.stands_for or program.checksum, frames_text(program.frames)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        new: dict[str, Any] = {**dict(zip(_KEY, key, strict=True)), "at": now, "places": []}
        places = entries.setdefault(key, new)["places"]
        ends = program.chains[0].q[0], program.chains[-1].q[-1]
        if not (unknown := [place.tolist() for place in ends if not _among(places, place)]):
            return  # whoever writes here at the same time may have something new
        places += unknown
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self.path, json.dumps({"schema": _SCHEMA, "programs": [*entries.values()]}, indent=2) + "\n")

    def _entries(self) -> dict[tuple[str, ...], dict[str, Any]]:
        try:
            data = json.loads(self.path.read_text(encoding="utf-8"))
            if data["schema"] == "checked_programs/1":  # of version 1.0.0, which does not say from where
                return {}
            if data["schema"] != _SCHEMA:
                raise ValueError(f"schema {data['schema']!r}")
            for entry in data["programs"]:
                entry["places"] = np.asarray(entry["places"], dtype=float).tolist()
            return {tuple(entry[key] for key in _KEY): entry for entry in data["programs"]}
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{self.path}: this list of checked programs is damaged ({error}); move it away, every program will "
                "then run slowly once more"
            ) from None


def _among(places: list[list[float]], position: np.ndarray) -> bool:
    return any(bool(np.all(np.abs(np.subtract(place, position)) <= START_TOLERANCE)) for place in places)


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
