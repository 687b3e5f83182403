"""Sections of a diagnosis against a simulator's file: its errors step by step, its drift, and ranges for training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agent.diagnosis import Diagnosis, Range, forward_warning, ranges, ranges_text
from agent.report.diagnosis.figures import waterfall
from agent.report.page import Section, Table
from agent.report.phrasing import capital


def simulator_sections(diagnosis: Diagnosis, forward: Mapping[str, Any] | None) -> list[Section]:
    """Sections of a diagnosis against an MJCF or URDF; none if the model was not such a file."""
    if diagnosis.released is None:
        return []
    sections = []
    if diagnosis.result.get("waterfall"):
        text, table = waterfall(diagnosis.result["waterfall"])
        sections.append(Section("What the simulator gets wrong", (text,), (table,)))
    if forward:
        sections.append(drift_section(forward))
    if found := ranges(diagnosis):
        sections.append(_ranges_section(found))
    return sections


def _ranges_section(found: Sequence[Range]) -> Section:
    """Ranges of the corrected parameters for training."""
    rows = [
        (f"{one.of}, {one.parameter}", f"{one.value:.4g}", f"{one.low:.4g} to {one.high:.4g}", one.unit)
        for one in found
    ]
    text = (
        "Remaining uncertainty (90 %) of each corrected parameter: use it as the range for domain randomisation. "
        "Parameters that are not listed keep their value. Link masses are correlated: each can be anywhere in its "
        "range, but not all at once. As YAML below.",
    )
    table = Table("ranges", ("number", "value", "range", "unit"), rows)
    return Section("For training policies", text, (table,), ranges_text(tuple(found)))


def drift_section(forward: Mapping[str, Any]) -> Section:
    """Section on the drift of the simulator from the measured motion."""
    text = [
        f"The simulator runs in {forward['engine']} from {forward['windows']} measured states with the recorded "
        f"{forward['driven_by'].replace('_', '-')}, as given and as corrected by the other motions. The tables show "
        "the RMS error of position [rad or m] and velocity [rad/s or m/s], with its 90 % range on a similar motion.",
    ]
    if warning := forward_warning(dict(forward)):
        text.append(f"{capital(warning)}.")
    tables = []
    for name, what, prefix in (("forward", "position", ""), ("forward-velocity", "velocity", "velocity_")):
        sides = [f"{prefix}{side}" for side in ("before", "after")]
        rows = [
            (f"{joint}, {seconds:g} s", *(_error(forward, side, h, j) for side in sides))
            for j, joint in enumerate(forward["joints"])
            for h, seconds in enumerate(forward["horizon_s"])
        ]
        tables.append(Table(name, (f"{what}, after", "given", "corrected"), rows))
    return Section("How far it drifts", text, tables)


def _error(forward: Mapping[str, Any], column: str, horizon: int, joint: int) -> str:
    low, high = forward[f"{column}_interval"][horizon][joint]
    return f"{forward[column][horizon][joint]:.3g} ({low:.2g} to {high:.2g})"
