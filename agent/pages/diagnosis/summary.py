"""Sections about a diagnosis that other pages show too: its verdict, the planned motion, and further motions run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agent.diagnosis import has_torque_gap, reported_parameters, size_text
from agent.pages.elements import Section, Table
from agent.pages.phrasing import chances_text, diagnosis_summary, effect_phrase, next_text, place
from agent.robot import figure_text


def diagnosis_sections(diagnosis: dict[str, Any] | None, reference: str) -> list[Section | None]:
    """What the diagnosis of a run found, or why it did not run; `reference`: the last accepted run, if there is one."""
    if diagnosis is None:
        why = "there is no earlier model to compare with."
        if reference:
            why = f"the model of {reference} predicts the fresh data no worse than it did at its own calibration."
        return [Section("Diagnosis", (f"Not needed: {why}",))]
    result = diagnosis["result"]
    if result is None:
        return [Section("Diagnosis", (diagnosis["summary"],))]
    return [diagnosis_section(result), rounds_section(result.get("rounds"), result.get("rounds_end", ""))]


def diagnosis_section(result: dict[str, Any]) -> Section:
    """Verdict, causes, and where the gap lies."""
    text = [diagnosis_summary(result)]
    if result["next_experiment"] is not None:
        text.append(f"{next_text(result['next_experiment'])}.")
    causes = []
    for cause in result["causes"]:
        closed, probability = _percent(cause["closure"]), f"{cause['probability']:.2f}"
        sizes = [f"{key} {size_text(cause, key, cause['parameters'][key])}" for key in reported_parameters(cause)]
        equals = ", ".join(other["effect"] for other in cause["equivalent_to"]) or "-"
        causes.append(
            (effect_phrase(cause["effect"], result), place(cause), closed, probability, "; ".join(sizes), equals)
        )
    gap = result["gap"]
    # where there is no gap in torque, no joint has a share of it
    shares = {entry["joint"]: entry["share"] for entry in result["where"] if has_torque_gap(result)}
    where = [
        (joint, figure_text(before, unit, 3), figure_text(after, unit, 3), _percent(shares.get(joint)))
        for joint, before, after, unit in zip(gap["joints"], gap["before"], gap["after"], gap["units"], strict=True)
    ]
    causes_header = ("effect", "joints", "closes [%]", "probability", "parameters", "equally good")
    where_header = ("joint", "error without", "error with these effects", "share of the gap [%]")
    parts = (Table("causes", causes_header, causes), Table("gap", where_header, where))
    return Section("Diagnosis against the last model", text, parts)


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f}"


def planned_section(experiment: Mapping[str, Any] | None) -> Section | None:
    """The planned motion, if there is one."""
    if experiment is None or not experiment.get("program"):
        return None
    rows = [chances_text(entry) for entry in experiment["probability"]]
    text = [
        f"{next_text(experiment)}.",
        "The probability of the right answer is the one expected after the motion, with either cause. A size of 1 is "
        "the smallest that matters.",
    ]
    text += [f"{experiment['with_a_mass']['text']}."] if "with_a_mass" in experiment else []
    header = ("open", "right answer now", "after it (for each cause)", "smallest size that it detects")
    return Section("The next motion", text, (Table("planned", header, rows),))


def rounds_section(rounds: Sequence[Mapping[str, Any]] | None, end: str) -> Section | None:
    """Further motions, `end` being why no other followed; None if no rounds were asked for."""
    if rounds is None:
        return None
    rows = []
    for number, round_ in enumerate(rounds, start=1):
        pairs = "; ".join(" or ".join(entry["pair"]) for entry in round_["probability"])
        chances = "; ".join(f"{entry['before']:.2f}, {entry['after']:.2f}" for entry in round_["probability"])
        rows.append(
            (str(number), pairs, f"{round_['motion']} ({round_['duration_s']:.0f} s)", chances, _answer(round_))
        )
    first = "Each round runs the motion that most likely settles what is still open."
    text = [first if rows else "No further motion was run.", *([f"After that: {end}."] if end else [])]
    header = ("round", "question", "motion", "right answer, before and after", "answer")
    return Section("Results of further motions", text, (Table("rounds", header, rows),) if rows else ())


def _answer(round_: Mapping[str, Any]) -> str:
    if not round_.get("verdict"):
        return "none: interrupted"
    causes = [f"{cause['effect']} on {place(cause)}" for cause in round_["causes"]]
    return f"{round_['verdict']}: {', '.join(causes)}" if causes else str(round_["verdict"])
