"""Interpolators by name: the built-in ones, and what others install under the entry point group below."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from agent.core import InputError
from agent.motion.dialect import Dialect, dialects
from agent.motion.interpolator import Interpolator
from agent.motion.learned import is_file_name, load_law
from agent.robot import RobotDescription

#: Third parties add interpolators under this entry-point group.
ENTRY_POINTS = "calibration_agent.interpolators"


def interpolator_names(dialect: Dialect | None = None) -> tuple[str, ...]:
    """Names that `create_interpolator` knows: the built-in ones, of one dialect's controllers if it is given, and those
    of installed packages."""
    own = {law for one in dialects() for law in one.interpolators}
    installed = {entry.name for entry in entry_points(group=ENTRY_POINTS)} - own
    return tuple(sorted({*(own if dialect is None else dialect.interpolators), *installed}))


def create_interpolator(name: str, robot: RobotDescription, tool: Any = None, **options: Any) -> Interpolator:
    """An interpolator by its registered name, or by the file of a learned law (`agent.motion.learned`).

    Raises:
        InputError: no interpolator has that name, or the file is none for this robot.
    """
    if is_file_name(name):
        options["parameters"] = load_law(Path(name), robot).parameters
        name = "fly"
    return _factory(name)(robot, tool, **options)


def _factory(name: str) -> Any:
    # Names are asked for wherever a recipe is read, and the compiled loops of one take half a second to load.
    if name == "fly":
        from agent.motion.fly.interpolator import FlyInterpolator

        return FlyInterpolator
    if name == "orl":
        from agent.motion.orl import OrlInterpolator

        return OrlInterpolator
    if name == "ur":
        from agent.motion.urscript.law import UrLaw

        return UrLaw
    found = next((entry for entry in entry_points(group=ENTRY_POINTS) if entry.name == name), None)
    if found is None:
        raise InputError(f"interpolator {name!r} is not known; there are: {', '.join(interpolator_names())}")
    return found.load()
