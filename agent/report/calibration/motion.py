"""The loop and its search, as sections of a report; the page of a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.report.page import Page, Section, render
from agent.report.plots import SERIES, Panel, Plot, Series, joint_series
from agent.report.scene import ArmPoses, Scene


@dataclass(frozen=True, eq=False)
class SearchData:
    """How a loop was found: fitness, number of candidates, and over the generations best and mean (G,)."""

    fitness: float
    evaluations: int
    best: np.ndarray
    mean: np.ndarray


@dataclass(frozen=True, eq=False)
class MotionData:
    """A planned loop.

    path (S, 3) of the TCP [m], via_points (K, 3), boxes {name: (min, max)} of sub-region and keep-out; of one cycle
    t (S',) [s], speed (S',) [m/s], limit_use {kind: (S', n)} as fractions, the arm along it. `left` (S,) in
    `left_unit`: the part of the torque on the way that a model leaves, of the worst joint.
    """

    robot: str
    joints: tuple[str, ...]
    description: Sequence[str]
    path: np.ndarray
    via_points: np.ndarray
    boxes: dict[str, tuple[np.ndarray, np.ndarray]]
    t: np.ndarray
    speed: np.ndarray
    programmed_speed: float
    limit_use: dict[str, np.ndarray]
    arm: ArmPoses
    left: np.ndarray | None = None
    left_unit: str = ""


def motion_section(data: MotionData) -> Section:
    """Path, speed, use of the limits."""
    every = slice(None, None, max(1, len(data.path) // 400))
    scene = Scene(
        "path",
        "The arm on its loop with the via-points, base frame (the paper's Fig. 4b)"
        + ("." if data.left is None else "; the loop is coloured by what the model leaves there."),
        lines={"loop": data.path[every]},
        points={"via-points": data.via_points},
        boxes=data.boxes,
        arm=data.arm,
        colouring={} if data.left is None else {"loop": data.left[every]},
        coloured_by=f"left by the model on the worst joint [{data.left_unit}]",
    )
    largest = ", ".join(f"{kind} {100 * values.max():.0f} %" for kind, values in data.limit_use.items())
    text = (*data.description, f"Largest use of a joint's limit: {largest}.")
    wanted = {"as programmed": data.programmed_speed}
    speed = Panel("speed of the tool", "m/s", (Series("speed", data.speed),), marks=wanted, from_zero=True)
    use = [
        Panel(
            f"use of the {kind} limit",
            "%",
            joint_series(data.joints, 100 * values),
            marks={"limit": 100.0},
            from_zero=True,
        )
        for kind, values in data.limit_use.items()
    ]
    plots = (
        Plot("speed", "Speed of the tool along one cycle.", "time", (speed,), data.t, "s", link="cycle"),
        Plot(
            "margins",
            "Use of the limits of the joints along one cycle, in % of each.",
            "time",
            use,
            data.t,
            "s",
            link="cycle",
        ),
    )
    return Section("Motion", text, (scene, *plots))


def search_section(data: SearchData) -> Section:
    """Fitness over the generations."""
    text = (
        f"Fitness {data.fitness:.2f} after {data.evaluations} candidates, each simulated with the interpolator.",
        "Fitness is log10 det(HᵀH/M), with the observation matrix H of M samples. One more means ten times the "
        "information about all parameters together. Compare it only between loops of one robot.",
    )
    series = (Series("best", data.best), Series("mean of the feasible", data.mean, "dashed", SERIES[1]))
    caption = "Fitness, log10 det(HᵀH / M), over the generations; higher is better (the paper's Fig. 4a)."
    panel, generations = Panel("fitness", "", series), np.arange(1.0, len(data.best) + 1)
    return Section("Search", text, (Plot("search-history", caption, "generation", (panel,), generations),))


def plan_report(data: MotionData, search: SearchData, program: str) -> str:
    """HTML text of a plan, before anything moves."""
    headline = f"One cycle takes {data.t[-1]:.1f} s; fitness {search.fitness:.2f}."
    listing = Section("Program", ("What the controller will be sent.",), (), program)
    page = Page(f"Plan for {data.robot}", headline, "plain", (motion_section(data), search_section(search), listing))
    return render(page)
