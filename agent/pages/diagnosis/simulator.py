"""Sections of a diagnosis against an MJCF or URDF: its errors step by step, its drift, and ranges for training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agent.diagnosis import Diagnosis, Range, forward_warning, ranges_text
from agent.pages.diagnosis.figures import waterfall
from agent.pages.elements import Section, Table
from agent.pages.phrasing import capital


def waterfall_section(diagnosis: Diagnosis) -> Section | None:
    """What each corrected number closes of the gap."""
    if diagnosis.released is None or not diagnosis.result.get("waterfall"):
        return None
    text, table = waterfall(diagnosis.result["waterfall"])
    return Section("What the simulator gets wrong", (text,), (table,))


def ranges_section(result: Mapping[str, Any]) -> Section | None:
    """Ranges of the corrected parameters for training."""
    intervals = tuple(Range(**interval) for interval in result.get("ranges", ()))
    if not intervals:
        return None
    rows = [
        (
            f"{interval.of}, {interval.parameter}",
            f"{interval.value:.4g}",
            f"{interval.low:.4g} to {interval.high:.4g}",
            interval.unit,
        )
        for interval in intervals
    ]
    text = (
        "Remaining uncertainty (90 %) of each corrected parameter: use it as the range for domain randomisation. "
        "Parameters that are not listed keep their value. Link masses are correlated: each can be anywhere in its "
        "range, but not all at once. As YAML below.",
    )
    table = Table("ranges", ("number", "value", "range", "unit"), rows)
    return Section("For training policies", text, (table,), ranges_text(intervals))


def drift_section(forward: Mapping[str, Any] | None) -> Section | None:
    """Drift of the simulator from the measured motion; None if it was not run forward."""
    if not forward:
        return None
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
