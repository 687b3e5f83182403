"""A motion after a diagnosis: what makes it impossible, its plan, and the folder that it is written to."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import AgentError, Console, InputError, sha256_text, write_atomically
from agent.diagnosis import Diagnosis
from agent.excitation import Candidates
from agent.experiment import LONGEST, Deadline, NextMotion, NoMotion, WithMass, clearer_with_mass, plan_motion
from agent.link import PROGRAM_SHA256, SCHEMA, check_payload
from agent.model import payload_of
from agent.motion import dialects
from agent.pipeline.gap.set_point_files import servo_arm
from agent.pipeline.planning.plan import loop_problem
from agent.recipe import Recipe, load_recipe
from agent.recording import Log
from agent.robot import RobotDescription, Tool, kinematics_for
from agent.runs import make_folder, write_json
from agent.simulators import is_simulator

#: Distance of the ends of two descriptions of one arm, as a share of its reach: under another name, and the same.
_SAME_ARM, _SAME_NAME = 0.15, 0.05


def plan_next(
    diagnosis: Diagnosis,
    recipe: Recipe,
    console: Console,
    seconds: float = LONGEST,
    name: str = "experiment",
    load: Tool | None = None,
    deadline: Deadline | None = None,
) -> NextMotion | NoMotion:
    """Plan the motion in the recipe's sub-region, as `agent.experiment.plan_motion` does.

    Raises:
        InputError: the recipe is of another robot, or a keep-out box that no motion of it can keep clear of.
    """
    check_arm(recipe, diagnosis.dataset.robot)
    problem = loop_problem(recipe, recipe.motion.speed)
    return plan_motion(diagnosis, recipe, problem, console, seconds, name, load, deadline)


def clearer_loaded(
    diagnosis: Diagnosis, recipe: Recipe, motion: NextMotion, console: Console, deadline: Deadline | None = None
) -> WithMass | None:
    """A known mass that makes clear what a motion of the bare arm leaves in doubt, if there is one."""
    return clearer_with_mass(diagnosis, recipe, loop_problem(recipe, recipe.motion.speed), motion, console, deadline)


def write_next(motion: NextMotion, folder: Path) -> dict[str, Any]:
    """Write program and expectation into a folder of their own; returns `next_experiment` of the diagnosis.

    Raises:
        InputError: the folder holds an experiment already.
        AgentError: it cannot be made or written.
    """
    make_folder(folder, "the experiment")
    check_folder(folder)
    program = write_atomically(folder / f"program{motion.dialect.suffix}", motion.text)
    data = motion.to_dict(str(program))
    write_json(folder / "experiment.json", {"schema": SCHEMA, **data, PROGRAM_SHA256: sha256_text(motion.text)})
    return data


def check_next(recipe: Path, folder: Path | None, load: str | None = None) -> None:
    """Refuse before the diagnosis what would refuse the motion after it.

    Raises:
        InputError: no folder, one that is a file or holds an experiment; a recipe that cannot be used or reached; a
            mass that the arm must not carry.
    """
    if folder is None:
        raise InputError("diagnose: --next plans a motion: name the folder for it with -o DIR")
    check_folder(folder)
    if is_simulator(recipe):
        if load is not None:
            raise InputError(f"diagnose: --payload belongs to the motion of a recipe; {recipe} is an arm's file")
        servo_arm(recipe)
        return
    loaded = load_recipe(recipe)
    if load is not None:
        check_payload(loaded.robot, loaded.tool, payload_of(load))
    Candidates(loop_problem(loaded, loaded.motion.speed))


def check_arm(recipe: Recipe, of_logs: RobotDescription) -> None:
    """Refuse a recipe whose robot is not that of the logs.

    Raises:
        InputError: other joints, or another geometry.
    """
    of_recipe = recipe.robot
    if of_recipe.joint_names != of_logs.joint_names:
        raise InputError(
            f"{recipe.path}: its robot has joints {', '.join(of_recipe.joint_names)}; the logs are of one with "
            f"{', '.join(of_logs.joint_names)}. Name a recipe of that robot with --next"
        )
    postures = np.random.default_rng(0).uniform(-1.0, 1.0, (20, of_recipe.dof))
    ends = [kinematics_for(robot).forward(postures)[:, :3, 3] for robot in (of_recipe, of_logs)]
    apart = float(np.linalg.norm(ends[0] - ends[1], axis=1).max())
    allowed = _SAME_NAME if of_recipe.name == of_logs.name else _SAME_ARM
    if apart > allowed * float(np.linalg.norm(ends[1], axis=1).max()):
        raise InputError(
            f"{recipe.path}: is for {of_recipe.name}, but the logs are of {of_logs.name}. In the same posture, their "
            f"ends are {1e3 * apart:.0f} mm apart. Name a recipe of that robot with --next"
        )


def check_tool(recipe: Recipe, logs: Sequence[Log], of_model: Mapping[str, Any]) -> None:
    """Refuse a recipe with another tool than the logs or the model (by its provenance): the logs would not be pooled.

    Raises:
        InputError: as said.
    """
    recipe_tool = "none" if recipe.tool is None else recipe.tool.text()
    known = {tool: log.name for log in reversed(logs) if (tool := log.metadata.get("tool"))}
    known |= {tool: "the model" for tool in of_model.get("tool", ())}
    for tool, where in known.items():
        if tool != recipe_tool:
            raise InputError(
                f"{recipe.path}: its tool is {recipe_tool}, but that of {where} is {tool}. Name a recipe "
                "with the same tool with --next"
            )


def check_folder(folder: Path) -> None:
    """Refuse a folder that holds an experiment, or that cannot be made or written.

    Raises:
        InputError: as said; AgentError where nothing can be written.
    """
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not existing.is_dir():
        raise InputError(f"{existing}: is a file; name a folder for the experiment with -o")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise AgentError(f"{existing}: nothing can be written there; name another folder for the experiment with -o")
    programs = {f"program{dialect.suffix}": "a program" for dialect in dialects()}
    for name, what in {"experiment.json": "an experiment", **programs}.items():
        if (folder / name).exists():
            raise InputError(f"{folder}: holds {what} already; name another folder with -o, or move it away")
