"""Dialects and interpolators by name: the built-in ones, and interpolators that others install as entry points.

Each is loaded when it is asked for: names are needed wherever a recipe is read, and the compiled loops of an
interpolator take half a second to load.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import InputError
from agent.motion.dialect import Dialect
from agent.motion.interpolator import Interpolator
from agent.motion.learned_law import is_file_name, load_law
from agent.robot import RobotDescription

if TYPE_CHECKING:
    from agent.robot import Tool

#: Third parties add interpolators under this entry-point group.
ENTRY_POINTS = "calibration_agent.interpolators"

# Registered in code as well: a checkout that was never installed has no entry points.
_INTERPOLATORS = {
    "fly": "agent.motion.fly.interpolator:FlyInterpolator",
    "orl": "agent.motion.orl:OrlInterpolator",
    "ur": "agent.motion.urscript.interpolator:UrLaw",
    "joint_trajectory": "agent.motion.joint_trajectory.interpolator:JointTrajectoryLaw",
}
_DIALECTS = {
    "pdl2": "agent.motion.pdl2.dialect:Pdl2",
    "urscript": "agent.motion.urscript.dialect:UrScript",
    "joint_trajectory": "agent.motion.joint_trajectory.dialect:JointTrajectoryDialect",
}


def create_dialect(name: str) -> Dialect:
    """A dialect by its name.

    Raises:
        InputError: no dialect has that name.
    """
    if name not in _DIALECTS:
        raise InputError(f"program language {name!r} is not known; there are: {', '.join(_DIALECTS)}")
    return _loaded(_DIALECTS[name])()


def dialect_of(program: Path) -> Dialect | None:
    """The dialect of a program file, by its suffix; None where it is none."""
    return next((dialect for dialect in dialects() if dialect.suffix == program.suffix.lower()), None)


def dialects() -> tuple[Dialect, ...]:
    """All registered dialects."""
    return tuple(map(create_dialect, _DIALECTS))


def interpolator_names(dialect: Dialect | None = None) -> tuple[str, ...]:
    """Names that `create_interpolator` knows: those of installed packages, and the built-in ones; with `dialect` only
    the built-in ones of its controllers."""
    installed = {entry.name for entry in entry_points(group=ENTRY_POINTS)} - {*_INTERPOLATORS}
    return tuple(sorted(installed.union(_INTERPOLATORS if dialect is None else dialect.interpolators)))


def create_interpolator(name: str, robot: RobotDescription, tool: Tool | None = None, **options: Any) -> Interpolator:
    """An interpolator by its registered name, or by the file of a learned law (`agent.motion.learned_law`).

    Args:
        name: registered name, or file of a learned law.
        robot: whose limits the plan keeps.
        tool: mounted at the flange.
        options: of that interpolator.

    Raises:
        InputError: no interpolator has that name, or the file is none for this robot.
    """
    if is_file_name(name):
        options["parameters"] = load_law(Path(name), robot).parameters
        name = "fly"
    if name in _INTERPOLATORS:
        return _loaded(_INTERPOLATORS[name])(robot, tool, **options)
    entry_point = next((entry for entry in entry_points(group=ENTRY_POINTS) if entry.name == name), None)
    if entry_point is None:
        raise InputError(f"interpolator {name!r} is not known; there are: {', '.join(interpolator_names())}")
    return entry_point.load()(robot, tool, **options)


def _loaded(reference: str) -> Any:
    module, _, attribute = reference.partition(":")
    return getattr(import_module(module), attribute)
