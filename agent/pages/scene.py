"""A 3-D view: the loop, the boxes around it and the arm that runs it; and a picture of the arm in one posture."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from agent.core import csv_text
from agent.pages.plots import packed
from agent.pages.templates import filled
from agent.robot import Dynamics, RobotDescription, chain_of

_MOST_POSTURES = 120
#: Edge of the picture of one posture, and its margin [pt].
_PICTURE, _MARGIN = 200.0, 14.0
_THIN = 0.012  # radius of a link without a body, as a share of the arm's length


@dataclass(frozen=True, eq=False)
class ArmPoses:
    """The arm at T times (T,) [s]: B capsules each, `ends` (T, B, 2, 3) and `radius` (B,) [m]; `joints` (T, J, 3) is
    the line from the base by way of the joints to the tool."""

    time: np.ndarray
    ends: np.ndarray
    radius: np.ndarray
    joints: np.ndarray


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
    """Data of a view for the page's template."""
    data: dict[str, Any] = {
        "lines": {name: np.round(line, 4).tolist() for name, line in scene.lines.items()},
        "points": {name: np.round(points, 4).tolist() for name, points in scene.points.items()},
        "boxes": {name: [np.asarray(edge).tolist() for edge in box] for name, box in scene.boxes.items()},
        "colouring": {name: [float(f"{v:.3g}") for v in values] for name, values in scene.colouring.items()},
        "by": scene.coloured_by,
    }
    if scene.arm is not None:
        time, ends = scene.arm.time, scene.arm.ends.reshape(len(scene.arm.time), -1)
        joints = scene.arm.joints.reshape(len(scene.arm.time), -1)
        arm = {"time": time, "ends": ends, "radius": scene.arm.radius, "joints": joints}
        data["arm"] = {key: np.round(values, 3).tolist() for key, values in arm.items()}
    rows = [["what", "x [m]", "y [m]", "z [m]"]]
    for name, line in {**scene.lines, **scene.points}.items():
        rows += [[name, *(f"{value:.4f}" for value in point)] for point in line.reshape(-1, 3)]
    text = json.dumps(data).replace("<", "\\u003c")
    return {"kind": "scene", "part": scene, "json": text, "csv": packed(csv_text(rows))}


def arm_along(robot: RobotDescription, time: np.ndarray, q: np.ndarray, tool: np.ndarray | None = None) -> ArmPoses:
    """The capsules of the description, or lines from joint to joint where it has none.

    time (S,) and q (S, n) of a motion; `tool` (4, 4): the tool's frame at the flange.
    """
    chosen = np.linspace(0, len(q) - 1, min(len(q), _MOST_POSTURES)).round().astype(int)
    joints = chain_of(robot, tool).origins(q[chosen])
    joints = np.concatenate([np.zeros((len(chosen), 1, 3)), joints], axis=1)
    bones = np.stack([joints[:, :-1], joints[:, 1:]], axis=2)
    length = float(np.linalg.norm(bones[0, :, 1] - bones[0, :, 0], axis=1).sum())
    if not robot.bodies:
        return ArmPoses(time[chosen], bones, np.full(bones.shape[1], _THIN * length), joints)
    dynamics = Dynamics(robot)
    ends, radii = [bones[:, -1]], [_THIN * length]
    for link, capsules in robot.bodies.items():
        poses = dynamics.link_poses(q[chosen], link)
        for capsule in capsules:
            points = np.array([[*capsule.start, 1.0], [*capsule.end, 1.0]])
            ends.append(np.einsum("sij,pj->spi", poses, points)[..., :3])
            radii.append(capsule.radius)
    return ArmPoses(time[chosen], np.stack(ends, axis=1), np.array(radii), joints)


def arm_picture(robot: RobotDescription, q: np.ndarray, marked: Collection[str]) -> str:
    """SVG text of the arm at (n,) joint positions, seen from the side that shows most of it, with joints `marked`."""
    points = np.vstack([np.zeros(3), chain_of(robot, None).origins(q[None])[0]])
    if not np.ptp(points, axis=0).max() > 0:
        return ""
    across = points[:, int(np.ptp(points[:, 1]) > np.ptp(points[:, 0]))]
    flat = np.column_stack([across - across.min(), points[:, 2].max() - points[:, 2]])
    flat = _MARGIN + flat * (_PICTURE - 2 * _MARGIN) / np.ptp(points, axis=0).max()
    wide, high = flat.max(axis=0) + _MARGIN
    joints = list(zip(robot.joint_names, flat[1:].tolist(), strict=False))
    values = {"wide": wide + 70, "high": high, "points": flat.tolist(), "joints": joints, "marked": marked}
    return filled("agent.pages", "arm.svg", **values)
