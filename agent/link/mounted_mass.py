"""A mass that a motion was planned with: a person mounts it and confirms it. It is never assumed."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import InputError, read_json, sha256_text

if TYPE_CHECKING:
    from agent.robot import RobotDescription, Tool

#: Key of `experiment.json`: SHA-256 of the program that it is about.
PROGRAM_SHA256 = "program_sha256"
SCHEMA = "experiment/1"
_COMMENT = "planned with this at the flange: "


def with_payload(text: str, load: Tool, comment: str) -> str:
    """A program whose second line, a `comment`, names its payload, so that copies keep it.

    Args:
        text: of the program.
        load: mass at its flange.
        comment: characters that begin a comment.
    """
    from agent.model import payload_text

    first, body = text.split("\n", 1)
    return f"{first}\n  {comment} {_COMMENT}{payload_text(load)}\n{body}"


def planned_load(text: str) -> str | None:
    """The payload that a program says it was planned with; None if it names none."""
    comment = re.search(rf"^  \S+ {_COMMENT}(.+)$", text, re.MULTILINE)
    return comment[1].strip() if comment else None


def check_payload(robot: RobotDescription, tool: Tool | None, load: Tool) -> None:
    """Check that the arm may carry a mass at its flange in addition to its tool.

    Args:
        robot: description with its rated payload.
        tool: at the flange; None: none.
        load: that comes in addition.

    Raises:
        InputError: both together are more than the arm is rated for.
    """
    mounted = 0.0 if tool is None else tool.mass
    rated = robot.rated_payload
    if rated is not None and load.mass + mounted > rated:
        of_tool = f" and {mounted:g} kg of tool" if mounted else ""
        raise InputError(
            f"payload: {load.mass:g} kg{of_tool} at the flange are more than the {rated:g} kg that {robot.name} is "
            "rated for (rated_payload of its description): mount a lighter mass"
        )


def known_of(program: Path, text: str, payload: str | None, ask: Callable[[str], bool]) -> dict[str, str]:
    """Facts for the log: held-out parts of a planned motion, and the payload that a person names or confirms.

    Args:
        program: `experiment.json` next to it names the payload it was planned with; so does its `text`.
        payload: as a person says it (None: nothing was said); ask: a question to a person.

    Raises:
        InputError: no payload, another one than the motion was planned with, one that nobody has confirmed, or a
            program that was changed since it was planned.
    """
    from agent.model import PAYLOAD, payload_of, payload_text
    from agent.recording import PARTS

    stated = None if payload is None else payload_text(payload_of(payload))
    plan = _plan_of(program, text)
    planned = planned_load(text) or plan.get(PAYLOAD)
    if planned and stated is None and ask(f"This motion was planned with {planned} at the flange. Is it mounted?"):
        stated = planned
    if planned and stated != planned:
        raise InputError(
            f"{program}: this motion was planned with a known mass at the flange, {planned}"
            f"{'' if stated is None else f', not {stated}'}: mount it, and say so with --payload '{planned}'"
        )
    facts = {PAYLOAD: stated, PARTS: plan.get(PARTS)}
    return {key: str(value) for key, value in facts.items() if value}


def _plan_of(program: Path, text: str) -> dict[str, Any]:
    from agent.model import PAYLOAD, payload_of, payload_text
    from agent.recording import PARTS, PLANNED_PARTS

    path = program.with_name("experiment.json")
    if not path.exists():
        return {}
    advice = (
        f"what {program.name} was planned with is not known; plan the motion again, or move {path.name} away to run "
        f"{program.name} as a program of your own"
    )
    try:
        planned = read_json(path)
    except InputError as error:
        raise InputError(f"{error}; {advice}") from None
    try:
        is_planned = Path(planned["program"]).name == program.name
        sha256, load = planned[PROGRAM_SHA256], planned.get(PAYLOAD)
        whole = (
            planned["schema"] == SCHEMA
            and planned[PARTS] == PLANNED_PARTS
            and (load is None or payload_text(payload_of(load)) == load)
        )
    except (ValueError, KeyError, TypeError, AttributeError, InputError):
        whole = is_planned = True
        sha256 = None
    if not is_planned:
        return {}
    if not whole or not isinstance(sha256, str):
        raise InputError(f"{path}: is damaged, so {advice}")
    if sha256 != sha256_text(text):
        raise InputError(
            f"{program}: was changed since it was planned, so what {path.name} says of it no longer holds; plan the "
            f"motion again, or move {path.name} away to run it as a program of your own"
        )
    return dict(planned)
