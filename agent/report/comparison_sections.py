"""Parameters against the last accepted run, and what their change does to predicted torque."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.report.bars import standing_bars
from agent.report.common_sections import percent
from agent.report.figures import Figure
from agent.report.page import Section, Table
from agent.report.plots import SERIES

if TYPE_CHECKING:
    from agent.validation import Comparison


_SHOWN = 30.0


def comparison_section(
    comparison: Comparison, title: str = "Against the last accepted run", number: int = 0
) -> Section:
    """Table of all parameters with their change in standard deviations, and the torque that it makes.

    `number` tells several on one page apart.
    """
    suffix = f"-{number + 1}" if number else ""
    moved = [change for change in comparison.parameters if change.moved]
    text = [
        f"{comparison.before} against {comparison.after}: {len(moved)} of {len(comparison.parameters)} parameters "
        "moved by more than their uncertainty (3.3 standard deviations of a change, one in a thousand by chance).",
        f"Torque is compared along {comparison.torque.motion}.",
    ]
    for which, names in (("before", comparison.only_before), ("after", comparison.only_after)):
        if names:
            text.append(f"Only {which}: {', '.join(names)}.")
    rows = [
        (
            change.name,
            f"{change.before:.5g}",
            f"{change.after:.5g}",
            change.unit,
            f"{change.standard_deviation:.2g}",
            f"{change.deviations:+.1f}",
            "moved" if change.moved else "",
        )
        for change in sorted(comparison.parameters, key=lambda change: -abs(change.deviations))
    ]
    header = ("parameter", "before", "after", "unit", "std. dev. of a change", "change [deviations]", "")
    torque = [
        (
            joint,
            f"{comparison.torque.rmse[k]:.3g}",
            percent(comparison.torque.normalised_rmse[k]),
            f"{comparison.torque.largest[k]:.3g}",
            f"{comparison.torque.standard_deviation[k]:.2g}",
        )
        for k, joint in enumerate(comparison.torque.joints)
    ]
    torque_header = ("axis", "RMS [N·m]", "of nominal [%]", "largest [N·m]", "uncertainty explains [N·m]")
    parts = (
        Table(f"torque-change{suffix}", torque_header, torque),
        changes_figure(comparison, f"changes{suffix}"),
        Table(f"parameter-changes{suffix}", header, rows),
    )
    return Section(title, text, parts)


def changes_figure(comparison: Comparison, name: str = "changes") -> Figure:
    """Change of every parameter in standard deviations of a change."""
    from agent.validation import BEYOND

    changes = comparison.parameters
    values = np.array([change.deviations for change in changes])
    shown = np.clip(values, -_SHOWN, _SHOWN)
    svg = standing_bars(
        [change.name for change in changes],
        [
            f"{c.name}: {c.before:.4g} before, {c.after:.4g} {c.unit} after, {c.deviations:+.1f} standard deviations"
            for c in changes
        ],
        shown,
        [SERIES[3] if change.moved else SERIES[0] for change in changes],
        "change [std. deviations]",
        1.1 * max(5.0, float(np.abs(shown).max(initial=0.0))),
        (BEYOND, -BEYOND),
    )
    rows = np.column_stack([[c.before for c in changes], [c.after for c in changes], values])
    caption = "Change of each parameter in standard deviations, cut at 30. Beyond the dots, it is no chance."
    return Figure(name, caption, svg, ("before", "after", "deviations"), rows)
