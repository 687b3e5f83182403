"""A recipe to start from: what a person is asked, or says by flags, and the schema that editors check it with."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from agent.core import Bare, Dimension, InputError, counted, parse_quantity, write_atomically
from agent.pipeline.identify import check_output
from agent.recipe import BARE_ANGLE, BARE_LEAN, BARE_PLACE, BARE_REACH, load_recipe, recipe_schema, template
from agent.robot import builtin_robots, load_robot

#: Beside the recipe; editors with a YAML language server read it.
SCHEMA = "recipe.schema.json"
#: The robot whose sub-region the usual answers have, and the questions about the sub-region.
_USUAL = "comau_ns16"
_BOX = ("centre", "size", "orientation", "cone")


@dataclass(frozen=True)
class InitQuestion:
    """What is asked: the flag's name, the words, the answer without one, and what an answer must be."""

    name: str
    words: str
    default: str
    check: Callable[[str], None]


def write_recipe(path: Path, given: dict[str, str | None]) -> Path:
    """Write a commented recipe and the schema beside it; what was not given is asked on a terminal.

    Args:
        given: by the names of `questions`; None is what nobody said.

    Raises:
        InputError: the file exists, its folder does not, or something that was given cannot be.
    """
    if path.exists():
        raise InputError(f"{path}: exists already; name another file, or move it away")
    check_output(path, ())
    asked = sys.stdin.isatty() and sys.stderr.isatty()
    answers: dict[str, str] = {}
    for question in questions():
        value = given.get(question.name)
        if value is not None:
            _valid(question, value)
        if question.name in _BOX:
            question = replace(question, default=_box_of(answers["robot"]).get(question.name, question.default))
        answers[question.name] = value or (_ask(question) if asked else question.default)
    robot = answers["robot"]
    named = robot if robot in builtin_robots() else os.path.relpath(robot, path.parent)
    text = template(
        robot=named,
        address=answers["controller"],
        driver=answers["driver"],
        centre=_parts(answers["centre"]),
        size=_parts(answers["size"]),
        orientation=_parts(answers["orientation"]),
        cone=answers["cone"],
    )
    write_atomically(path, f"# yaml-language-server: $schema={SCHEMA}\n{text}")
    try:
        load_recipe(path)  # what was written can be read
    except InputError:
        path.unlink()
        raise
    write_atomically(path.parent / SCHEMA, schema_text())
    return path


def schema_text() -> str:
    """JSON schema of a recipe, as a file."""
    return json.dumps(recipe_schema(), indent=2) + "\n"


def questions() -> list[InitQuestion]:
    """In the order in which they are asked."""
    from drivers.registry import available

    def robot(text: str) -> None:
        load_robot(text)

    def driver(text: str) -> None:
        if text not in available():
            raise InputError(f"there is no driver {text!r}; there are {', '.join(available())}")

    def address(text: str) -> None:
        if not text.strip():
            raise InputError("an address is expected, host:port for tcp")

    places, sizes = _three(Dimension.LENGTH, BARE_PLACE), _three(Dimension.LENGTH, BARE_REACH)
    angles = _three(Dimension.ANGLE, BARE_ANGLE)

    def lean(text: str) -> None:
        _quantity(text, Dimension.ANGLE, BARE_LEAN)

    return [
        InitQuestion("robot", "robot: built-in name, or path of a robot.yaml", _USUAL, robot),
        InitQuestion("driver", "driver of the controller link", "tcp", driver),
        InitQuestion("controller", "address of the controller", "127.0.0.1:9100", address),
        InitQuestion("centre", "centre of the sub-region, base frame: x, y, z", "1.0 m, 0 m, 0.8 m", places),
        InitQuestion("size", "size of the sub-region: x, y, z", "500 mm, 600 mm, 400 mm", sizes),
        InitQuestion("orientation", "tool orientation: Euler ZYZ a, e, r", "0 deg, 180 deg, 0 deg", angles),
        InitQuestion("cone", "how far the tool may lean from it", "30 deg", lean),
    ]


@cache
def _box_of(robot: str) -> dict[str, str]:
    """A sub-region that the arm reaches, as answers; none for the robot that the usual answers are of.

    Where no such box is found it says so: an arm of fewer than six joints does not reach most poses.
    """
    from agent.excitation import working_box

    if robot == _USUAL:
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
    texts = (
        ", ".join(f"{value:g} {unit}" for value in values)
        for values, unit in ((box.centre, "m"), (box.size, "m"), (box.orientation, "deg"), ((box.cone,), "deg"))
    )
    return dict(zip(_BOX, texts, strict=True))


def _ask(question: InitQuestion) -> str:
    while True:
        print(f"{question.words} [{question.default}] ", end="", file=sys.stderr, flush=True)
        line = sys.stdin.readline()
        if not line:
            raise InputError("init: the questions were not answered to the end, so nothing was written")
        answer = line.strip() or question.default
        try:
            question.check(answer)
        except InputError as error:
            print(f"  {error}", file=sys.stderr)
            continue
        return answer


def _valid(question: InitQuestion, value: str) -> None:
    try:
        question.check(value)
    except InputError as error:
        raise InputError(f"--{question.name} {value}: {error}") from None


def _three(dimension: Dimension, bare: Bare) -> Callable[[str], None]:
    def check(text: str) -> None:
        parts = _parts(text)
        if len(parts) != 3:
            raise InputError(f"three quantities with commas between are expected, not {len(parts)}")
        for part in parts:
            _quantity(part, dimension, bare)

    return check


def _quantity(text: str, dimension: Dimension, bare: Bare) -> None:
    try:
        number: float | str = float(text)
    except ValueError:
        number = text
    parse_quantity(number, dimension, bare)


def _parts(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))
