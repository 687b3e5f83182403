"""Section on a simulator's own motion: measured and simulated positions, and the numbers to copy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from agent.core import plus_minus
from agent.diagnosis import Diagnosis
from agent.pages.elements import Section, Table
from agent.pages.plots import DASHES, SERIES, Panel, Plot, Series

_SCALE = {
    "gravity": "Gravity of the file's masses sets the scale of these numbers.",
    "kp": "The kp of the file, which is said to be right, sets the scale of these numbers.",
    "none": "Nothing sets the scale: positions tell ratios to kp only.",
}
#: Titles of numbers over kp, by kind.
RATIO_TITLES = {"damping": "damping / kp [s]", "armature": "armature / kp [s²]", "friction": "friction / kp [rad]"}


def motion_section(diagnosis: Diagnosis, result: Mapping[str, Any]) -> Section | None:
    """Measured and simulated motion of each joint before and after; None where torque was judged."""
    dataset, gap = diagnosis.dataset, result["gap"]
    if dataset.servos is None or not result.get("servo"):
        return None
    rows = [
        (joint, *(_angle(value, unit) for value in (before, after)))
        for joint, unit, before, after in zip(gap["joints"], gap["units"], gap["before"], gap["after"], strict=True)
    ]
    errors = Table("motion-error", ("joint", "error as given", "corrected, held out"), rows)
    kinds = list(result["servo"])
    numbers = [
        (joint, *(_number(kind, result["servo"][kind][k]) for kind in kinds)) for k, joint in enumerate(gap["joints"])
    ]
    header = (
        "joint",
        "kp [N·m/rad]",
        "damping with kv",
        "armature [kg·m²]",
        "friction [N·m]",
        "delay [ms]",
        "offset [mrad or mm]",
    )
    table = Table("servo-numbers", header, numbers)
    text = [
        "The simulator ran under the recorded command; these are the positions that it reached and that were measured.",
        _SCALE[result["scale_from"]],
    ]
    tables = [table]
    if over_kp := result.get("servo_over_kp"):
        text.append(
            "Class only: positions tell the joint's friction, damping and armature over its kp, not each alone. With "
            "any kp and these ratios to it, the simulator moves as the arm does."
        )
        ratios = [
            (joint, *(_number(kind, row[k]) for kind, row in over_kp.items())) for k, joint in enumerate(gap["joints"])
        ]
        tables.append(Table("servo-ratios", ("joint", *(RATIO_TITLES[kind] for kind in over_kp)), ratios))
    return Section("The simulator's motion", text, [errors, _motions(diagnosis), *tables])


def _motions(diagnosis: Diagnosis) -> Plot:
    """Positions of each joint in the last log: measured, as given, and corrected."""
    dataset, names = diagnosis.dataset, diagnosis.dataset.robot.joint_names
    rows_of_log = np.flatnonzero(dataset.log == dataset.log.max())
    time = dataset.time[rows_of_log]
    log = dataset.logs[int(dataset.log.max())]
    panels = []
    for k, name in enumerate(names):
        slides = dataset.robot.joints[k].prismatic
        scale, unit = (1e3, "mm") if slides else (180 / np.pi, "°")
        measured = np.interp(time, log.t, log.position[:, k])
        series = (
            Series("measured", scale * measured, colour=SERIES[2]),
            Series("as given", scale * (measured - dataset.residual[rows_of_log, k]), "dashed", SERIES[1]),
            Series(
                "corrected",
                scale * (measured - diagnosis.gap.error_after[rows_of_log, k]),
                colour=SERIES[0],
                dash=DASHES[2],
            ),
        )
        panels.append(Panel(name, unit, series, time, joint=name))
    caption = f"Measured and simulated motion of each joint in {log.name}, which the correction was not fitted to."
    return Plot("motions", caption, "time", tuple(panels), x_unit="s", columns=2)


def _angle(value: float, unit: str) -> str:
    return f"{np.degrees(value):.3f}°" if unit == "rad" else f"{1e3 * value:.3f} mm"


def _number(kind: str, entry: Any) -> str:
    if entry is None:
        return "class only"
    scale = 1e3 if kind in ("delay_s", "offset") else 1.0
    return plus_minus(scale * entry[0], scale * (entry[2] - entry[1]) / 2)
