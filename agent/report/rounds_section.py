"""The rounds of a diagnosis that went on until it was sure: what each asked, which motion, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agent.diagnosis import name, place
from agent.report.page import Section, Table


def rounds_sections(rounds: Sequence[Mapping[str, Any]] | None, end: str) -> list[Section]:
    """The section, `end` being why no further motion followed; none where no rounds were asked for (None)."""
    if rounds is None:
        return []
    rows = [
        (str(number), _question(one), f"{one['motion']} ({one['duration_s']:.0f} s)", _chance(one), _answer(one))
        for number, one in enumerate(rounds, start=1)
    ]
    text = [
        "Each round asks what all motions before it leave open, by the motion that makes the right answer likeliest."
        if rows
        else "No further motion was run."
    ]
    text += [f"After that: {end}."] if end else []
    header = ("round", "question", "motion", "right answer, before and after", "answer")
    return [Section("What further motions told", text, (Table("rounds", header, rows),) if rows else ())]


def _question(one: Mapping[str, Any]) -> str:
    return "; ".join(" or ".join(entry["pair"]) for entry in one["probability"])


def _chance(one: Mapping[str, Any]) -> str:
    return "; ".join(f"{entry['before']:.2f}, {entry['after']:.2f}" for entry in one["probability"])


def _answer(one: Mapping[str, Any]) -> str:
    if "verdict" not in one:
        return "none: it was cut short"
    causes = [f"{name(cause['effect'])} on {place(cause)}" for cause in one["causes"]]
    return f"{one['verdict']}: {', '.join(causes)}" if causes else str(one["verdict"])
