"""What further motions are expected to tell, and what those of a diagnosis that went on until it was sure told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agent.report.page import Section, Table
from agent.report.phrasing import place


def next_text(experiment: Mapping[str, Any]) -> str:
    """`next_experiment` of a result in a sentence without its full stop: what to run, or why there is no motion."""
    motion = str(experiment["motion"])
    if "program" in experiment and experiment["program"] is None:
        return f"{motion[0].upper()}{motion[1:]}"
    took = f" ({experiment['duration_s']:.0f} s, {experiment['program']})" if "program" in experiment else ""
    return f"Run next: {motion}{took}"


def said_by_rounds(result: Mapping[str, Any]) -> bool:
    """Whether why the rounds ended is all that there is of a next experiment."""
    experiment = result["next_experiment"]
    return experiment is not None and experiment["motion"] == result.get("rounds_end")


def planned_sections(experiment: Mapping[str, Any] | None) -> list[Section]:
    """The section on a motion that was planned; none where none was."""
    if experiment is None or not experiment.get("program"):
        return []
    rows = [tuple(chances_text(entry)) for entry in experiment["probability"]]
    text = [
        f"{next_text(experiment)}.",
        "The probability of the right answer is the one expected after the motion, with either cause. A size of 1 is "
        "the smallest that matters.",
    ]
    text += [f"{experiment['with_a_mass']['text']}."] if "with_a_mass" in experiment else []
    header = ("open", "right answer now", "after it (for each cause)", "smallest size that it detects")
    return [Section("The next motion", text, (Table("planned", header, rows),))]


def chances_text(entry: Mapping[str, Any]) -> tuple[str, str, str, str]:
    """Of a planned motion and one pair: the pair, both probabilities of the right answer, and the smallest size."""
    smallest = entry["smallest_over_practical"]
    size = "-" if smallest is None else f"{smallest:.2g}"
    sides = [f"{side:.2f}" for side in entry["after_if"] if side is not None]
    after = f"{entry['after']:.2f}" + (f" ({' or '.join(sides)})" if len(set(sides)) > 1 else "")
    return " or ".join(entry["pair"]), f"{entry['before']:.2f}", after, size


def rounds_sections(rounds: Sequence[Mapping[str, Any]] | None, end: str) -> list[Section]:
    """The section, `end` being why no further motion followed; none where no rounds were asked for (None)."""
    if rounds is None:
        return []
    rows = [
        (str(number), _question(one), f"{one['motion']} ({one['duration_s']:.0f} s)", _chance(one), _answer(one))
        for number, one in enumerate(rounds, start=1)
    ]
    text = [
        "Each round runs the motion that most likely settles what is still open."
        if rows
        else "No further motion was run."
    ]
    text += [f"After that: {end}."] if end else []
    header = ("round", "question", "motion", "right answer, before and after", "answer")
    return [Section("Results of further motions", text, (Table("rounds", header, rows),) if rows else ())]


def _question(one: Mapping[str, Any]) -> str:
    return "; ".join(" or ".join(entry["pair"]) for entry in one["probability"])


def _chance(one: Mapping[str, Any]) -> str:
    return "; ".join(f"{entry['before']:.2f}, {entry['after']:.2f}" for entry in one["probability"])


def _answer(one: Mapping[str, Any]) -> str:
    if not one.get("verdict"):
        return "none: interrupted"
    causes = [f"{cause['effect']} on {place(cause)}" for cause in one["causes"]]
    return f"{one['verdict']}: {', '.join(causes)}" if causes else str(one["verdict"])
