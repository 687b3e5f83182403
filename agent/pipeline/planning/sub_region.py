"""The recipe's sub-region: its via-points' regions, those around a job among them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from agent.core import LARGEST_PROGRAM, InputError, read_bytes, read_text
from agent.link import trajectories
from agent.motion import ViaRegions, dialect_of, pose_of
from agent.recipe import Recipe
from agent.recording import read_log
from agent.robot import Dynamics, kinematics_for


def via_regions(recipe: Recipe) -> ViaRegions:
    """The recipe's sub-region as the search needs it."""
    via = recipe.motion.via_points
    count = via.count or 0  # the section requires one of the four, and a count for all but points
    if via.box is not None:
        return ViaRegions.from_box(count, via.box.centre, via.box.size, via.box.orientation, via.box.cone)
    if via.points is not None:
        return ViaRegions.from_points([point.pose for point in via.points], [point.range for point in via.points])
    if via.tube is not None:
        return ViaRegions.from_tube(count, [pose_of(pose) for pose in via.tube.path], via.tube.radius, via.tube.cone)
    return ViaRegions.from_envelope(count, _task_poses(recipe, Path(via.like or "")), via.around or 0.0)


def _task_poses(recipe: Recipe, path: Path) -> np.ndarray:
    """(S, 4, 4) poses of the job that the recipe's `like` names: a program or a log."""
    if path.suffix.lower() == ".mcap":
        q = read_log(path, recipe.robot).position
        return Dynamics(recipe.robot, recipe.tool).tcp_pose(q[:: max(1, len(q) // 2000)])

    kinematics = kinematics_for(recipe.robot, recipe.tool)
    text, dialect = moving_part(recipe, path)[0], dialect_of(path) or recipe.dialect
    planned = list(trajectories(recipe, dialect.read(text, str(path), recipe.robot).run(), kinematics.middle))
    if not planned:
        raise InputError(f"{path}: nothing in this program moves the arm; name the program that does")
    first = planned[0][0]  # leads from an arbitrary start to the job
    job = [chain for moves, chain in planned if moves is not first] or [chain for _, chain in planned]
    return np.concatenate([kinematics.forward(chain.q[::25]) for chain in job])


def moving_part(recipe: Recipe, path: Path) -> tuple[str, dict[str, int]]:
    """The moving part of a job's program, and how often each word without motion was skipped."""
    dialect = dialect_of(path) or recipe.dialect
    text = read_text(path, LARGEST_PROGRAM)
    listing = dialect.companion(path)
    variables = "" if listing is None else read_bytes(listing, LARGEST_PROGRAM).decode("utf-8", errors="replace")
    return dialect.job(text, str(path), recipe.robot, variables)
