"""Executed path or timing that is not the planned one: seen in the set-points, not in torque."""

from __future__ import annotations

from types import MappingProxyType

from agent.model.effect_inputs import MotionSignals
from agent.model.effects.effect import Columns, Effect, Joints, Numbers
from agent.robot import RobotDescription


class InterpolatorMismatch(Effect):
    """Set-points r(t) against planned ones p(t): r(t) ≈ p(a t + b), see `agent.diagnosis.gap.motion_gap`."""

    name = "interpolator_mismatch"
    family = "path"
    scope = "arm"
    formula = "r(t) − p(t)"
    source = "Villagrossi, Pedrocchi, Vicentini, Molinari Tosatti, AIM (2013): the interpolator decides the motion"
    signature = "set-points away from the plan, no residual of torque"
    phrase = "the controller runs a different path than planned"
    look_at = "override, fly settings and acceleration ramps of the controller against those planned with"
    units = MappingProxyType({"shift": "s", "blend": "s"})
    leading = ("shift",)
    shows_in = "path"

    def possible_joints(self, robot: RobotDescription) -> list[tuple[int, ...]]:
        return []

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        return {}
