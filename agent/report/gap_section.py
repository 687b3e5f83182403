"""What a diagnosis found, in short: for a report that opens with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.diagnosis import reported_parameters, size_text, torque_gap
from agent.report.page import Section, Table
from agent.report.phrasing import closes, headline, place, what
from agent.report.rounds_section import next_text
from agent.robot import SHARE, figure_text


def diagnosis_summary(result: Mapping[str, Any]) -> str:
    """Headline and what the causes close, from a result of schema diagnosis/1."""
    figures = [f"{place(cause)}: {found}." for cause in result["causes"] if (found := closes(cause, result))]
    return " ".join([headline(result), *figures])


def diagnosis_section(result: dict[str, Any]) -> Section:
    """Verdict, causes, and where the gap lies."""
    text = [diagnosis_summary(result)]
    if result["next_experiment"] is not None:
        text.append(f"{next_text(result['next_experiment'])}.")
    causes = [
        (
            what(cause["effect"], result),
            place(cause),
            _percent(cause["closure"]),
            f"{cause['probability']:.2f}",
            "; ".join(_size(cause, key) for key in reported_parameters(cause)),
            ", ".join(other["effect"] for other in cause["equivalent_to"]) or "-",
        )
        for cause in result["causes"]
    ]
    gap = result["gap"]
    units = gap.get("units", [SHARE] * len(gap["joints"]))  # earlier versions do not say it
    # where there is no gap in torque, no joint has a share of it
    shares = {entry["joint"]: entry["share"] for entry in result["where"] if torque_gap(result)}
    where = [
        (joint, figure_text(before, unit, 3), figure_text(after, unit, 3), _percent(shares.get(joint)))
        for joint, before, after, unit in zip(gap["joints"], gap["before"], gap["after"], units, strict=True)
    ]
    causes_header = ("effect", "joints", "closes [%]", "probability", "parameters", "equally good")
    where_header = ("joint", "error without", "error with these effects", "share of the gap [%]")
    parts = (Table("causes", causes_header, causes), Table("gap", where_header, where))
    return Section("Diagnosis against the last model", text, parts)


def _size(cause: dict[str, Any], key: str) -> str:
    return f"{key} {size_text(cause, key, cause['parameters'][key])}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f}"
