"""What a diagnosis found, in short: for a report that opens with it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.diagnosis import in_torque, reported_parameters, size_text, torque_gap
from agent.report.page import Section, Table
from agent.report.rounds_section import next_text
from agent.robot import SHARE, figure_text

#: What a verdict means, where its name does not say it all.
_VERDICTS = {
    "no_gap": "nothing of practical size beyond what the model's own prediction error allows",
    "explained": "",
    "ambiguous": "the data cannot tell the first cause from its equivalents",
    "unknown": "there is a gap, and no effect of the catalogue closes it",
}


def verdict_text(result: Mapping[str, Any]) -> str:
    """What the verdict of a result means; empty where its name says it all.

    Numbers of a simulator that were moved may close nearly all of a gap though nothing of the catalogue was found.
    """
    closed = sum(step["closes"] for step in result.get("waterfall", ())[:-1])
    if result["verdict"] == "unknown" and closed > 0:
        return (
            f"numbers of the simulator, moved, close {100 * closed:.1f} % of the gap; "
            "what they leave, no effect of the catalogue closes"
        )
    return _VERDICTS[result["verdict"]]


def diagnosis_summary(result: dict[str, Any]) -> str:
    """One sentence from a result of schema diagnosis/1."""
    # the controller's path is a matter of its own: it is in the table, not in the sentence about torque
    named = [cause for cause in result["causes"] if in_torque(cause)] or result["causes"]
    verdict = verdict_text(result) or result["verdict"]
    causes = " and ".join(_cause(cause) for cause in named)
    return f"{verdict[0].upper()}{verdict[1:]}{': ' if causes else ''}{causes}."


def diagnosis_section(result: dict[str, Any]) -> Section:
    """Verdict, causes, and where the gap lies."""
    text = [diagnosis_summary(result)]
    if result["next_experiment"] is not None:
        text.append(f"{next_text(result['next_experiment'])}.")
    causes = [
        (
            cause["effect"],
            ", ".join(cause["joints"]) or "whole arm",
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
    causes_header = ("effect", "joints", "closes [%]", "probability", "parameters", "as good")
    where_header = ("joint", "error without", "error with these effects", "share of the gap [%]")
    parts = (Table("causes", causes_header, causes), Table("gap", where_header, where))
    return Section("Diagnosis against the last model", text, parts)


def _cause(cause: dict[str, Any]) -> str:
    joints = ", ".join(cause["joints"]) or "the whole arm"
    gap = "the gap" if in_torque(cause) else "the gap between planned and executed path"
    closure = "" if cause["closure"] is None else f", closing {100 * cause['closure']:.0f} % of {gap}"
    return f"{cause['effect'].replace('_', ' ')} on {joints}{closure}"


def _size(cause: dict[str, Any], key: str) -> str:
    return f"{key} {size_text(cause, key, cause['parameters'][key])}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f}"
