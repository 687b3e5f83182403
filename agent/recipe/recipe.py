"""The recipe as the stages see it: frozen, SI, with the robot it names."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import (
    Dimension,
    InputError,
    find_faults,
    line_of,
    parse_quantity,
    read_yaml,
    sha256_text,
    without_faults,
)
from agent.motion import (
    Dialect,
    MotionSettings,
    create_dialect,
    dialects,
    interpolator_names,
    is_file_name,
    load_law,
    pose_of,
)
from agent.recipe.quantities import BARE_ANGLE, BARE_PLACE
from agent.recipe.schema import (
    ControllerSection,
    EstimateSection,
    GateSection,
    RecalibrateSection,
    RecipeDocument,
    RecordSection,
    SearchSection,
    ToolSection,
    ValidateSection,
    ViaPointsSection,
)
from agent.robot import Box, RobotDescription, Tool, builtin_robots, load_robot
from drivers import registry
from drivers.errors import ConfigurationError
from drivers.texts import public_address

Location = tuple[str, ...]
#: Largest range of a joint with stops [rad]. The widest wrists turn 7.5 times to either side; a description in degrees
#: has a joint that goes to 63 or more.
_FARTHEST = 20 * np.pi


@dataclass(frozen=True)
class CellDescription:
    """Obstacles around the robot, and ranges of joints.

    `joint_ranges`: by joint name, (lower, upper) [rad, m], where a cable or the cell allows less than the joint itself.
    """

    keep_out: tuple[Box, ...]
    joint_ranges: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class LoopDescription:
    """The loop's FLY settings at the recipe's speed, and its sub-region, `like` a path from here."""

    settings: MotionSettings
    via_points: ViaPointsSection

    @property
    def speed(self) -> float:
        """Speed of the tool centre point [m/s]."""
        return self.settings.linear_speed

    def settings_at(self, speed: float) -> MotionSettings:
        """The same settings at another speed [m/s]."""
        return replace(self.settings, linear_speed=speed)


@dataclass(frozen=True, eq=False)
class Recipe:
    """One recipe file: its path, text and SHA-256 (hex), and its sections.

    `robot_source` is what `--robot` takes for the same robot: a built-in name, or a path from the working folder.
    """

    path: Path
    text: str = field(repr=False)
    sha256: str
    robot: RobotDescription
    robot_source: str
    tool: Tool | None
    controller: ControllerSection
    cell: CellDescription
    motion: LoopDescription
    search: SearchSection
    record: RecordSection
    estimate: EstimateSection
    validate: ValidateSection
    gate: GateSection
    recalibrate: RecalibrateSection

    @property
    def dialect(self) -> Dialect:
        """The program language of the controller, as its driver declares it."""
        return _dialect(self.controller)

    @property
    def interpolator(self) -> str:
        """Name or file of the interpolation law; where the recipe names none, the one of the controller's dialect."""
        return self.search.interpolator or self.dialect.interpolators[0]


def load_recipe(path: Path | str) -> Recipe:
    """Read a recipe file and the robot it names.

    Paths inside it are relative to the file.

    Raises:
        InputError: with every fault as ``file:line: key: what is wrong, what is allowed``, one a line.
    """
    recipe, faults = examine_recipe(path)
    if faults or recipe is None:
        raise InputError("\n".join(faults))
    return recipe


def examine_recipe(path: Path | str) -> tuple[Recipe | None, list[str]]:
    """A recipe and all its faults, one line each. Optional keys that are wrong have their defaults in it.

    The recipe is None where a required key is wrong.

    Raises:
        InputError: no such file, or not YAML.
    """
    path = Path(path)
    data = read_yaml(path)
    faults = find_faults(path, data, RecipeDocument)
    lines = list(faults.values())
    document = _document(path, data, faults)
    robot = None
    name = data.get("robot") if isinstance(data, dict) else None
    if isinstance(name, str) and name:
        try:
            robot = load_robot(name if name in builtin_robots() else path.parent / name)
        except InputError as error:
            lines.append(f"{path}:{line_of(data, ('robot',))}: robot: {error}")
        except (OSError, ValueError) as error:  # no path: too long, or with a null byte
            lines.append(f"{path}:{line_of(data, ('robot',))}: robot: no such file can be: {error}"[:300])
    if document is None or robot is None:
        return None, lines
    wrong = list(_contradictions(path, document, robot))
    lines += [f"{path}:{line_of(data, key)}: {'.'.join(key)}: {message}" for key, message in wrong]
    if any(key[:2] in (("robot",), ("motion", "via_points"), ("cell", "joint_ranges")) for key, _ in wrong):
        return None, lines
    return _recipe(path, document, robot), lines


def _dialect(controller: ControllerSection) -> Dialect:
    return create_dialect(registry.dialect(controller.driver))


def _document(path: Path, data: Any, faults: dict[tuple[Any, ...], str]) -> RecipeDocument | None:
    """The document without its faulty keys or the sections that hold them; None if that is no recipe."""
    while faults:
        data = without_faults(data, faults)
        before, faults = faults, find_faults(path, data, RecipeDocument)
        if faults.keys() == before.keys():  # documents cannot be compared: .nan differs from itself
            return None
    return RecipeDocument.model_validate(data)


def recipe_schema() -> dict[str, Any]:
    """JSON schema of a recipe, for editors."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **RecipeDocument.model_json_schema(by_alias=True),
        "title": "Calibration recipe",
    }


def _contradictions(path: Path, document: RecipeDocument, robot: RobotDescription) -> Iterator[tuple[Location, str]]:
    """Contradictions between values that are each valid."""
    for fault in _range_faults(robot, document.cell.joint_ranges):
        yield ("robot",), f"{document.robot}: {fault}"
    limits = robot.cartesian_limits
    speeds = {("motion", "speed"): document.motion.speed, ("validate", "speed"): document.validate_.speed}
    for key, speed in speeds.items():
        if limits is not None and speed > limits.linear_speed:
            yield key, f"{speed:g} m/s is above the linear speed limit of {robot.name}, {limits.linear_speed:g} m/s"
    rate, cutoff = document.record.rate, document.estimate.filter.cutoff
    if cutoff >= rate / 2:
        message = f"{cutoff:g} Hz is not below half of record.rate, {rate / 2:g} Hz: no such filter exists"
        yield ("estimate", "filter", "cutoff"), message
    yield from _controller_faults(document.controller)
    yield from _motion_contradictions(path, document, robot)
    for name in document.cell.joint_ranges:
        try:
            _joint_range(name, document, robot)
        except InputError as error:
            yield ("cell", "joint_ranges", name), str(error)
    like = document.motion.via_points.like
    if like is not None and not os.path.isfile(path.parent / like):
        programs = ", ".join(dialect.suffix for dialect in dialects())
        message = f"{path.parent / like}: no such file; a program ({programs}) or a log (.mcap)"
        yield ("motion", "via_points", "like"), message


def _motion_contradictions(
    path: Path, document: RecipeDocument, robot: RobotDescription
) -> Iterator[tuple[tuple[str, ...], str]]:
    """FLY settings and interpolators that the controller's program language does not have."""
    dialect, chosen = _dialect(document.controller), document.search.interpolator
    for key in sorted(document.motion.fly.model_fields_set - dialect.fly_keys):
        allowed = ", ".join(sorted(dialect.fly_keys))
        yield ("motion", "fly", key), f"not for driver {document.controller.driver}; allowed are {allowed}"
    learns = "fly" in dialect.interpolators  # a learned law is a form of it
    if chosen is not None and is_file_name(chosen) and learns:
        try:
            load_law(path.parent / chosen, robot)
        except InputError as error:
            yield ("search", "interpolator"), str(error)
    elif chosen is not None and chosen not in interpolator_names(dialect):
        message = f"there is no interpolator {chosen!r}"
        if not learns:
            message += f" for driver {document.controller.driver}"
        message += f"; allowed are {', '.join(interpolator_names(dialect))}"
        yield ("search", "interpolator"), message + (", or the .yaml file of a learned one" if learns else "")


def _controller_faults(controller: ControllerSection) -> Iterator[tuple[Location, str]]:
    if controller.driver not in registry.available():
        message = (
            f"there is no driver {public_address(controller.driver)!r}; allowed are {', '.join(registry.available())}"
        )
        yield ("controller", "driver"), message
        return
    try:
        registry.create(controller.driver, controller.address)  # opens nothing
    except ConfigurationError as error:
        yield ("controller", "address"), str(error)
    efforts = registry.efforts(controller.driver)
    if efforts and controller.effort not in efforts:
        message = f"{', '.join(efforts)} are allowed: say what this robot reports as effort"
        yield ("controller", *(("effort",) if controller.effort else ())), message
    elif controller.effort is not None and not efforts:
        yield ("controller", "effort"), f"not for driver {controller.driver}, which knows what it reports"


def _range_faults(robot: RobotDescription, narrowed: Collection[str]) -> Iterator[str]:
    """Joint ranges that are missing or look like degrees: no motion can be checked against them.

    Logs can be read without limits. `narrowed`: names of joints whose range is given elsewhere.
    """
    asked = [joint for joint in robot.joints if joint.name not in narrowed]
    elements = {e.get("name"): e for e in ElementTree.fromstring(robot.urdf).findall("joint")}
    for joint in asked:
        kind = elements[joint.name].get("type")
        missing = [end for end in ("lower", "upper") if np.isinf(getattr(joint, end))]
        if missing and kind != "continuous":
            yield (
                f"joint {joint.name!r} is {kind}, and its URDF gives it no {' and no '.join(missing)} limit, so that "
                "nothing would keep a motion from its stops: put <limit lower=... upper=...> into the URDF "
                f"({'m' if joint.prismatic else 'rad'}) or a range into cell.joint_ranges"
                f"{'' if joint.prismatic else '; a joint that turns without end is continuous'}"
            )
    far = [joint for joint in asked if not joint.prismatic and _FARTHEST < max(-joint.lower, joint.upper) < np.inf]
    if far:
        yield (
            f"joint {far[0].name!r}{f' and {len(far) - 1} more' if far[1:] else ''}: a range of {far[0].lower:g} to "
            f"{far[0].upper:g} rad, more than ten turns from zero, looks like degrees; a URDF has radians. Where it is "
            "meant so, say in cell.joint_ranges how far the joint may go, or make it continuous"
        )


def _recipe(path: Path, document: RecipeDocument, robot: RobotDescription) -> Recipe:
    text = path.read_text(encoding="utf-8")
    settings = _dialect(document.controller).settings(document.motion.fly.model_dump(), document.motion.speed, robot)
    via_points, search = document.motion.via_points, document.search
    if via_points.like is not None:
        via_points = via_points.model_copy(update={"like": str(path.parent / via_points.like)})
    if search.interpolator is not None and is_file_name(search.interpolator):
        search = search.model_copy(update={"interpolator": str(path.parent / search.interpolator)})
    written = {field.alias or name: getattr(document, name) for name, field in RecipeDocument.model_fields.items()}
    resolved = {
        "path": path,
        "text": text,
        "sha256": sha256_text(text),
        "robot": robot,
        "robot_source": document.robot if document.robot in builtin_robots() else str(path.parent / document.robot),
        "tool": None if document.tool is None else _tool(document.tool),
        "cell": CellDescription(
            tuple(Box(entry.name, entry.box.min, entry.box.max) for entry in document.cell.keep_out),
            {name: _joint_range(name, document, robot) for name in document.cell.joint_ranges},
        ),
        "motion": LoopDescription(settings, via_points),
        "search": search,
    }
    return Recipe(**written | resolved)


def _joint_range(name: str, document: RecipeDocument, robot: RobotDescription) -> tuple[float, float]:
    if name not in robot.joint_names:
        raise InputError(f"{robot.name} has no such joint; allowed are {', '.join(robot.joint_names)}")
    joint = robot.joints[robot.joint_names.index(name)]
    dimension, bare = (Dimension.LENGTH, BARE_PLACE) if joint.prismatic else (Dimension.ANGLE, BARE_ANGLE)
    lower, upper = (parse_quantity(value, dimension, bare) for value in document.cell.joint_ranges[name])
    unit = joint.position_unit
    if lower >= upper:
        raise InputError(f"the lower end must come first and be below the upper; it is {lower:g} to {upper:g} {unit}")
    if lower >= joint.upper or upper <= joint.lower:
        raise InputError(
            f"{lower:g} to {upper:g} {unit} is outside the joint's own range, {joint.lower:g} to {joint.upper:g} {unit}"
        )
    return lower, upper


def _tool(section: ToolSection) -> Tool:
    frame = pose_of(section.frame)
    # The recipe's centre of mass is in the flange's frame, as on a controller's panel; `Tool` has it in the TCP's.
    flange = np.zeros(3) if section.centre_of_mass is None else np.array(section.centre_of_mass)
    return Tool(frame=frame, mass=section.mass, centre_of_mass=frame[:3, :3].T @ (flange - frame[:3, 3]))
