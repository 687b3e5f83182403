"""A mass that a motion was planned with: a person mounts it and says so. It is never assumed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.core import InputError


def known_of(program: Path, payload: str | None, ask: Callable[[str], bool]) -> dict[str, str]:
    """What the log says of a program: in how many parts a planned motion is held out, and of a payload that which a
    person names, or confirms because the program was planned with it.

    Args:
        program: beside it, `experiment.json` says what it was planned with.
        payload: as a person says it (None: nothing was said); ask: a question to a person.

    Raises:
        InputError: no payload, another one than the motion was planned with, or one that nobody has confirmed.
    """
    from agent.model import PAYLOAD, payload_of, payload_text
    from agent.recording import PARTS

    said = None if payload is None else payload_text(payload_of(payload))
    plan = _plan_of(program)
    planned = plan.get(PAYLOAD)
    if planned and said is None and ask(f"This motion was planned with {planned} at the flange. Is it mounted?"):
        said = planned
    if planned and said != planned:
        raise InputError(
            f"{program}: this motion was planned with a known mass at the flange, {planned}"
            f"{'' if said is None else f', not {said}'}: mount it, and say so with --payload '{planned}'"
        )
    facts = {PAYLOAD: said, PARTS: plan.get(PARTS)}
    return {key: str(value) for key, value in facts.items() if value}


def _plan_of(program: Path) -> dict[str, Any]:
    path = program.with_name("experiment.json")
    if not path.exists():
        return {}
    try:
        planned = json.loads(path.read_text(encoding="utf-8"))
        beside = Path(planned["program"]).name == program.name
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); plan the motion again, or move it away") from None
    return planned if beside else {}
