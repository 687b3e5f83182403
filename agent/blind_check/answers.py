"""Answers of a tool: one JSON object a line, in the format of docs/blind-check.md."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from agent.core import LARGEST_JSON, InputError, read_text
from agent.model import CATALOGUE


class _Lenient(BaseModel):
    """Model that ignores keys which the score does not need."""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)


def _known(effect: str) -> str:
    if effect not in CATALOGUE:
        raise ValueError(f"no effect {effect!r} in the catalogue; one of {', '.join(CATALOGUE)}")
    return effect


Effect = Annotated[str, AfterValidator(_known)]


class _Place(_Lenient):
    effect: Effect
    joints: list[str]


class _Cause(_Place):
    probability: float | None = Field(None, ge=0, le=1)
    equivalent_to: list[_Place] = []


class _Share(_Lenient):
    joint: str
    share: float


class _Answer(_Lenient):
    run: str
    verdict: Literal["no_gap", "explained", "ambiguous", "unknown"]
    causes: list[_Cause] = []
    where: list[_Share] = []
    #: Effects that the tool was told to forget for this answer.
    without: list[Effect] = []
    #: Value, low and high of each number of the servos, by number and joint.
    servo: dict[str, list[tuple[float, float, float] | None]] = {}

    @model_validator(mode="after")
    def _names_what_it_explains(self) -> _Answer:
        if bool(self.causes) != (self.verdict in ("explained", "ambiguous")):
            raise ValueError("explained and ambiguous need at least one cause, no_gap and unknown have none")
        return self


def read_answers(path: Path) -> list[dict[str, Any]]:
    """All answers of a file, checked.

    Raises:
        InputError: a line that is no answer, or two for one run; names file and line.
    """
    lines = read_text(path, LARGEST_JSON).removeprefix("\ufeff").split("\n")
    answers: dict[tuple[str, bool], dict[str, Any]] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            answer = _Answer.model_validate_json(line).model_dump()
        except ValidationError as error:
            first = error.errors()[0]
            at = ".".join(map(str, first["loc"]))
            raise InputError(
                f"{path}:{number}: {f'{at}: ' if at else ''}{first['msg'].removeprefix('Value error, ')}"
            ) from None
        if answers.setdefault((answer["run"], bool(answer["without"])), answer) is not answer:
            raise InputError(f"{path}:{number}: a second answer for run {answer['run']}; one a run is scored")
    return list(answers.values())


def answer_line(run: str, result: Mapping[str, Any], without: list[str]) -> str:
    """A diagnosis of this agent as an answer."""
    causes = [
        {
            "effect": cause["effect"],
            "joints": cause["joints"],
            "probability": round(cause["probability"], 4),
            "equivalent_to": [{key: entry[key] for key in ("effect", "joints")} for entry in cause["equivalent_to"]],
        }
        for cause in result["causes"]
    ]
    where = [{"joint": entry["joint"], "share": round(entry["share"], 4)} for entry in result["where"]]
    answer = {"run": run, "verdict": result["verdict"], "causes": causes, "where": where}
    answer |= {"servo": result["servo"]} if result.get("servo") else {}
    return json.dumps(answer | ({"without": without} if without else {}))
