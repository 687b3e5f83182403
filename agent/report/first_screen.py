"""The first screen of a diagnosis: which joint, what, how large, how sure, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from agent.core import package_version
from agent.diagnosis import (
    REGIMES,
    Diagnosis,
    amplitude,
    closes,
    confidence_phrase,
    intervals,
    leading_parameter,
    look_at,
    name,
    phrase,
    place,
    size_text,
    torque_gap,
)
from agent.model import CATALOGUE, PAYLOAD
from agent.recording import Log, machines_of
from agent.report.gap_section import verdict_text
from agent.report.page import About, NextStep
from agent.robot import SHARE, figure_text

#: Title of the section on what these motions cannot show.
NOT_TESTABLE = "Not testable here"
#: Equivalents of a cause that the headline names, at most.
_MOST_OTHERS = 2
#: Steps of a simulator's waterfall on the first screen, at most, and the part of the gap from which one is said.
_MOST_STEPS, _NAMED_STEP = 3, 0.05
_HEADLINES = {
    "no_gap": "No gap: model and robot agree within what the model's own prediction error allows.",
    "unknown": "There is a gap, and no effect of the catalogue closes it.",
}


def headline(result: Mapping[str, Any], size: str = "") -> str:
    """The verdict in one sentence: where, what, how large (`size`, where that is known), how sure."""
    if not result["causes"]:
        if result["verdict"] == "unknown" and result.get("waterfall"):
            return f"{verdict_text(result).capitalize()}."
        text = _HEADLINES.get(result["verdict"], _HEADLINES["unknown"])
        return text + (f" It is on {worst_joints(result)}." if result["verdict"] == "unknown" else "")
    cause = result["causes"][0]
    effect = CATALOGUE[cause["effect"]]
    closed, probability = closes(cause, result["closure"]), f"probability {cause['probability']:.2f}"
    if cause["equivalent_to"]:
        found = [f"as {name(effect.name)}: {size}" if size else "", closed, f"{probability} together"]
        text = f"{place(cause)}: {_one_of(cause)}; these logs do not tell which ({_listed(found)})."
    else:
        sure = confidence_phrase(cause["probability"])
        about = f"{phrase(effect.name, result)} ({_listed([size, closed, probability])})"
        text = f"{place(cause)}: {sure} {name(effect.name)}: {about}."
    if not torque_gap(result):
        text += " In torque, model and robot agree."
    return sentence(text)


def _listed(parts: Sequence[str]) -> str:
    return ", ".join(part for part in parts if part)


def _one_of(cause: Mapping[str, Any]) -> str:
    """A cause and what cannot be told from it, with their places where these differ."""
    others = [
        name(other["effect"]) + ("" if other["joints"] == cause["joints"] else f" on {place(other)}")
        for other in cause["equivalent_to"]
    ]
    more = [f"{len(others) - _MOST_OTHERS} others"] if len(others) > _MOST_OTHERS + 1 else others[_MOST_OTHERS:]
    return " or ".join([name(cause["effect"]), *others[:_MOST_OTHERS], *more])


def sized(diagnosis: Diagnosis, number: int = 0) -> str:
    """How large a cause is, with its interval; empty where there is no such cause, or no one figure says it."""
    causes = diagnosis.result["causes"]
    key = leading_parameter(causes[number]) if number < len(causes) else None
    if key is None:
        return ""
    cause, known = causes[number], intervals(diagnosis.finding)
    swing = amplitude(cause["parameters"], known[number] if number < len(known) else {})
    if key in ("cosine_1", "sine_1") and swing is not None:
        return f"amplitude {size_text(cause, key, *swing)}"
    return f"{key.rstrip('0123456789').replace('_', ' ').strip()} {parameter_text(diagnosis, number, key)}"


def parameter_text(diagnosis: Diagnosis, number: int, key: str) -> str:
    """A parameter of a cause with interval and unit; of one without, two digits, but of when something happened."""
    cause = diagnosis.result["causes"][number]
    known = intervals(diagnosis.finding)
    interval = known[number].get(key) if number < len(known) else None
    value, about = float(cause["parameters"][key]), ""
    if interval is None and not value.is_integer() and not CATALOGUE[cause["effect"]].once:
        value, about = float(f"{value:.2g}"), "about "
    return about + size_text(cause, key, value, interval)


def sentence(text: str) -> str:
    """Begun with a capital, unless with the name of a joint."""
    return f"T{text[1:]}" if text.startswith("the ") else text


def worst_joints(result: Mapping[str, Any]) -> str:
    """The joints that carry the gap, in words."""
    largest = [entry["joint"] for entry in result["where"] if entry["share"] > 0.25]
    return " and ".join(largest or [result["where"][0]["joint"]])


def share_text(entry: Mapping[str, Any]) -> str:
    """A share of the gap, with its interval where that says more."""
    text = f"{100 * entry['share']:.0f} %"
    interval = entry.get("interval")
    within = "" if interval is None else f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f}"
    return text if within in ("", f"{text[:-2]} to {text[:-2]}") else f"{text} ({within})"


def where_sentences(result: Mapping[str, Any]) -> Iterator[str]:
    """The joints that carry the gap, each with the regimes in which more of it lies than time is spent there."""
    if not torque_gap(result):
        return
    for entry in result["where"]:
        if entry["share"] < 0.15:
            continue
        marked = [r for r in entry["regimes"] if r["name"] in REGIMES and r["share"] > 1.4 * r["of_samples"]]
        marked += [r for r in entry["regimes"] if r["name"] == "motor_phase" and r["share"] > 0.3]
        where = ", ".join(f"{REGIMES[r['name']]} ({share_text(r)} of it)" for r in marked[:3])
        yield f"{entry['joint']} has {share_text(entry)} of the gap" + (f", mostly {where}." if where else ".")


def about_diagnosis(
    diagnosis: Diagnosis, next_steps: Sequence[NextStep], experiment: Mapping[str, Any] | None
) -> About:
    """What stands on the first screen beside the verdict; `next_steps` are commands that whoever asked can run,
    `experiment` is `next_experiment` of the result, a motion that was planned or not."""
    dataset = diagnosis.dataset
    asked = (
        "What does the simulator (the model) not have that the robot has?"
        if dataset.given
        else "What do these motions show that no model of the arm's links and friction absorbs?"
    )
    return About(asked, list(_facts(diagnosis)), [*_measures(diagnosis, experiment), *next_steps], _identity(diagnosis))


def _facts(diagnosis: Diagnosis) -> list[str]:
    result = diagnosis.result
    facts = list(_largest_steps(result)) if diagnosis.calibrated is not None else []
    worst = result["where"][0]["joint"]
    if diagnosis.answer.torque_of == "servos":
        facts.append("Torque was not measured: it is what the simulator's servos would give at the set-points.")
    if torque_gap(result):
        own = result["causes"][0]["joints"] if result["causes"] else []
        shown = [worst] if worst in own or len(own) != 1 else [own[0], worst]
        facts += [f"Torque error of {joint} on motion left out: {_error(result, joint)}." for joint in shown]
    else:
        facts.append(f"Largest torque error on motion left out: {_error(result, worst)}, on {worst}.")
    if result["verdict"] == "unknown":
        facts += where_sentences(result)
    if result["verdict"] == "no_gap":
        facts.append(_found_if_there(result))
    for number, cause in enumerate(result["causes"][1:], start=1):
        found = ", ".join(part for part in (sized(diagnosis, number), closes(cause)) if part)
        facts.append(sentence(f"{place(cause)} as well: {name(cause['effect'])}" + (f" ({found})." if found else ".")))
    if result["causes"] and result["causes"][0]["equivalent_to"]:
        cause = result["causes"][0]
        facts += [
            f"{name(one['effect'])[0].upper()}{name(one['effect'])[1:]}, {place(one)}: {phrase(one['effect'], result)}."
            for one in (cause, *cause["equivalent_to"])
        ]
    return facts


def _largest_steps(result: Mapping[str, Any]) -> Iterator[str]:
    """Of a simulator, what closes most of the gap: numbers that are off may matter more than an effect it has not."""
    steps = [step for step in result.get("waterfall", ())[:-1] if step["closes"] >= _NAMED_STEP]  # the last: the rest
    largest = sorted(steps, key=lambda step: -step["closes"])[:_MOST_STEPS]
    if largest:
        closing = ", ".join(f"{step['step']} ({100 * step['closes']:.0f} %)" for step in largest)
        yield f"Most of the gap closes with: {closing}."


def _error(result: Mapping[str, Any], joint: str) -> str:
    gap, k = result["gap"], result["gap"]["joints"].index(joint)
    before, after = (figure_text(gap[side][k], gap["units"][k]) for side in ("before", "after"))
    if gap["units"][k] == SHARE:
        before += " of nominal torque"
    return before + (f", {after} with what was found" if result["causes"] and torque_gap(result) else "")


def _found_if_there(result: Mapping[str, Any]) -> str:
    """How far "no gap" can be trusted: what would have been found."""
    open_ = {entry["effect"] for entry in result["not_testable"]}
    usual = "would have been found at the size from which it matters (80 % power)"
    if not open_:
        return f"Every effect of the catalogue {usual}."
    return (
        f"{len(CATALOGUE) - len(open_)} of {len(CATALOGUE)} effects {usual} on every joint; the rest: {NOT_TESTABLE}."
    )


def _measures(diagnosis: Diagnosis, experiment: Mapping[str, Any] | None) -> list[NextStep]:
    result = diagnosis.result
    steps = [NextStep(f"look at {look_at(cause['effect'], result)}.") for cause in result["causes"][:1]]
    if experiment is not None and not experiment.get("program"):  # one that was planned has a command of its own
        motion = experiment["motion"]
        steps.append(NextStep(f"{motion}." if "program" in experiment else f"run {motion}."))
    return steps


def _recorded(logs: Sequence[Log]) -> str:
    """When, where the clock of every log shows a date."""
    dates = sorted(log.date for log in logs if log.date is not None)
    if len(dates) < len(logs):
        return "by a clock without a date"
    first, last = (date.strftime("%Y-%m-%d %H:%M UTC") for date in (dates[0], dates[-1]))
    return first if first == last else f"{first} to {last}"


def _identity(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    dataset = diagnosis.dataset
    machines = machines_of(dataset.logs)
    model = f"{dataset.model.method}, {len(dataset.model.values)} parameters"
    return [
        ("robot", dataset.robot.name),
        *((key, ", ".join(values) or "not reported") for key, values in machines.items()),
        *(
            ("mass at the flange", f"{load} ({log.name})")
            for log in dataset.logs
            if (load := log.metadata.get(PAYLOAD))
        ),
        ("recorded", _recorded(dataset.logs)),
        ("logs", str(len(dataset.logs))),
        ("model", model if dataset.given else f"fitted to these logs: {model}"),
        ("program", f"calibration-agent {package_version()}"),
    ]
