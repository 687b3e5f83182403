"""The page of a diagnosis: the answer and the next step, then the figures, then every step of the procedure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from agent.core import AgentError, package_version, plus_minus
from agent.diagnosis import Diagnosis, Simulated, could_show, has_torque_gap, reported_parameters, simulation_part
from agent.model import CATALOGUE, PAYLOAD, FileNumbers, ModelEffect
from agent.pages.diagnosis.figures import (
    band_map,
    gap_table,
    power_map,
    regime_map,
    remainder,
    simulated_torque,
    timeline,
    waterfall,
)
from agent.pages.diagnosis.free_motion import motion_section
from agent.pages.diagnosis.simulator import drift_section, ranges_section, waterfall_section
from agent.pages.diagnosis.summary import planned_section, rounds_section
from agent.pages.elements import About, NextStep, Page, Section, Table, render
from agent.pages.phrasing import (
    NOT_TESTABLE,
    SUMMARY_KEYS,
    closes,
    effect_phrase,
    headline,
    look_at,
    measures,
    next_text,
    parameter_text,
    place,
    said_by_rounds,
    summary,
    where_sentences,
)
from agent.pages.scene import arm_picture
from agent.recording import Log, machines_of
from agent.robot import figure_text
from agent.simulators import identified_load

#: Title of the section on candidates, and how many it lists.
HYPOTHESES, _MOST_HYPOTHESES = "Hypotheses compared", 20
#: Columns of the table of pushes, by the name of the parameter.
_OF_PUSH = {"on link": "link", "from": "start", "to": "end"} | {f"force {axis}": f"force_{axis}" for axis in "xyz"}


def diagnosis_report(
    diagnosis: Diagnosis,
    simulated: Sequence[Simulated] = (),
    next_steps: Sequence[NextStep] = (),
    result: Mapping[str, Any] | None = None,
) -> str:
    """HTML text of the report.

    `next_steps` are commands that whoever asked can run; `result` is what was made of the diagnosis' own, where a
    simulator was run forward (`forward`, `ranges`) or further motions were planned or run (`next_experiment`,
    `rounds`).

    Args:
        diagnosis: what is shown.
        simulated: runs of the arm forward in time.
        next_steps: commands that whoever asked can run.
        result: with further keys than the diagnosis' own; None: that.
    """
    result = diagnosis.result if result is None else result
    forward = result.get("forward")
    sections = [
        motion_section(diagnosis, result),
        _cause_section(diagnosis, None if said_by_rounds(result) else result["next_experiment"]),
        planned_section(result["next_experiment"]),
        rounds_section(result.get("rounds"), result.get("rounds_end", "")),
        _where_section(diagnosis),
        _closure_section(diagnosis, simulated),
        waterfall_section(diagnosis),
        drift_section(forward),
        ranges_section(result),
        _hypotheses_section(diagnosis),
        _testability_section(diagnosis),
    ]
    colour = {"no_gap": "good" if could_show(result) else "plain", "explained": "bad"}.get(result["verdict"], "plain")
    title = f"Gap between model and {diagnosis.dataset.robot.name}"
    return render(Page(title, headline(result), colour, sections, about_diagnosis(diagnosis, next_steps, result)))


def about_diagnosis(diagnosis: Diagnosis, next_steps: Sequence[NextStep], result: Mapping[str, Any]) -> About:
    """The first screen below the verdict; `next_steps` are commands that whoever asked can run."""
    dataset = diagnosis.dataset
    logs, model = dataset.logs, f"{dataset.model.method}, {len(dataset.model.values)} parameters"
    asked = (
        "What does the robot have that the model lacks?"
        if dataset.has_reference
        else "What do these motions show that links and friction cannot explain?"
    )
    texts = summary(result)
    facts = [(title, texts[key]) for key, title in SUMMARY_KEYS.items() if key != "next"]
    marked = result["causes"][0]["joints"] if result["causes"] else []
    posture = logs[0].position[len(logs[0].position) // 2]
    picture = arm_picture(dataset.robot, posture, marked) if marked else ""
    masses = [(log, load) for log in logs if (load := log.metadata.get(PAYLOAD))]
    identity = [
        ("robot", dataset.robot.name),
        *((key, ", ".join(values) or "not reported") for key, values in machines_of(logs).items()),
        *(("mass at the flange", f"{load} ({log.name})") for log, load in masses),
        ("recorded", _recorded(logs)),
        ("logs", str(len(logs))),
        ("model", model if dataset.has_reference else f"fitted to these logs: {model}"),
        ("program", f"calibration-agent {package_version()}"),
    ]
    return About(asked, facts, [*measures(result), *next_steps], identity, picture)


def _recorded(logs: Sequence[Log]) -> str:
    """The dates of the logs, where the clock of every log shows one."""
    dates = sorted(log.date for log in logs if log.date is not None)
    if len(dates) < len(logs):
        return "no date in the logs"
    first, last = (date.strftime("%Y-%m-%d %H:%M UTC") for date in (dates[0], dates[-1]))
    return first if first == last else f"{first} to {last}"


def _load_rows(diagnosis: Diagnosis) -> Iterator[tuple[str, str, str]]:
    """The centre of mass of a load that was found, in the frame in which it is entered at the controller."""
    for cause, intervals in zip(diagnosis.result["causes"], diagnosis.result["intervals"], strict=True):
        if CATALOGUE[cause["effect"]].numbers != FileNumbers.LOAD:
            continue
        effect = ModelEffect(cause["effect"], (), cause["parameters"], intervals)
        try:
            load = identified_load(replace(diagnosis.dataset.model, effects=(effect,)))
        except AgentError:
            continue  # no body, or no flange that is certain
        errors = np.full(3, np.nan) if load.centre_error is None else 1e3 * load.centre_error
        centre = ", ".join(plus_minus(x, error) for x, error in zip(1e3 * load.centre, errors, strict=True))
        yield f"{cause['effect']}, {place(cause)}", f"centre of mass in {load.flange}", f"{centre} mm"


def _cause_section(diagnosis: Diagnosis, next_experiment: Mapping[str, Any] | None) -> Section:
    result = diagnosis.result
    text = [sentence for cause in result["causes"] for sentence in _about_cause(cause, result)]
    if result["verdict"] == "unknown":
        text.append(f"No effect that was tried explains it. How far the nearest fall short: {HYPOTHESES}.")
    if next_experiment is not None:
        text.append(f"{next_text(next_experiment)}.")
    text += [f"Warning: {warning}." for warning in diagnosis.warnings]
    rows = [
        (f"{cause['effect']}, {place(cause)}", key.replace("_", " "), parameter_text(result, number, key))
        for number, cause in enumerate(result["causes"])
        for key in reported_parameters(cause)
        if not CATALOGUE[cause["effect"]].transient
    ]
    rows += _load_rows(diagnosis)
    pushes = list(_push_rows(diagnosis))
    if rows or pushes:
        text.append(
            "Intervals come from leaving out one motion at a time. Values marked 'about' have no interval: they are "
            "chosen from a grid, and values fitted with them may be off by more."
            + (" Intervals of a push leave out short segments of it, and are narrower." if pushes else "")
        )
    tables = [Table("parameters", ("cause", "parameter", "value, 95 % interval"), rows)] if rows else []
    tables += [Table("pushes", ("push", *_OF_PUSH, "in log"), pushes)] if pushes else []
    return Section("What it is", text or ["Nothing to look for."], tables)


def _push_rows(diagnosis: Diagnosis) -> Iterator[tuple[str, ...]]:
    """Where, when and how hard, of every push of a contact."""
    for number, cause in enumerate(diagnosis.result["causes"]):
        parameters = cause["parameters"] if CATALOGUE[cause["effect"]].transient else {}
        pushes = sum(key.startswith("link") for key in parameters)
        for push in range(1, pushes + 1):
            end = "" if push == 1 else f"_{push}"
            link, *texts = (parameter_text(diagnosis.result, number, key + end) for key in _OF_PUSH.values())
            point = [parameters[key] for axis in "xyz" if (key := f"at_{axis}{end}") in parameters]
            if point:
                link += f" at ({', '.join(f'{round(value, 2) + 0.0:.2f}' for value in point)}) m from its far end"
            yield str(push), link, *texts, diagnosis.dataset.logs[int(parameters[f"log{end}"])].name


def _about_cause(cause: Mapping[str, Any], result: Mapping[str, Any]) -> Iterator[str]:
    closed = f" On held-out motion it {closes(cause, result)}." if closes(cause, result) else ""
    together = " for it and what cannot be distinguished from it" if cause["equivalent_to"] else ""
    effect = effect_phrase(cause["effect"], result)
    yield f"{place(cause)}: {effect}. Probability {cause['probability']:.2f}{together}.{closed}"
    yield f"Look at: {look_at(cause, result)}."
    yield f"It shows as: {CATALOGUE[cause['effect']].signature}."
    if cause["equivalent_to"]:
        others = "; ".join(
            f"{effect_phrase(other['effect'], result)} on {place(other)}" for other in cause["equivalent_to"]
        )
        yield f"These logs cannot distinguish it from: {others}."


def _where_section(diagnosis: Diagnosis) -> Section:
    about = (
        "Torque errors are RMS on held-out motion, in % of nominal torque if known."
        if diagnosis.dataset.servos is None
        else "Position errors are RMS on held-out episodes, of the simulator's motion under the recorded command."
    )
    parts = (
        gap_table(diagnosis.result),
        regime_map(diagnosis),
        band_map(diagnosis),
        timeline(diagnosis),
        remainder(diagnosis),
    )
    return Section("Where it is", [*where_sentences(diagnosis.result), about], [part for part in parts if part])


def _closure_section(diagnosis: Diagnosis, simulated: Sequence[Simulated]) -> Section:
    result, robot = diagnosis.result, diagnosis.dataset.robot
    text = []
    if result["closure"] is not None and has_torque_gap(result):
        part = "All" if result["closure"] > 0.995 else f"{100 * result['closure']:.0f} %"
        text.append(f"{part} of the torque gap is closed, counted down to the repeatability.")
    text += [f"Held out: {fold['held_out']}, fitted on {', '.join(fold['fitted_on'])}." for fold in result["folds"]]
    parts: list[Any] = []
    if result.get("waterfall") and diagnosis.released is None:
        words, steps = waterfall(result["waterfall"])
        text.append(words)
        parts.append(steps)
    motion = result["motion_gap"]
    if diagnosis.motion is not None and diagnosis.motion.notable:
        floor = motion["floor"] or [None] * robot.dof
        errors = zip(motion["before"], motion["after"], floor, strict=True)
        rows = [
            (joint, *("-" if error is None else f"{1e3 * error:.3f}" for error in of_joint))
            for joint, of_joint in zip(robot.joint_names, errors, strict=True)
        ]
        text.append("What was executed is not what was planned; torque is judged on the executed motion.")
        parts.append(Table("motion-gap", ("joint", "before [mrad, mm]", "after", "repeatability"), rows))
    figures = simulation_part(diagnosis, simulated)
    if figures is None:
        text.append(
            "No log has set-points without a gap, so nothing was simulated."
            if diagnosis.selected.causes
            else "No effect was found, so there is nothing to compare in forward simulation."
        )
    else:
        (before, after), (q_before, q_after) = (
            (figures[kind]["before"], figures[kind]["after"]) for kind in ("torque", "position")
        )
        rows = [
            (
                joint,
                figure_text(before[k], unit),
                figure_text(after[k], unit),
                f"{1e3 * q_before[k]:.3f}",
                f"{1e3 * q_after[k]:.3f}",
            )
            for k, (joint, unit) in enumerate(zip(robot.joint_names, result["gap"]["units"], strict=True))
        ]
        header = ("joint", "torque, model", "with effects", "position, model [mrad, mm]", "with effects")
        parts += [Table("simulation", header, rows), simulated_torque(diagnosis, simulated)]
        text.append(
            "Forward simulation: the model's arm runs the same set-points behind a servo with the measured delay. It "
            "is compared with the measurement without and with the effects. What remains on every joint is the error "
            "of that servo."
        )
    return Section("How far it shrinks", text, parts)


def _hypotheses_section(diagnosis: Diagnosis) -> Section:
    """The hypotheses that were compared, likeliest first."""
    selected, names = diagnosis.selected, diagnosis.dataset.robot.joint_names
    named = {candidate.key for candidate in selected.causes}
    rivals = {place for several in selected.rivals for place in several}
    rows = []
    for hypothesis in selected.hypotheses[:_MOST_HYPOTHESES]:
        effects = [candidate.text(names) for candidate in hypothesis.effects]
        effects += [f"something else on {names[joint]}" for joint in hypothesis.uncatalogued_joints]
        figures = (
            f"{hypothesis.log_bayes_factor:.1f}",
            f"{hypothesis.probability:.3f}",
            f"{100 * hypothesis.explained_share:.0f} %",
        )
        places = set(hypothesis.effect_keys)
        equal = "as good: these logs do not distinguish it" if len(places) == 1 and places <= rivals else ""
        rows.append((" + ".join(effects) or "no effect", *figures, "named" if named and places == named else equal))
    text = [
        "Every effect is compared with none and with the others by its log Bayes factor. The model may move within its "
        "stored uncertainty, and every arm has a little of everything: only what goes beyond that counts.",
    ]
    header = ("hypothesis", "log Bayes factor", "probability", "explains of the gap", "")
    return Section(HYPOTHESES, text, [Table("hypotheses", header, rows)])


def _testability_section(diagnosis: Diagnosis) -> Section:
    """Effect and reason, with all the joints it holds for in one line."""
    where: dict[tuple[str, str], list[str]] = {}
    for entry in diagnosis.result["not_testable"]:
        where.setdefault((entry["effect"], entry["why"]), []).append(entry["joint"] or "arm")
    rows = [(effect, ", ".join(joints), why) for (effect, why), joints in where.items()]
    text = [
        "An effect stands here where its smallest size that matters would not have been found on these motions. That "
        "it was not named says nothing about it."
        if rows
        else "Every effect of the catalogue would have been found at the smallest size that matters."
    ]
    header = ("effect", "where", "why")
    return Section(
        NOT_TESTABLE, text, ((Table("not-testable", header, rows),) if rows else ()) + (power_map(diagnosis),)
    )
