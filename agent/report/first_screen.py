"""The first screen of a diagnosis: which joint, what, how large, how sure, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from agent.core import package_version
from agent.diagnosis import (
    Diagnosis,
    closes,
    confidence_phrase,
    intervals,
    leading_parameter,
    name,
    place,
    size_text,
    torque_gap,
)
from agent.model import CATALOGUE
from agent.recording import machines_of
from agent.report.page import About, NextStep
from agent.robot import figure_text

_HEADLINES = {
    "no_gap": "No gap: model and robot agree within what the model's own prediction error allows.",
    "unknown": "There is a gap, and no effect of the catalogue closes it.",
}


def headline(result: Mapping[str, Any], size: str = "") -> str:
    """The verdict in one sentence: where, what, how large (`size`, where that is known), how sure."""
    if not result["causes"]:
        text = _HEADLINES.get(result["verdict"], _HEADLINES["unknown"])
        return text + (f" It is on {worst_joints(result)}." if result["verdict"] == "unknown" else "")
    cause = result["causes"][0]
    sure = confidence_phrase(result["verdict"], cause["probability"])
    effect = CATALOGUE[cause["effect"]]
    found = [size, closes(cause), f"probability {cause['probability']:.2f}"]
    text = f"{place(cause)}: {sure} {name(effect.name)}: {effect.phrase} ({', '.join(part for part in found if part)})."
    if not torque_gap(result):
        text += " In torque, model and robot agree."
    return sentence(text)


def sized(diagnosis: Diagnosis, number: int = 0) -> str:
    """How large a cause is, with its interval; empty where there is no such cause, or no one figure says it."""
    causes = diagnosis.result["causes"]
    key = leading_parameter(causes[number]) if number < len(causes) else None
    if key is None:
        return ""
    return f"{key.rstrip('0123456789').replace('_', ' ').strip()} {parameter_text(diagnosis, number, key)}"


def parameter_text(diagnosis: Diagnosis, number: int, key: str) -> str:
    """A parameter of a cause with interval and unit."""
    cause = diagnosis.result["causes"][number]
    known = intervals(diagnosis.finding)
    interval = known[number].get(key) if number < len(known) else None
    return size_text(cause["effect"], key, cause["parameters"][key], interval, _slides(diagnosis, cause))


def _slides(diagnosis: Diagnosis, cause: Mapping[str, Any]) -> bool:
    joints = {joint.name: joint.prismatic for joint in diagnosis.dataset.robot.joints}
    return bool(cause["joints"]) and all(joints[joint] for joint in cause["joints"])


def sentence(text: str) -> str:
    """Begun with a capital, unless with the name of a joint."""
    return f"T{text[1:]}" if text.startswith("the ") else text


def worst_joints(result: Mapping[str, Any]) -> str:
    """The joints that carry the gap, in words."""
    largest = [entry["joint"] for entry in result["where"] if entry["share"] > 0.25]
    return " and ".join(largest or [result["where"][0]["joint"]])


def about_diagnosis(diagnosis: Diagnosis, next_steps: Sequence[NextStep]) -> About:
    """What stands on the first screen beside the verdict; `next_steps` are commands that whoever asked can run."""
    dataset = diagnosis.dataset
    asked = (
        "What does the simulator (the model) not have that the robot has?"
        if dataset.given
        else "What do these motions show that no model of the arm's links and friction absorbs?"
    )
    return About(asked, list(_facts(diagnosis)), [*_measures(diagnosis), *next_steps], _identity(diagnosis))


def _facts(diagnosis: Diagnosis) -> list[str]:
    result = diagnosis.result
    facts = []
    worst = result["gap"]["joints"].index(result["where"][0]["joint"])
    before, after = (
        figure_text(result["gap"][side][worst], result["gap"]["units"][worst]) for side in ("before", "after")
    )
    if torque_gap(result):
        facts.append(
            f"Torque error of {result['gap']['joints'][worst]} on motion left out: {before}"
            + (f", {after} with what was found." if result["causes"] else ".")
        )
    else:
        facts.append(f"Largest torque error on motion left out: {before}, on {result['gap']['joints'][worst]}.")
    for number, cause in enumerate(result["causes"][1:], start=1):
        found = ", ".join(part for part in (sized(diagnosis, number), closes(cause)) if part)
        facts.append(sentence(f"{place(cause)} as well: {name(cause['effect'])}" + (f" ({found})." if found else ".")))
    if result["causes"] and result["causes"][0]["equivalent_to"]:
        others = [f"{name(o['effect'])} on {place(o)}" for o in result["causes"][0]["equivalent_to"]]
        facts.append(f"These logs cannot tell it from: {'; '.join(others)}.")
    return facts


def _measures(diagnosis: Diagnosis) -> list[NextStep]:
    result = diagnosis.result
    steps = [NextStep(f"look at {CATALOGUE[cause['effect']].look_at}.") for cause in result["causes"][:1]]
    if result["next_experiment"] is not None:
        steps.append(NextStep(f"run {result['next_experiment']['motion']}."))
    return steps


def _identity(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    dataset = diagnosis.dataset
    machines = machines_of(dataset.logs)
    dates = sorted(datetime.fromtimestamp(log.stamp, UTC).strftime("%Y-%m-%d %H:%M UTC") for log in dataset.logs)
    model = f"{dataset.model.method}, {len(dataset.model.values)} parameters"
    return [
        ("robot", dataset.robot.name),
        *((key, ", ".join(values) or "not reported") for key, values in machines.items()),
        ("recorded", dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"),
        ("logs", str(len(dataset.logs))),
        ("model", model if dataset.given else f"fitted to these logs: {model}"),
        ("program", f"calibration-agent {package_version()}"),
    ]
