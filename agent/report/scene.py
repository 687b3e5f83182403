"""A 3-D view: the loop, the boxes around it and the arm that runs it, coloured by what the model leaves."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agent.core import csv_text
from agent.report.plots import SERIES, packed

_TURN, _TILT = -0.9, 0.45  # rad, as in assets/scene.js
_EDGES = ((0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 4), (1, 5), (2, 6), (3, 7))


@dataclass(frozen=True, eq=False)
class ArmPoses:
    """The arm at T times (T,) [s]: B capsules each, `ends` (T, B, 2, 3) and `radius` (B,) [m]."""

    time: np.ndarray
    ends: np.ndarray
    radius: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A 3-D view that turns: polylines (k, 3) or (p, k, 3), points (k, 3) by name [m], boxes (min, max), the arm.

    `colouring` {line: (k,)} colours a polyline by figures, which `coloured_by` names with their unit.
    """

    name: str
    caption: str
    lines: dict[str, np.ndarray] = field(default_factory=dict)
    points: dict[str, np.ndarray] = field(default_factory=dict)
    boxes: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    arm: ArmPoses | None = None
    colouring: dict[str, np.ndarray] = field(default_factory=dict)
    coloured_by: str = ""


def scene_part(scene: Scene) -> dict[str, Any]:
    """What the page's template needs of a view."""
    data: dict[str, Any] = {
        "lines": {name: np.round(line, 4).tolist() for name, line in scene.lines.items()},
        "points": {name: np.round(points, 4).tolist() for name, points in scene.points.items()},
        "boxes": {
            name: [np.asarray(low).tolist(), np.asarray(high).tolist()] for name, (low, high) in scene.boxes.items()
        },
        "colouring": {name: [float(f"{v:.3g}") for v in values] for name, values in scene.colouring.items()},
        "by": scene.coloured_by,
    }
    if scene.arm is not None:
        ends = np.round(scene.arm.ends, 3).reshape(len(scene.arm.time), -1)
        data["arm"] = {"time": np.round(scene.arm.time, 3).tolist(), "ends": ends.tolist()}
        data["arm"]["radius"] = np.round(scene.arm.radius, 3).tolist()
    rows = [["what", "x [m]", "y [m]", "z [m]"]]
    for name, line in {**scene.lines, **scene.points}.items():
        rows += [[name, *(f"{value:.4f}" for value in point)] for point in line.reshape(-1, 3)]
    text = json.dumps(data).replace("<", "\\u003c")
    return {"kind": "scene", "part": scene, "json": text, "still": _still(scene), "csv": packed(csv_text(rows))}


def _still(scene: Scene) -> str:
    """SVG text of the view as it opens."""
    corners = {name: _corners(*box) for name, box in scene.boxes.items()}
    strokes = {name: line.reshape(-1, *line.shape[-2:]) for name, line in scene.lines.items()}
    everything = np.concatenate(
        [*(line.reshape(-1, 3) for line in scene.lines.values()), *scene.points.values(), *corners.values()]
    )
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    scale = 180 / max(float(np.linalg.norm(everything - middle, axis=1).max()), 1e-6)
    cosine, sine = np.cos(_TURN), np.sin(_TURN)

    def flat(points: np.ndarray) -> str:
        x, y, z = (np.asarray(points) - middle).T
        right, up = cosine * x - sine * y, np.cos(_TILT) * z + np.sin(_TILT) * (sine * x + cosine * y)
        return " ".join(f"{320 + scale * a:.1f},{200 - scale * b:.1f}" for a, b in zip(right, up, strict=True))

    drawn = [
        f'<polyline points="{flat(found[list(edge)])}" fill="none" stroke="#8a949e"/>'
        for found in corners.values()
        for edge in _EDGES
    ]
    for colour, lines in zip(SERIES, strokes.values(), strict=False):
        drawn += [f'<polyline points="{flat(one)}" fill="none" stroke="{colour}" stroke-width="1.5"/>' for one in lines]
    return f'<svg viewBox="0 0 640 400">{"".join(drawn)}</svg>'


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.array([[(low, high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)], dtype=float)
