"""The loop and its search, as sections of a report; the page of a plan."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.motion import Trajectory
from agent.pages.elements import About, NextStep, Page, Section, render
from agent.pages.plots import SERIES, Panel, Plot, Series, joint_series
from agent.pages.scene import Scene, arm_along
from agent.recipe import Recipe
from agent.robot import position_ranges

#: Only each fifth sample of a cycle is shown over time.
_EVERY = 5


@dataclass(frozen=True, eq=False)
class ShownLoop:
    """One `cycle` of a recipe's loop through via_points (K, 3) [m], to be run `cycles` times.

    `left` (S,) in `left_unit`: the part of the torque on the way that a model leaves, of the worst joint.
    """

    recipe: Recipe
    cycle: Trajectory
    via_points: np.ndarray
    cycles: int
    left: np.ndarray | None = None
    left_unit: str = ""

    @property
    def duration(self) -> float:
        """[s], to the last sample that is shown."""
        return float(self.cycle.t[::_EVERY][-1])

    @property
    def description(self) -> str:
        """One sentence."""
        motion, cycle = self.recipe.motion, self.cycle
        binding = sorted({limit.limit for limit in cycle.binding})
        slowed = f"; slowed down by {', '.join(binding)}" if binding else ""
        return (
            f"{len(self.via_points)} via-points, {cycle.duration:.1f} s a cycle, {self.cycles} cycles at "
            f"{motion.speed:g} m/s, {motion.settings.blend}{slowed}."
        )

    @property
    def limit_use(self) -> dict[str, np.ndarray]:
        """{kind: (S', n)} share of each joint limit that is used."""
        robot, cycle = self.recipe.robot, self.cycle
        lower, upper = position_ranges(robot, self.recipe.cell.joint_ranges)
        bounded = np.isfinite(lower) & np.isfinite(upper)
        centre, half = np.zeros(robot.dof), np.full(robot.dof, np.inf)
        centre[bounded], half[bounded] = (lower + upper)[bounded] / 2, (upper - lower)[bounded] / 2
        return {
            "position": np.abs(cycle.q - centre)[::_EVERY] / half,
            "speed": np.abs(cycle.qd)[::_EVERY] / robot.max_velocity,
            "acceleration": np.abs(cycle.qdd)[::_EVERY] / robot.max_acceleration,
        }

    @property
    def boxes(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Opposite corners of the regions for via-points and of the keep-out boxes."""
        via, keep_out = self.recipe.motion.via_points, self.recipe.cell.keep_out
        boxes = {f"keep-out: {box.name}": (np.array(box.minimum), np.array(box.maximum)) for box in keep_out}
        points = [(np.array(point.pose[:3]), np.array(point.range[:3])) for point in via.points or ()]
        regions = {f"region {number}": point for number, point in enumerate(points, 1)}
        if via.box is not None:
            regions["sub-region"] = (np.array(via.box.centre), np.array(via.box.size) / 2)
        return boxes | {name: (middle - spread, middle + spread) for name, (middle, spread) in regions.items()}


def motion_section(loop: ShownLoop) -> Section:
    """Path, speed, use of the limits."""
    recipe, cycle, use = loop.recipe, loop.cycle, loop.limit_use
    path, t = cycle.tcp[:, :3, 3], cycle.t[::_EVERY]
    every = slice(None, None, max(1, len(path) // 400))
    scene = Scene(
        "path",
        "The arm on its loop with the via-points, base frame (the paper's Fig. 4b)"
        + ("." if loop.left is None else "; the loop is coloured by what the model leaves there."),
        lines={"loop": path[every]},
        points={"via-points": loop.via_points},
        boxes=loop.boxes,
        arm=arm_along(recipe.robot, cycle.t, cycle.q, None if recipe.tool is None else recipe.tool.frame),
        colouring={} if loop.left is None else {"loop": loop.left[every]},
        coloured_by=f"left by the model on the worst joint [{loop.left_unit}]",
    )
    largest = ", ".join(f"{kind} {100 * values.max():.0f} %" for kind, values in use.items())
    text = (loop.description, f"Largest use of a joint's limit: {largest}.")
    wanted = {"as programmed": recipe.motion.speed}
    tool = Series("speed", cycle.path_speed[::_EVERY])
    speed = Panel("speed of the tool", "m/s", (tool,), marks=wanted, from_zero=True)
    shares = {kind: joint_series(recipe.robot.joint_names, 100 * values) for kind, values in use.items()}
    limit = {"limit": 100.0}
    margins = [
        Panel(f"use of the {kind} limit", "%", share, marks=limit, from_zero=True) for kind, share in shares.items()
    ]
    caption = "Use of the limits of the joints along one cycle, in % of each."
    plots = (
        Plot("speed", "Speed of the tool along one cycle.", "time", (speed,), t, "s", link="cycle"),
        Plot("margins", caption, "time", margins, t, "s", link="cycle"),
    )
    return Section("Motion", text, (scene, *plots))


def search_section(search: Mapping[str, Any]) -> Section:
    """Fitness over the generations, of a search as `plan.json` has it."""
    best, mean = (np.array(search["history"][key], dtype=float) for key in ("best", "mean"))
    text = (
        f"Fitness {search['fitness']:.2f} after {search['evaluated']} candidates, simulated with the interpolator.",
        "Fitness is log10 det(HᵀH/M), with the observation matrix H of M samples. One more means ten times the "
        "information about all parameters together. Compare it only between loops of one robot.",
    )
    series = (Series("best", best), Series("mean of the feasible", mean, "dashed", SERIES[1]))
    caption = "Fitness, log10 det(HᵀH / M), over the generations; higher is better (the paper's Fig. 4a)."
    panel, generations = Panel("fitness", "", series), np.arange(1.0, len(best) + 1)
    return Section("Search", text, (Plot("search-history", caption, "generation", (panel,), generations),))


def plan_report(loop: ShownLoop, search: Mapping[str, Any], program: str) -> str:
    """HTML text of a plan, before anything moves.

    Args:
        loop: motion to be shown.
        search: how it was found.
        program: its text.
    """
    recipe, largest = loop.recipe, max(100 * float(values.max()) for values in loop.limit_use.values())
    headline = f"The motion keeps all limits. One cycle takes {loop.duration:.1f} s."
    facts = [
        ("limits", f"at most {largest:.0f} % of any joint's position, speed or acceleration limit"),
        ("fitness", f"{search['fitness']:.2f}, log10 det(HᵀH/M); higher is better"),
    ]
    command = f"agent calibrate {shlex.quote(str(recipe.path))}"
    steps = [NextStep("watch the arm below; if its way is clear, run the whole job (the arm moves):", command)]
    listing = Section("Program", ("What the controller will be sent.",), (), program)
    sections = (motion_section(loop), search_section(search), listing)
    about = About("What will the arm do?", facts, steps)
    return render(Page(f"Plan for {recipe.robot.name}", headline, "plain", sections, about))
