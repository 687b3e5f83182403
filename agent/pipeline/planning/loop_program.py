"""A planned motion in the language of its controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from agent.excitation import Loop
from agent.link import APPROACH_SPEED
from agent.motion import CartesianTarget, JointTarget, LoopProgram, Target, with_frames
from agent.recipe import Recipe
from agent.robot import kinematics_for


@dataclass(frozen=True, eq=False)
class LoopMotion:
    """A loop that will be run `cycles` times at `speed` [m/s]. `kind` is `excitation` or `validation`."""

    recipe: Recipe
    name: str
    kind: str
    loop: Loop
    speed: float
    cycles: int

    @classmethod
    def excitation(cls, recipe: Recipe, loop: Loop) -> LoopMotion:
        """The loop that the model is estimated from."""
        return cls(recipe, "excite", "excitation", loop, recipe.motion.speed, recipe.record.cycles)

    @classmethod
    def validation(cls, recipe: Recipe, loops: Sequence[Loop]) -> tuple[LoopMotion, ...]:
        """The loops that the model is judged on, each once and at their own speed."""
        speed = recipe.validate.speed
        return tuple(cls(recipe, f"valid{k:02d}", "validation", loop, speed, 1) for k, loop in enumerate(loops, 1))

    @cached_property
    def program(self) -> str:
        """Its text in the language of the controller. It sets every frame, so earlier programs do not change it."""
        recipe = self.recipe
        settings = with_frames(recipe.motion.settings_at(self.speed), recipe.tool)
        approach = settings.changed(speed_override=APPROACH_SPEED)
        start = JointTarget(self.loop.start)
        loop = LoopProgram.of(_targets(recipe, self.loop), settings, self.cycles, approach, start)
        return recipe.dialect.write_loop(self.name, loop, recipe.robot)


def _targets(recipe: Recipe, loop: Loop) -> list[Target]:
    """Via-points for a controller: poses with configuration flags, of a redundant arm joint positions."""
    if isinstance(loop.moves[0].target, JointTarget):
        return [JointTarget(q) for q in loop.joints]
    kinematics = kinematics_for(recipe.robot, recipe.tool)
    return [
        CartesianTarget(pose, kinematics.configuration_text(q)) for pose, q in zip(loop.poses, loop.joints, strict=True)
    ]
