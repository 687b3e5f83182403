"""A recipe to start from: asked on a terminal or given as options, with the schema that editors check it with."""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path

from agent.core import Dimension, InputError, counted, parse_quantity, write_atomically
from agent.excitation import working_box
from agent.recipe import BARE_ANGLE, BARE_LEAN, BARE_PLACE, BARE_REACH, USUAL, load_recipe, recipe_schema, template
from agent.robot import builtin_robots, load_robot
from agent.runs import check_output
from agent.simulators import load_arm
from drivers.errors import DriverError
from drivers.protocol import DescribesRobot
from drivers.registry import available, create

#: Next to the recipe; editors with a YAML language server read it.
SCHEMA = "recipe.schema.json"
#: By option: the question on a terminal.
_QUESTIONS = {
    "robot": "robot: built-in name, or path of a robot.yaml",
    "driver": "driver of the controller link",
    "controller": "address of the controller",
    "centre": "centre of the sub-region, base frame: x, y, z",
    "size": "size of the sub-region: x, y, z",
    "orientation": "tool orientation: Euler ZYZ a, e, r",
    "cone": "how far the tool may lean from it",
}
#: By option: how many quantities, their dimension, and how a number without a unit is taken.
_QUANTITIES = {
    "centre": (3, Dimension.LENGTH, BARE_PLACE),
    "size": (3, Dimension.LENGTH, BARE_REACH),
    "orientation": (3, Dimension.ANGLE, BARE_ANGLE),
    "cone": (1, Dimension.ANGLE, BARE_LEAN),
}


def write_recipe(path: Path, options: dict[str, str | None]) -> Path:
    """Write a commented recipe and the schema next to it; asks on a terminal for what `options` leave out.

    Where no robot is given and the controller describes its own, that description is written next to the recipe too.

    Raises:
        InputError: a file exists, its folder does not, or a given value is wrong.
        DriverError: the controller that should describe its robot does not answer.
    """
    if path.exists():
        raise InputError(f"{path}: exists already; name another file, or move it away")
    check_output(path, ())
    on_terminal = sys.stdin.isatty() and sys.stderr.isatty()
    for name in _QUESTIONS:
        if (value := options.get(name)) is not None:
            try:
                _check(name, value)
            except InputError as error:
                raise InputError(f"--{name} {value}: {error}") from None
    options = options | {"robot": options.get("robot") or _robot_there(path.parent, options)}
    answers: dict[str, str] = {}
    box: dict[str, str] | None = None
    for name, words in _QUESTIONS.items():
        value, default = options.get(name), USUAL["address" if name == "controller" else name]
        if name in _QUANTITIES:
            box = _box_of(answers["robot"]) if box is None else box
            default = box.get(name, default)
        answers[name] = value or (_ask(name, words, default) if on_terminal else default)
    robot, address = answers["robot"], answers.pop("controller")
    answers |= {name: ", ".join(_parts(answers[name])) for name in ("centre", "size", "orientation")}
    answers["robot"] = robot if robot in builtin_robots() else os.path.relpath(robot, path.parent)
    text = template(address=address, **answers)
    write_atomically(path, f"# yaml-language-server: $schema={SCHEMA}\n{text}")
    try:
        load_recipe(path)
    except InputError:
        path.unlink()
        raise
    write_atomically(path.parent / SCHEMA, schema_text())
    return path


def _robot_there(folder: Path, options: dict[str, str | None]) -> str | None:
    """The description of the robot that the given controller drives, written to the folder as it says; None where it
    is not given, or drives no robot that it could describe."""
    name, address = options.get("driver"), options.get("controller")
    if name is None or address is None or name not in available():
        return None
    driver = create(name, address)
    if not isinstance(driver, DescribesRobot):
        return None
    try:
        driver.connect()
        identity, text = driver.identify(), driver.description()
    except DriverError as error:
        raise type(error)(
            f"{error}. To write the recipe without the controller, name your robot with --robot"
        ) from None
    finally:
        driver.close()
    stem = re.sub(r"[^A-Za-z0-9]+", "_", identity.robot).strip("_") or "arm"
    urdf, described = folder / f"{stem}.urdf", folder / f"{stem}.yaml"
    for path in (urdf, described):
        if path.exists():
            raise InputError(f"{path}: exists already, and {address} describes its robot; name yours with --robot")
    write_atomically(urdf, text)
    try:
        arm = load_arm(urdf, identity.joint_names)
        if arm.joint_names != identity.joint_names:
            joints = f"{', '.join(identity.joint_names)}; its URDF has {', '.join(arm.joint_names)} from base to tip"
            raise InputError(f"{address} has the joints {joints}: write a robot.yaml for it (docs/how-to-robot.md)")
    except InputError:
        urdf.unlink()
        raise
    joints = "".join(
        f"  - {{name: {json.dumps(joint.name)}, max_velocity: {joint.max_velocity:g}, "
        f"max_acceleration: {joint.max_velocity:g}}}\n"
        for joint in arm.joints
    )
    write_atomically(
        described,
        f"""# As {address} describes it. Speeds [rad/s] are those of the URDF; accelerations [rad/s\u00b2]
# reach them in a second. The controller checks neither: replace them by those that you allow.
name: {json.dumps(identity.robot)}
urdf: {urdf.name}
tip_frame: {json.dumps(arm.tip_frame)}
joints:
{joints}""",
    )
    print(f"{described}: the robot as {address} describes it; check its speeds and accelerations", file=sys.stderr)
    return str(described)


def schema_text() -> str:
    """JSON schema of a recipe, as a file."""
    return json.dumps(recipe_schema(), indent=2) + "\n"


def _check(name: str, text: str) -> None:
    """
    Raises:
        InputError: the value cannot be used for this option.
    """
    if name == "robot":
        load_robot(text)
    elif name == "driver" and text not in available():
        raise InputError(f"there is no driver {text!r}; there are {', '.join(available())}")
    elif name == "controller" and not text.strip():
        raise InputError("an address is expected, host:port for tcp")
    elif name in _QUANTITIES:
        count, dimension, bare = _QUANTITIES[name]
        parts = _parts(text) if count == 3 else (text,)
        if len(parts) != count:
            raise InputError(f"three quantities with commas between are expected, not {len(parts)}")
        for part in parts:
            parse_quantity(part, dimension, bare)


def _box_of(robot: str) -> dict[str, str]:
    """A sub-region that the arm reaches, by option; empty for the usual robot, and where none is found."""
    if robot == USUAL["robot"]:
        return {}
    arm = load_robot(robot)
    box = working_box(arm)
    if box is None:
        what = "change motion.via_points to where your arm works"
        if arm.dof < 6:
            what = (
                f"{counted(arm.dof, 'joint')} cannot turn the tool every way. Give motion.via_points.points with "
                "ranges that it reaches, or record a motion of your own: `agent estimate` needs no recipe"
            )
        print(f"found no box that {robot} reaches completely: {what}", file=sys.stderr)
        return {}
    values = {"centre": box.centre, "size": box.size, "orientation": box.orientation, "cone": (box.cone,)}
    units = {Dimension.LENGTH: "m", Dimension.ANGLE: "deg"}
    return {
        name: ", ".join(f"{value:g} {units[_QUANTITIES[name][1]]}" for value in row) for name, row in values.items()
    }


def _ask(name: str, words: str, default: str) -> str:
    while True:
        print(f"{words} [{default}] ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            raise InputError("init: the questions were not answered to the end, so nothing was written")
        answer = line.strip() or default
        try:
            _check(name, answer)
        except InputError as error:
            print(f"  {error}", file=sys.stderr)
            continue
        return answer


def _parts(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))
