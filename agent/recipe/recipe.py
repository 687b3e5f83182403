"""The recipe as the stages see it: frozen, SI, with the robot it names."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Dimension, InputError, find_faults, line_of, parse_quantity, read_yaml, without_faults
from agent.motion import MotionSettings
from agent.recipe.quantities import BARE_ANGLE, BARE_PLACE
from agent.recipe.ranges import range_faults
from agent.recipe.schema import (
    ControllerSection,
    EstimateSection,
    GateSection,
    RecalibrateSection,
    RecipeDocument,
    RecordSection,
    SearchSection,
    ValidateSection,
    ViaPointsSection,
)
from agent.recipe.tool import tool_of
from agent.robot import Box, RobotDescription, builtin_robots, load_robot
from drivers.texts import place_of

if TYPE_CHECKING:
    from agent.motion import Dialect
    from agent.robot import Tool


@dataclass(frozen=True)
class CellDescription:
    """What stands around the robot, and how far each joint may go there.

    `joint_ranges`: by joint name, (lower, upper) [rad, m], where a cable or the cell allows less than the joint itself.
    """

    keep_out: tuple[Box, ...]
    joint_ranges: dict[str, tuple[float, float]]


@dataclass(frozen=True)
class MotionPlan:
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
    """One recipe file. `text` is what it said, `sha256` (hex) of that text, `path` where it was.

    `robot_source` is what `--robot` takes for the same robot: a built-in name, or a path from here. Sections that no
    stage needs in another form are as they were written.
    """

    path: Path
    text: str = field(repr=False)
    sha256: str
    robot: RobotDescription
    robot_source: str
    tool: Tool | None
    controller: ControllerSection
    cell: CellDescription
    motion: MotionPlan
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
    """A recipe and all its faults, as lines. Keys that are wrong and may be left out have their defaults in it.

    It is None where something is wrong that nothing can stand in for.

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
        except (OSError, ValueError) as error:  # a name that is no path: too long, or with a null byte
            lines.append(f"{path}:{line_of(data, ('robot',))}: robot: no such file can be: {error}"[:300])
    if document is None or robot is None:
        return None, lines
    wrong = list(_contradictions(path, document, robot))
    lines += [f"{path}:{line_of(data, key)}: {'.'.join(key)}: {message}" for key, message in wrong]
    if any(key[:2] in (("robot",), ("motion", "via_points"), ("cell", "joint_ranges")) for key, _ in wrong):
        return None, lines
    return _recipe(path, document, robot), lines


def _dialect(controller: ControllerSection) -> Dialect:
    from agent.motion import create_dialect
    from drivers import registry

    return create_dialect(registry.dialect(controller.driver))


def _document(path: Path, data: Any, faults: dict[tuple[Any, ...], str]) -> RecipeDocument | None:
    """The document without its faulty keys, or without what holds them, if it can be."""
    while faults:
        data = without_faults(data, faults)
        before, faults = faults, find_faults(path, data, RecipeDocument)
        if faults.keys() == before.keys():  # not by comparing documents: one that holds .nan never equals itself
            return None
    return RecipeDocument.model_validate(data)


def recipe_schema() -> dict[str, Any]:
    """JSON schema of a recipe, for editors."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **RecipeDocument.model_json_schema(by_alias=True),
        "title": "Calibration recipe",
    }


def _contradictions(
    path: Path, document: RecipeDocument, robot: RobotDescription
) -> Iterator[tuple[tuple[str, ...], str]]:
    """What is wrong between values that are each right by themselves."""
    from agent.motion import dialects
    from drivers.errors import ConfigurationError
    from drivers.registry import available, create

    for fault in range_faults(robot, document.cell.joint_ranges):
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
    if document.controller.driver not in available():
        message = f"there is no driver {place_of(document.controller.driver)!r}; allowed are {', '.join(available())}"
        yield ("controller", "driver"), message
    else:
        try:
            create(document.controller.driver, document.controller.address)  # opens nothing
        except ConfigurationError as error:
            yield ("controller", "address"), str(error)
    yield from _motion_contradictions(path, document, robot)
    for name in document.cell.joint_ranges:
        try:
            _joint_range(name, document, robot)
        except InputError as error:
            yield ("cell", "joint_ranges", name), str(error)
    like = document.motion.via_points.like
    if like is not None and not os.path.isfile(path.parent / like):
        programs = ", ".join(one.suffix for one in dialects())
        message = f"{path.parent / like}: no such file; a program ({programs}) or a log (.mcap)"
        yield (
            ("motion", "via_points", "like"),
            message,
        )


def _motion_contradictions(
    path: Path, document: RecipeDocument, robot: RobotDescription
) -> Iterator[tuple[tuple[str, ...], str]]:
    """FLY settings and interpolators that the controller's program language does not have."""
    from agent.motion import interpolator_names, is_file_name, load_law

    dialect, chosen = _dialect(document.controller), document.search.interpolator
    for key in sorted(document.motion.fly.model_fields_set - dialect.fly_keys):
        allowed = ", ".join(sorted(dialect.fly_keys))
        yield ("motion", "fly", key), f"not for driver {document.controller.driver}; allowed are {allowed}"
    learns = "fly" in dialect.interpolators  # what a learned law is a form of
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


def _recipe(path: Path, document: RecipeDocument, robot: RobotDescription) -> Recipe:
    from agent.motion import is_file_name

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
        "sha256": hashlib.sha256(text.encode("utf-8")).hexdigest(),
        "robot": robot,
        "robot_source": document.robot if document.robot in builtin_robots() else str(path.parent / document.robot),
        "tool": tool_of(document.tool),
        "cell": CellDescription(
            tuple(Box(entry.name, entry.box.min, entry.box.max) for entry in document.cell.keep_out),
            {name: _joint_range(name, document, robot) for name in document.cell.joint_ranges},
        ),
        "motion": MotionPlan(settings, via_points),
        "search": search,
    }
    return Recipe(**written | resolved)


def _joint_range(name: str, document: RecipeDocument, robot: RobotDescription) -> tuple[float, float]:
    if name not in robot.joint_names:
        raise InputError(f"{robot.name} has no such joint; allowed are {', '.join(robot.joint_names)}")
    joint = robot.joints[robot.joint_names.index(name)]
    dimension, bare = (Dimension.LENGTH, BARE_PLACE) if joint.prismatic else (Dimension.ANGLE, BARE_ANGLE)
    lower, upper = (parse_quantity(value, dimension, bare) for value in document.cell.joint_ranges[name])
    unit = "m" if joint.prismatic else "rad"
    if lower >= upper:
        raise InputError(f"the lower end must come first and be below the upper; it is {lower:g} to {upper:g} {unit}")
    if lower >= joint.upper or upper <= joint.lower:
        raise InputError(
            f"{lower:g} to {upper:g} {unit} is outside the joint's own range, {joint.lower:g} to {joint.upper:g} {unit}"
        )
    return lower, upper
