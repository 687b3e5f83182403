"""The waterfall of a diagnosis; and of a simulator's file the drift in motion, and ranges for training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from agent.diagnosis import Diagnosis, Range, forward_warning, ranges, ranges_text
from agent.report.bars import Bar, lying_bars
from agent.report.figures import Figure
from agent.report.page import Section, Table
from agent.report.phrasing import capital
from agent.report.plots import SERIES


def motion_first(diagnosis: Diagnosis, forward: Mapping[str, Any] | None) -> list[Section]:
    """How far a simulator drifts, before anything of torque, where that was not measured."""
    return [_forward(dict(forward))] if forward and diagnosis.answer.torque_of == "servos" else []


def simulator_sections(diagnosis: Diagnosis, forward: Mapping[str, Any] | None = None) -> list[Section]:
    """Sections of a diagnosis against an MJCF or URDF; none where the model was not such a file."""
    if diagnosis.calibrated is None:
        return []
    result, sections = diagnosis.result, []
    forward = None if motion_first(diagnosis, forward) else forward
    if result.get("waterfall"):
        text, picture, table = waterfall_parts(result["waterfall"])
        sections.append(Section("What the simulator gets wrong", (text,), (picture, table)))
    if forward:
        sections.append(_forward(dict(forward)))
    found = ranges(diagnosis)
    if found:
        sections.append(_ranges(found))
    return sections


def waterfall_parts(steps: Sequence[Mapping[str, Any]]) -> tuple[str, Figure, Table]:
    """What it says, in words, as bars and as a table."""
    rows = [
        (
            entry["step"],
            f"{100 * entry['closes']:.1f} %",
            f"{100 * entry['interval'][0]:.1f} to {100 * entry['interval'][1]:.1f} %",
            "-" if entry["alone"] is None else f"{100 * entry['alone']:.1f} %",
        )
        for entry in steps
    ]
    text = (
        "Share of the gap that each step closes on held-out motion, in addition to the steps before it. The steps and "
        "the rest sum to the whole gap. Alone: what a step closes by itself."
    )
    return text, _picture(steps), Table("waterfall", ("step", "closes", "90 % interval", "alone"), rows)


def _picture(steps: Sequence[Mapping[str, Any]]) -> Figure:
    closes = 100 * np.array([entry["closes"] for entry in steps])
    before = 100 - np.concatenate([[0.0], np.cumsum(closes)[:-1]])
    last = len(steps) - 1
    bars = [
        Bar(k, 0.0 if k == last else left - part, part if k == last else left, SERIES[1] if k == last else SERIES[0])
        for k, (part, left) in enumerate(zip(closes.tolist(), before.tolist(), strict=True))
    ]
    said = [f"{entry['step']}: {part:.3g} % of the gap" for entry, part in zip(steps, closes, strict=True)]
    svg = lying_bars([entry["step"] for entry in steps], said, bars, "% of the gap that remains")
    caption = "Each step removes its bar from the gap; the last bar remains."
    rows = np.column_stack([np.arange(len(steps)), closes, before])
    return Figure("waterfall-picture", caption, svg, ("step", "closes", "before"), rows)


def _forward(forward: dict[str, Any]) -> Section:
    text = [
        f"The simulator runs in {forward['engine']} from {forward['windows']} measured states with the recorded "
        f"{forward['driven_by'].replace('_', '-')}, as given and as corrected by the other motions. The tables show "
        "the RMS error of position [rad or m] and velocity [rad/s or m/s], with its 90 % range on a similar motion.",
    ]
    if warning := forward_warning(forward):
        text.append(f"{capital(warning)}.")
    tables = (
        Table(name, (f"{what}, after", "given", "corrected"), _forward_rows(forward, prefix))
        for name, what, prefix in (("forward", "position", ""), ("forward-velocity", "velocity", "velocity_"))
    )
    return Section("How far it drifts", text, tuple(tables))


def _forward_rows(forward: Mapping[str, Any], prefix: str) -> list[tuple[str, ...]]:
    return [
        (f"{joint}, {seconds:g} s", *(_error(forward, f"{prefix}{side}", h, j) for side in ("before", "after")))
        for j, joint in enumerate(forward["joints"])
        for h, seconds in enumerate(forward["horizon_s"])
    ]


def _error(forward: Mapping[str, Any], column: str, horizon: int, joint: int) -> str:
    low, high = forward[f"{column}_interval"][horizon][joint]
    return f"{forward[column][horizon][joint]:.3g} ({low:.2g} to {high:.2g})"


def _ranges(found: Sequence[Range]) -> Section:
    rows = [
        (f"{entry.of}, {entry.parameter}", f"{entry.value:.4g}", f"{entry.low:.4g} to {entry.high:.4g}", entry.unit)
        for entry in found
    ]
    text = [
        "Remaining uncertainty (90 %) of each corrected parameter: use it as the range for domain randomisation. "
        "Parameters that are not listed keep their value. Link masses are correlated: each can be anywhere in its "
        "range, but not all at once. As YAML below.",
    ]
    table = Table("ranges", ("number", "value", "range", "unit"), rows)
    return Section("For training policies", text, (table,), ranges_text(tuple(found)))
