"""The frames that a program's positions are given in: which it sets, which it leaves to the controller, and poses in
the robot's base."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from agent.motion.program import (
    NO_FRAME,
    CartesianTarget,
    MotionSettings,
    Move,
    MoveType,
    Statement,
    Target,
    frame_of,
    matrix_of,
)

if TYPE_CHECKING:
    from agent.robot import Tool

#: The settings of one controller's language, or of all.
Settings = TypeVar("Settings", bound=MotionSettings)


def tool_frame(tool: Tool | None) -> np.ndarray:
    """(4, 4) of the tool centre point in the flange's frame [m]."""
    return np.eye(4) if tool is None else np.asarray(tool.frame, dtype=float)


def with_frames(settings: Settings, tool: Tool | None) -> Settings:
    """The settings for poses of this tool's centre point in the robot's base."""
    return settings.carrying(tool).changed(base=NO_FRAME, tool=frame_of(tool_frame(tool)), uframe=NO_FRAME)


def pose_in_robot_base(target: Target, settings: MotionSettings) -> np.ndarray:
    """(4, 4) where a Cartesian target is [m]: base⁻¹ · uframe · pose.

    `base` is where the robot stands in the world, `uframe` where the work is in it; a pose is given in `uframe`.
    """
    assert isinstance(target, CartesianTarget)
    pose = np.asarray(target.pose, dtype=float)
    if settings.uframe not in (None, NO_FRAME):
        pose = matrix_of(settings.uframe) @ pose
    return pose if settings.base in (None, NO_FRAME) else np.linalg.solve(matrix_of(settings.base), pose)


def left_open(statements: Iterable[Statement], tool: Tool | None, names: Mapping[str, str]) -> Mapping[str, np.ndarray]:
    """The frames (4, 4) [m] that a plan of these statements takes for granted, as the program does not set them.

    A move to a pose needs all three, a straight line or an arc between joint positions the tool, and so does a joint
    move that flies by its target, as the distance from it is the tool's; one that stops there needs none.

    Args:
        names: of the frames that the dialect has (`Dialect.frame_names`).
    """
    needed: set[str] = set()
    for move in statements:
        if not isinstance(move, Move):
            continue
        if any(isinstance(target, CartesianTarget) for target in (move.target, move.via)):
            frames = {*names}
        else:
            frames = set() if move.type is MoveType.JOINT and not move.fly else {"tool"}
        needed |= {frame for frame in frames if getattr(move.settings, frame) is None}
    taken = {"base": np.eye(4), "tool": tool_frame(tool), "uframe": np.eye(4)}
    return {names[frame]: taken[frame] for frame in names if frame in needed}
