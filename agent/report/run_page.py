"""The report of a run: what all have, and what a calibration has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.core import counted
from agent.report.common_sections import (
    conditions_section,
    current_sentence,
    diagnosis_part,
    joint_units,
    parameters_section,
    percent,
    provenance_section,
)
from agent.report.figures import motion_box_plot
from agent.report.motion_sections import MotionData, SearchData, motion_section, search_section
from agent.report.page import About, Page, Section, Table, render
from agent.report.rounds_section import rounds_sections
from agent.report.scene import Scene
from agent.report.torque_section import TorqueData, torque_plot


@dataclass(frozen=True, eq=False)
class RunData:
    """What the report of a run shows.

    result: the content of `result.json`; about: the first screen; parameter_rows: the table of the model, header first;
    rmse (motions or cycles, n) [N·m] on moving samples; nominal (n,) torque of the joints, NaN where there is none;
    `prediction` of one motion; `further` sections made elsewhere, in order; `search`, where there was one;
    `validation_paths` (motions, k, 3) [m] of the TCP on the unseen motions.
    """

    result: dict[str, Any]
    about: About
    motion: MotionData
    parameter_rows: Sequence[Sequence[str]]
    rmse: np.ndarray
    nominal: np.ndarray
    prediction: TorqueData
    further: Sequence[Section] = ()
    search: SearchData | None = None
    validation_paths: np.ndarray | None = None


def render_run(data: RunData, title: str, headline: str, prediction: Section, search: Section) -> str:
    """HTML text of a run's page: a diagnosis first, then prediction, motion, search and the rest."""
    result = data.result
    diagnosis = result["diagnosis"]
    sections = [
        prediction,
        motion_section(data.motion),
        search,
        *data.further,
        conditions_section(result["conditions"], result["validation"]["joints"]),
        parameters_section(data.parameter_rows, result.get("estimation", {}).get("notes", ())),
        provenance_section(result),
    ]
    found = (diagnosis or {}).get("result") or {}
    parts = [diagnosis_part(diagnosis, result["reference"])]
    parts += rounds_sections(found.get("rounds"), found.get("rounds_end", ""))
    sections[0 if diagnosis else 1 : 0 if diagnosis else 1] = parts
    title = f"{title} of {result['robot']} {result['serial']}".rstrip()
    return render(Page(title, headline, _colour(result), sections, data.about))


def run_report(data: RunData) -> str:
    """HTML text of the report of a calibration."""
    result = data.result
    headline = f"{_headline(result)} {current_sentence(result)}"
    if result["diagnosis"] is not None:
        headline = f"{headline} {result['diagnosis']['summary']}"
    assert data.search is not None
    return render_run(data, "Calibration", headline, _validation(data), search_section(data.search))


def _colour(result: dict[str, Any]) -> str:
    """Of the headline: what nobody judged is neither good nor bad, what changed is bad."""
    return "bad" if result["diagnosis"] else {True: "good", False: "bad", None: "plain"}[result["accepted"]]


def _headline(result: dict[str, Any]) -> str:
    validation, gate = result["validation"], result["gate"]
    shares = zip(validation["normalised_rmse"], validation["joints"], strict=True)
    known = [(share, joint) for share, joint in shares if joint not in gate.get("not_judged", [])]
    if not known:
        errors = zip(validation["joints"], validation["rmse"], joint_units(validation), strict=True)
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


def _validation(data: RunData) -> Section:
    assert data.validation_paths is not None
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    names, not_judged = tuple(validation["joints"]), data.result["gate"].get("not_judged", [])
    rows = [
        (
            name,
            f"{rmse:.3g}",
            unit,
            percent(moving),
            percent(everything),
            "not judged" if name in not_judged else "" if moving <= gate else "above the gate",
        )
        for name, rmse, unit, moving, everything in zip(
            names,
            validation["rmse"],
            joint_units(validation),
            validation["normalised_rmse"],
            validation["normalised_rmse_all_samples"],
            strict=True,
        )
    ]
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
    parts = (
        Table("validation", header, rows),
        Scene(
            "validation-paths",
            f"Paths of {counted(len(data.rmse), 'unseen motion')} in the sub-region (the paper's Fig. 5a).",
            lines={"validation paths": data.validation_paths},
            boxes=data.motion.boxes,
        ),
        motion_box_plot(
            data.rmse,
            data.nominal,
            names,
            gate,
            f"Prediction error on {counted(len(data.rmse), 'unseen motion')} in the sub-region, per axis (the paper's "
            "Fig. 5b).",
        ),
        torque_plot(data.prediction, "Torque on one unseen motion, the one of median error (the paper's Fig. 6)."),
    )
    return Section("Prediction of unseen motions", text, parts)
