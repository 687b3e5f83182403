"""A planned motion in the language of its controller."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.excitation import Loop, via_joints
from agent.link import APPROACH_SPEED
from agent.motion import CartesianTarget, JointTarget, LoopProgram, Target, with_frames
from agent.recipe import Recipe
from agent.robot import kinematics_for


@dataclass(frozen=True, eq=False)
class LoopMotion:
    """A loop that will be run `cycles` times at `speed` [m/s]. `kind` is `excitation` or `validation`."""

    name: str
    kind: str
    loop: Loop
    speed: float
    cycles: int


def program_text(recipe: Recipe, motion: LoopMotion) -> str:
    """Program of a planned motion. It sets every frame, so earlier programs do not change its meaning."""
    settings = with_frames(recipe.motion.settings_at(motion.speed), recipe.tool)
    approach = settings.changed(speed_override=APPROACH_SPEED)
    points = _targets(recipe, motion.loop)
    start = JointTarget(np.asarray(motion.loop.start, dtype=float))
    loop = LoopProgram.of(points, settings, motion.cycles, approach, start)
    return recipe.dialect.write_loop(motion.name, loop, recipe.robot)


def _targets(recipe: Recipe, loop: Loop) -> list[Target]:
    """Via-points for a controller: poses with configuration flags if the arm has them, else joint positions."""
    if isinstance(loop.moves[0].target, JointTarget):
        *flown, closing = (move.target for move in loop.moves)
        return [closing, *flown]
    kinematics = kinematics_for(recipe.robot, recipe.tool)
    passed = via_joints(kinematics, loop)
    if not hasattr(kinematics, "solve_configuration"):
        return [JointTarget(position) for position in passed]

    return [
        CartesianTarget(pose, kinematics.configuration_text(position))
        for pose, position in zip(loop.poses, passed, strict=True)
    ]
