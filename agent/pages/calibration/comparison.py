"""Runs next to each other: parameters and whether they changed by more than chance, torque, friction, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agent.core import NORMAL_95, plus_minus
from agent.model import IdentifiedModel
from agent.pages.calibration.friction import compared_friction
from agent.pages.calibration.recordings import percent
from agent.pages.calibration.residuals import regime_table
from agent.pages.elements import About, Bar, Bars, NextStep, Page, Section, Table, render
from agent.pages.plots import SERIES
from agent.recording import Log
from agent.runs import last_accepted
from agent.validation import BEYOND, Comparison, Prediction, compare_models

_SHOWN = 30.0  # standard deviations at which a bar is cut


def comparison_section(
    comparison: Comparison, title: str = "Against the last accepted run", number: int = 0
) -> Section:
    """Table of all parameters with their change in standard deviations, and the torque that it makes.

    `number` distinguishes several on one page.
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
    rows: list[tuple[str | Bars, ...]] = []
    for change in sorted(comparison.parameters, key=lambda change: -abs(change.deviations)):
        size = float(np.clip(change.deviations, -_SHOWN, _SHOWN))
        bar = Bars(
            [Bar(0.0, size, SERIES[3] if change.moved else SERIES[0])], [(s * BEYOND, "#808890") for s in (1, -1)]
        )
        figures = (f"{change.before:.5g}", f"{change.after:.5g}", change.unit, f"{change.standard_deviation:.2g}")
        rows.append((change.name, *figures, f"{change.deviations:+.1f}", bar, "moved" if change.moved else ""))
    beyond = f"cut at {_SHOWN:g}; strokes: {BEYOND:g}"
    header = ("parameter", "before", "after", "unit", "std. dev. of a change", "change [deviations]", beyond, "")
    torque = comparison.torque
    torque_rows = [
        (joint, f"{rmse:.3g}", percent(share), f"{largest:.3g}", f"{deviation:.2g}")
        for joint, rmse, share, largest, deviation in zip(
            torque.joints, torque.rmse, torque.normalised_rmse, torque.largest, torque.standard_deviation, strict=True
        )
    ]
    torque_header = ("axis", "RMS [N·m]", "of nominal [%]", "largest [N·m]", "uncertainty explains [N·m]")
    parts = (
        Table(f"torque-change{suffix}", torque_header, torque_rows),
        Table(f"parameter-changes{suffix}", header, rows),
    )
    return Section(title, text, parts)


def against_last_accepted(run: Path, model: IdentifiedModel, excitation: Log) -> Section | None:
    """Comparison with the last accepted run of the same machine and loop; None if there is none."""
    last = last_accepted(run)
    if last is None:
        return None
    before = IdentifiedModel.load(last / "model.json")
    return comparison_section(compare_models(before, model, excitation, last.name, run.name))


def comparison_page(
    models: dict[str, IdentifiedModel], comparisons: Sequence[Comparison], predictions: Sequence[Prediction]
) -> str:
    """HTML text: of runs by name, each later one compared with the first; `predictions` of one motion, a run each.

    Args:
        models: by name of their runs.
        comparisons: each with the first.
        predictions: of one motion, one per run.
    """
    names, robot = list(models), predictions[0].model.robot
    last = comparisons[-1]
    moved = sorted((c for c in last.parameters if c.moved), key=lambda c: -abs(c.deviations))
    headline = f"None of {len(last.parameters)} parameters changed by more than chance."
    if moved:
        largest = ", ".join(
            f"{c.name} by {plus_minus(c.after - c.before, NORMAL_95 * c.standard_deviation)} {c.unit}"
            for c in moved[:3]
        )
        headline = (
            f"{len(moved)} of {len(last.parameters)} parameters changed by more than chance: most of all {largest}."
        )
    shares = last.torque.normalised_rmse
    if np.isfinite(shares).any():
        worst = int(np.nanargmax(shares))
        headline += (
            f" Predicted torque differs most on {last.torque.joints[worst]}: {100 * shares[worst]:.2f} % of nominal."
        )
    others = next((comparison.between_machines for comparison in reversed(comparisons) if comparison.machines), "")
    about = About(
        "How do these machines differ?" if others else "What changed between these runs, and is it more than chance?",
        (),
        [] if others else [NextStep("make the latest of them the current model:", f"agent apply {names[-1]}")],
        [("robot", robot.name), ("runs", ", ".join(names)), ("motion", last.torque.motion)],
    )
    residuals = [
        regime_table([prediction], f"residuals-{name}", f"{name}: RMSE by joint and regime.")
        for name, prediction in zip(names, predictions, strict=True)
    ]
    one_motion = f"Error of each model on {last.torque.motion}, by joint and regime."
    sections = [
        *(
            comparison_section(comparison, f"{comparison.after} against {comparison.before}", k)
            for k, comparison in enumerate(comparisons)
        ),
        Section("Friction curves", (), (compared_friction(models),)),
        Section("Residuals on one motion", (one_motion,), residuals),
        Section("Parameters side by side", ("With 95 % intervals.",), (_parameters(models),)),
    ]
    title = f"{robot.name}: {', '.join(names[:-1])} and {names[-1]}"
    return render(Page(title, f"{others} {headline}".lstrip(), "bad" if moved else "good", sections, about))


def _parameters(models: dict[str, IdentifiedModel]) -> Table:
    """The values of the models by name, with their 95 % intervals."""
    units = {row[0]: row[4] for model in models.values() for row in model.rows()[1:]}
    values = {name: dict.fromkeys(models, "-") for name in units}
    for run, model in models.items():
        for name, value, deviation in zip(model.names, model.values, model.standard_deviations, strict=True):
            values[name][run] = plus_minus(value, NORMAL_95 * deviation)
    rows = [(name, unit, *values[name].values()) for name, unit in units.items()]
    return Table("parameters", ("parameter", "unit", *models), rows)
