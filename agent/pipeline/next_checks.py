"""What would refuse a further motion is found before the diagnosis that it is planned for."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import InputError
from agent.link import check_payload
from agent.pipeline.planning import loop_problem
from agent.recipe import Recipe

if TYPE_CHECKING:
    from agent.recording import Log
    from agent.robot import RobotDescription

#: Two descriptions of one arm have its end, whatever they call that, within this part of its reach: under another name,
#: and under the same.
_SAME_ARM, _SAME_NAME = 0.15, 0.05


def check_next(recipe: Path, folder: Path | None, load: str | None = None) -> None:
    """What would refuse the motion is found before the diagnosis, not after it.

    Raises:
        InputError: no folder, one that is a file or holds an experiment; a recipe that cannot be used or reached; a
            mass that the arm must not carry.
    """
    from agent.excitation import Candidates
    from agent.model import payload_of
    from agent.recipe import load_recipe

    if folder is None:
        raise InputError("diagnose: --next plans a motion: name the folder for it with -o DIR")
    check_folder(folder)
    loaded = load_recipe(recipe)
    if load is not None:
        check_payload(loaded.robot, loaded.tool, payload_of(load))
    Candidates(loop_problem(loaded, loaded.motion.speed))


def check_arm(recipe: Recipe, there: RobotDescription) -> None:
    """
    Raises:
        InputError: the recipe's robot is not that of the logs, `there`: other joints, or another geometry.
    """
    from agent.robot import kinematics_for

    here = recipe.robot
    if here.joint_names != there.joint_names:
        raise InputError(
            f"{recipe.path}: its robot has joints {', '.join(here.joint_names)}; the logs are of one with "
            f"{', '.join(there.joint_names)}. Name a recipe of that robot with --next"
        )
    postures = np.random.default_rng(0).uniform(-1.0, 1.0, (20, here.dof))
    ends = [kinematics_for(robot).forward(postures)[:, :3, 3] for robot in (here, there)]
    apart = float(np.linalg.norm(ends[0] - ends[1], axis=1).max())
    if apart > (_SAME_NAME if here.name == there.name else _SAME_ARM) * float(np.linalg.norm(ends[1], axis=1).max()):
        raise InputError(
            f"{recipe.path}: is for {here.name}, but the logs are of {there.name}. In the same posture, their ends "
            f"are {1e3 * apart:.0f} mm apart. Name a recipe of that robot with --next"
        )


def check_tool(recipe: Recipe, logs: Sequence[Log], of_model: Mapping[str, Any]) -> None:
    """
    Raises:
        InputError: the recipe has another tool than the logs, or than the model, by its provenance `of_model`: what is
            recorded with it could not be diagnosed beside them.
    """
    mine = "none" if recipe.tool is None else recipe.tool.text()
    known = {tool: log.name for log in reversed(logs) if (tool := log.metadata.get("tool"))}
    known |= {tool: "the model" for tool in of_model.get("tool", ())}
    for tool, where in known.items():
        if tool != mine:
            raise InputError(
                f"{recipe.path}: its tool is {mine}, but that of {where} is {tool}. Name a recipe "
                "with the same tool with --next"
            )


def check_folder(folder: Path) -> None:
    """
    Raises:
        InputError: a folder that holds an experiment or cannot be made or written.
    """
    there = next(one for one in (folder, *folder.absolute().parents) if one.exists())
    if not there.is_dir():
        raise InputError(f"{there}: is a file; name a folder for the experiment with -o")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(f"{there}: nothing can be written there; name another folder for the experiment with -o")
    from agent.motion import dialects

    programs = {f"program{one.suffix}": "a program" for one in dialects()}
    for name, what in {"experiment.json": "an experiment", **programs}.items():
        if (folder / name).exists():
            raise InputError(f"{folder}: holds {what} already; name another folder with -o, or move it away")
