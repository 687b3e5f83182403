"""The pages of a calibration and of a recalibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import counted
from agent.model import IdentifiedModel
from agent.pages.calibration.comparison import against_last_accepted, comparison_section
from agent.pages.calibration.friction import friction_section
from agent.pages.calibration.loop import ShownLoop, motion_section, search_section
from agent.pages.calibration.parameters import observation_section, parameters_section
from agent.pages.calibration.prediction import error_table
from agent.pages.calibration.recordings import LogHealth, conditions_section, log_section, percent, provenance_section
from agent.pages.calibration.residuals import residual_section
from agent.pages.diagnosis.summary import diagnosis_sections
from agent.pages.elements import About, Page, Section, Table, render
from agent.pages.plots import Plot
from agent.pages.scene import Scene
from agent.recording import Log
from agent.validation import Comparison, Prediction


@dataclass(frozen=True, eq=False, kw_only=True)
class RunContent:
    """What the page of a run is made from.

    Attributes
    ----------
    run : run folder.
    result, about : content of `result.json`, and the first screen.
    predictions, health : of the motions that the model is judged on, and of their logs.
    excitation : the log that the model was fitted to.
    loop : the loop that was run.
    rmse : (motions or cycles, n) [N·m] on moving samples.
    shown : torque of one motion.
    search, validation_paths : of a calibration: how the loop was found, and (motions, k, 3) [m] of the TCP.
    """

    run: Path
    result: dict[str, Any]
    about: About
    predictions: Sequence[Prediction]
    health: Sequence[LogHealth]
    excitation: Log
    loop: ShownLoop
    rmse: np.ndarray
    shown: Plot
    search: Mapping[str, Any] = field(default_factory=dict)
    validation_paths: np.ndarray = field(default_factory=lambda: np.empty((0, 0, 3)))

    @property
    def model(self) -> IdentifiedModel:
        """The identified model of the run."""
        return self.predictions[0].model


def calibration_report(data: RunContent) -> str:
    """HTML text of the report of a calibration."""
    result, model = data.result, data.model
    headline = " ".join([_headline(result), *model.too_little_motion, _current(result)])
    if result["diagnosis"] is not None:
        headline = f"{headline} {result['diagnosis']['summary']}"
    sections = [
        *_verdict_first(data, _validation(data)),
        motion_section(data.loop),
        search_section(data.search),
        residual_section(data.predictions),
        friction_section(data.predictions),
        against_last_accepted(data.run, model, data.excitation),
        observation_section(model, data.excitation),
        log_section([LogHealth.of(data.excitation), *data.health]),
        conditions_section(result["conditions"], result["validation"]["joints"]),
        parameters_section(model.rows(), result["estimation"]["notes"]),
        provenance_section(result),
    ]
    return _page(data, "Calibration", headline, sections)


def recalibration_report(data: RunContent, comparison: Comparison) -> str:
    """HTML text of the report of a recalibration, with its model compared with the last accepted one."""
    result, model, loop = data.result, data.model, data.result["loop"]
    word = "Accepted" if result["accepted"] else f"Rejected: {result['reason']}"
    headline = " ".join([f"{word}.", *model.too_little_motion, _current(result), ""])
    headline += result["diagnosis"]["summary"] if result["diagnosis"] else f"{result['comparison']}."
    search = f"None this time: the stored loop of {loop['created']} was run again, fitness {loop['fitness']:.2f}."
    sections = [
        *_verdict_first(data, _fresh_errors(data)),
        motion_section(data.loop),
        Section("Search", (search,)),
        comparison_section(comparison),
        residual_section(data.predictions),
        friction_section(data.predictions),
        observation_section(model, data.excitation),
        log_section(data.health),
        conditions_section(result["conditions"], result["validation"]["joints"]),
        parameters_section(model.rows()),
        provenance_section(result),
    ]
    return _page(data, "Recalibration", headline, sections)


def _verdict_first(data: RunContent, prediction: Section) -> list[Section | None]:
    """How well the model predicts, and the diagnosis, which comes first if one was needed."""
    sections = diagnosis_sections(data.result["diagnosis"], data.result["reference"])
    return [*sections, prediction] if data.result["diagnosis"] else [prediction, *sections]


def _page(data: RunContent, title: str, headline: str, sections: Sequence[Section | None]) -> str:
    title = f"{title} of {data.result['robot']} {data.result['serial']}".rstrip()
    return render(Page(title, headline, _colour(data.result), sections, data.about))


def _current(result: dict[str, Any]) -> str:
    """Whether the robot's current model is that of this run, or of which other one, when the page was made."""
    current, run = result["current_model"], result["provenance"]["run"]
    if current is None:
        return "The robot has no current model."
    return f"The robot's current model: {'this run' if current == run else f'unchanged (run {current})'}."


def _colour(result: dict[str, Any]) -> str:
    """Of the headline: a run that no gate judged is neither good nor bad, a machine that changed is bad."""
    return "bad" if result["diagnosis"] else {True: "good", False: "bad", None: "plain"}[result["accepted"]]


def _headline(result: dict[str, Any]) -> str:
    validation, gate = result["validation"], result["gate"]
    shares = zip(validation["normalised_rmse"], validation["joints"], strict=True)
    known = [(share, joint) for share, joint in shares if joint not in gate["not_judged"]]
    if not known:
        errors = zip(validation["joints"], validation["rmse"], validation["units"], strict=True)
        return (
            "Not judged: the robot description has no nominal torques. Prediction error on unseen motions in the "
            f"sub-region: {', '.join(f'{error:.3g} {unit} on {joint}' for joint, error, unit in errors)}."
        )
    worst, axis = max(known)
    left_out = ", ".join(gate["not_judged"])
    return (
        f"{'Accepted' if result['accepted'] else 'Rejected'}: the worst axis, {axis}, predicts unseen motions in the "
        f"sub-region to {100 * worst:.2f} % of its nominal torque; the gate is {100 * gate['normalised_rmse']:g} %."
        f"{f' Not judged, without nominal torque: {left_out}.' if left_out else ''}"
    )


def _validation(data: RunContent) -> Section:
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    shares = zip(validation["joints"], validation["normalised_rmse"], strict=True)
    remarks = {name: "above the gate" for name, share in shares if share is None or not share <= gate}
    remarks |= dict.fromkeys(data.result["gate"]["not_judged"], "not judged")
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
    header = ("axis", "RMSE", "unit", "of nominal, moving [%]", "of nominal, all samples [%]", "")
    errors = f"Prediction error on {motions} in the sub-region, per axis (the paper's Fig. 5b)."
    figures, boxes = _errors(data, header, "normalised_rmse_all_samples", remarks, errors)
    typical = "Torque on one unseen motion, the one of median error (the paper's Fig. 6)."
    return Section("Prediction of unseen motions", text, (figures, paths, boxes, replace(data.shown, caption=typical)))


def _fresh_errors(data: RunContent) -> Section:
    result = data.result
    estimated = "friction alone was" if result["parameters"] == "friction" else "all parameters were"
    text = (
        f"The stored loop was run again and {estimated} estimated; the reference is {result['reference']}.",
        "All errors are held out: stretches left out in turn for the new model, the whole motion for the one before. "
        "They count moving samples, over the axis's nominal joint torque. The gate is "
        f"{100 * result['gate']['normalised_rmse']:g} %.",
    )
    header = ("axis", "new model, RMSE", "unit", "new model [%]", "model before [%]", "")
    remarks = dict.fromkeys(result["validation"]["worse_before"], "worse than it was")
    cycles = f"Error of the new model on each of {len(data.rmse)} cycles, per axis; it was fitted to them."
    parts = _errors(data, header, "normalised_rmse_before", remarks, cycles)
    return Section("Prediction", text, (*parts, replace(data.shown, caption="Torque along one cycle of the loop.")))


def _errors(
    data: RunContent, header: Sequence[str], second: str, remarks: Mapping[str, str], caption: str
) -> tuple[Table, Table]:
    """Errors of every axis, with a `second` share of nominal torque and remarks, and as box plots under a caption."""
    validation, gate = data.result["validation"], data.result["gate"]["normalised_rmse"]
    columns = (validation[key] for key in ("joints", "rmse", "normalised_rmse", second))
    rows = [
        (name, f"{rmse:.3g}", unit, percent(share), percent(other), remarks.get(name, ""))
        for name, rmse, share, other, unit in zip(*columns, validation["units"], strict=True)
    ]
    boxes = error_table(data.rmse, data.model.robot.nominal_torque, validation["joints"], gate, caption)
    return Table("validation", header, rows), boxes
