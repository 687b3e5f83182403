"""Runs side by side: what changed and whether that is more than chance, friction curves over each other, residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from agent.core import plus_minus
from agent.report.comparison_sections import comparison_section
from agent.report.friction_curves import friction_curve, speed_unit
from agent.report.page import About, NextStep, Page, Section, Table, render
from agent.report.plots import SERIES, UNLINKED, Panel, Plot, Series
from agent.report.residual_sections import heat_map, residual_map
from agent.robot import torque_units

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.validation import Comparison, Prediction

_GRID = 121


def comparison_page(
    models: dict[str, IdentifiedModel], comparisons: Sequence[Comparison], predictions: Sequence[Prediction]
) -> str:
    """HTML text: of runs by name, each later one compared with the first; `predictions` of one motion, a run each."""
    names, robot = list(models), predictions[0].model.robot
    last = comparisons[-1]
    moved = sorted((c for c in last.parameters if c.moved), key=lambda c: -abs(c.deviations))
    if moved:
        largest = ", ".join(
            f"{c.name} by {plus_minus(c.after - c.before, 1.96 * c.standard_deviation)} {c.unit}" for c in moved[:3]
        )
        headline = (
            f"{len(moved)} of {len(last.parameters)} parameters changed by more than chance: most of all {largest}."
        )
    else:
        headline = f"None of {len(last.parameters)} parameters changed by more than chance."
    shares = last.torque.normalised_rmse
    if np.isfinite(shares).any():
        worst = int(np.nanargmax(shares))
        headline += (
            f" Predicted torque differs most on {last.torque.joints[worst]}: {100 * shares[worst]:.2f} % of nominal."
        )
    title = f"{robot.name}: {', '.join(names[:-1])} and {names[-1]}"
    others = next((one.between_machines for one in reversed(comparisons) if one.machines), "")
    headline = f"{others} {headline}".lstrip()
    about = About(
        "How do these machines differ?" if others else "What changed between these runs, and is it more than chance?",
        (),
        [] if others else [NextStep("make the latest of them the current model:", f"agent apply {names[-1]}")],
        [("robot", robot.name), ("runs", ", ".join(names)), ("motion", last.torque.motion)],
    )
    sections = [
        *(
            comparison_section(one, f"{one.after} against {one.before}", number)
            for number, one in enumerate(comparisons)
        ),
        Section("Friction curves", (), (_friction(models),)),
        Section(
            "Residuals on one motion",
            (f"Error of each model on {last.torque.motion}, by joint and regime.",),
            [
                heat_map(residual_map([one]), one, f"residuals-{name}", f"{name}: RMSE by joint and regime.")
                for name, one in zip(names, predictions, strict=True)
            ],
        ),
        Section("Parameters side by side", ("With 95 % intervals.",), (_parameters(models),)),
    ]
    return render(Page(title, headline, "bad" if moved else "good", sections, about))


def _friction(models: dict[str, IdentifiedModel]) -> Plot:
    robot = next(iter(models.values())).robot
    panels = []
    for axle, joint in enumerate(robot.joint_names):
        x = robot.max_velocity[axle] * np.linspace(-1, 1, _GRID)
        series: list[Series] = []
        for k, (name, model) in enumerate(models.items()):
            curve, half = friction_curve(model, axle, x)
            colour = SERIES[k % len(SERIES)]
            series.append(Series(f"{name}, 95 % band", curve + half, colour=colour, low=curve - half))
            series.append(Series(name, curve, colour=colour))
        panels.append(Panel(joint, torque_units(robot)[axle], series, x, joint=joint))
    caption = "Friction of each axle over its speed, as each run has it."
    return Plot("friction-curves", caption, "speed", panels, x_unit=speed_unit(robot), link=UNLINKED, columns=2)


def _parameters(models: dict[str, IdentifiedModel]) -> Table:
    found = [
        {n: (v, s) for n, v, s in zip(model.names, model.values, model.standard_deviations, strict=True)}
        for model in models.values()
    ]
    units = {row[0]: row[4] for model in models.values() for row in model.rows()[1:]}
    rows = [
        (name, unit, *(plus_minus(of[name][0], 1.96 * of[name][1]) if name in of else "-" for of in found))
        for name, unit in units.items()
    ]
    return Table("parameters", ("parameter", "unit", *models), rows)
