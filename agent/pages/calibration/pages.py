"""The pages of a calibration and of a recalibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from agent.core import counted
from agent.pages.calibration.comparison import comparison_section
from agent.pages.calibration.friction import friction_section
from agent.pages.calibration.loop import motion_section, search_section
from agent.pages.calibration.parameters import observation_section, parameters_section
from agent.pages.calibration.prediction import error_table
from agent.pages.calibration.recordings import conditions_section, log_section, percent, provenance_section
from agent.pages.calibration.residuals import residual_section
from agent.pages.calibration.sections import RunContent, further_sections
from agent.pages.diagnosis.summary import diagnosis_sections
from agent.pages.page import Page, Section, Table, render
from agent.pages.scene import Scene
from agent.validation import Comparison


def run_report(data: RunContent) -> str:
    """HTML text of the report of a calibration."""
    result = data.result
    headline = f"{_headline(result)} {_current(result)}"
    if result["diagnosis"] is not None:
        headline = f"{headline} {result['diagnosis']['summary']}"
    search = search_section(data.search)
    return _page(data, "Calibration", headline, _validation(data), search, further_sections(data))


def recalibration_report(data: RunContent, comparison: Comparison) -> str:
    """HTML text of the report of a recalibration, with its model compared with the last accepted one."""
    result, loop = data.result, data.result["loop"]
    word = "Accepted" if result["accepted"] else f"Rejected: {result['reason']}"
    headline = f"{word}. {_current(result)} "
    headline += result["diagnosis"]["summary"] if result["diagnosis"] else f"{result['comparison']}."
    search = f"None this time: the stored loop of {loop['created']} was run again, fitness {loop['fitness']:.2f}."
    further = (
        comparison_section(comparison),
        residual_section(data.predictions),
        friction_section(data.predictions),
        observation_section(data.model, data.excitation),
        log_section(data.health),
    )
    return _page(data, "Recalibration", headline, _fresh_errors(data), Section("Search", (search,)), further)


def _page(
    data: RunContent, title: str, headline: str, prediction: Section, search: Section, further: Sequence[Section]
) -> str:
    """HTML text of a run's page; a diagnosis that was needed comes first."""
    result = data.result
    found = diagnosis_sections(result["diagnosis"], result["reference"])
    first = [*found, prediction] if result["diagnosis"] else [prediction, *found]
    sections = [
        *first,
        motion_section(data.loop),
        search,
        *further,
        conditions_section(result["conditions"], result["validation"]["joints"]),
        parameters_section(data.model.rows(), result.get("estimation", {}).get("notes", ())),
        provenance_section(result),
    ]
    title = f"{title} of {result['robot']} {result['serial']}".rstrip()
    return render(Page(title, headline, _colour(result), sections, data.about))


def _current(result: dict[str, Any]) -> str:
    """Whether the robot's current model is that of this run, or of which other one, when the page was made."""
    current, run = result["current_model"], result["provenance"]["run"]
    if current is None:
        return "The robot has no current model."
    return f"The robot's current model: {'this run' if current == run else f'unchanged (run {current})'}."


def _colour(result: dict[str, Any]) -> str:
    """Of the headline: a run that no gate judged is neither good nor bad, a machine that changed is bad."""
    return "bad" if result["diagnosis"] else {True: "good", False: "bad", None: "plain"}[result["accepted"]]


def _units(validation: dict[str, Any]) -> list[str]:
    """Unit of each joint's torque; runs of earlier versions do not say it."""
    return validation.get("units") or ["N·m"] * len(validation["joints"])


def _headline(result: dict[str, Any]) -> str:
    validation, gate = result["validation"], result["gate"]
    shares = zip(validation["normalised_rmse"], validation["joints"], strict=True)
    known = [(share, joint) for share, joint in shares if joint not in gate.get("not_judged", [])]
    if not known:
        errors = zip(validation["joints"], validation["rmse"], _units(validation), strict=True)
        return (
            "Not judged: the robot description has no nominal torques. Prediction error on unseen motions in the "
            f"sub-region: {', '.join(f'{error:.3g} {unit} on {joint}' for joint, error, unit in errors)}."
        )
    worst, axis = max(known)
    left_out = ", ".join(gate.get("not_judged", []))
    return (
        f"{'Accepted' if result['accepted'] else 'Rejected'}: the worst axis, {axis}, predicts unseen motions in the "
        f"sub-region to {100 * worst:.2f} % of its nominal torque; the gate is {100 * gate['normalised_rmse']:g} %."
        f"{f' Not judged, without nominal torque: {left_out}.' if left_out else ''}"
    )


def _validation(data: RunContent) -> Section:
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    not_judged = data.result["gate"].get("not_judged", [])
    columns = (validation[key] for key in ("joints", "rmse", "normalised_rmse", "normalised_rmse_all_samples"))
    rows = []
    for name, rmse, moving, everything, unit in zip(*columns, _units(validation), strict=True):
        judged = "not judged" if name in not_judged else "" if moving <= gate else "above the gate"
        rows.append((name, f"{rmse:.3g}", unit, percent(moving), percent(everything), judged))
    header = ("axis", "RMSE", "unit", "of nominal, moving [%]", "of nominal, all samples [%]", "")
    text = [
        f"{validation['motions']} random motions at {validation['speed']:g} m/s that took no part in the fit.",
        "Normalised: RMSE over the axis's nominal joint torque. Moving samples decide; all samples include standstill.",
    ]
    if data.result["accepted"] is False:
        text.append(
            "A rejected run does not change the current model. The residuals below show the regime with the largest "
            "error. If all regimes are alike, try more cycles, a longer search or faster motion."
        )
    motions = counted(len(data.rmse), "unseen motion")
    paths = Scene(
        "validation-paths",
        f"Paths of {motions} in the sub-region (the paper's Fig. 5a).",
        lines={"validation paths": data.validation_paths},
        boxes=data.loop.boxes,
    )
    errors = f"Prediction error on {motions} in the sub-region, per axis (the paper's Fig. 5b)."
    typical = "Torque on one unseen motion, the one of median error (the paper's Fig. 6)."
    parts = (
        Table("validation", header, rows),
        paths,
        error_table(data.rmse, data.model.robot.nominal_torque, validation["joints"], gate, errors),
        replace(data.shown, caption=typical),
    )
    return Section("Prediction of unseen motions", text, parts)


def _fresh_errors(data: RunContent) -> Section:
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    columns = (validation[key] for key in ("joints", "rmse", "normalised_rmse", "normalised_rmse_before"))
    rows = []
    for name, rmse, after, before, unit in zip(*columns, _units(validation), strict=True):
        worse = "worse than it was" if name in validation["worse_before"] else ""
        rows.append((name, f"{rmse:.3g}", unit, percent(after), percent(before), worse))
    estimated = "friction alone was" if data.result["parameters"] == "friction" else "all parameters were"
    text = (
        f"The stored loop was run again and {estimated} estimated; the reference is {data.result['reference']}.",
        "All errors are held out: stretches left out in turn for the new model, the whole motion for the one before. "
        f"They count moving samples, over the axis's nominal joint torque. The gate is {100 * gate:g} %.",
    )
    header = ("axis", "new model, RMSE", "unit", "new model [%]", "model before [%]", "")
    cycles = f"Error of the new model on each of {len(data.rmse)} cycles, per axis; it was fitted to them."
    parts = (
        Table("validation", header, rows),
        error_table(data.rmse, data.model.robot.nominal_torque, validation["joints"], gate, cycles),
        replace(data.shown, caption="Torque along one cycle of the loop."),
    )
    return Section("Prediction", text, parts)
