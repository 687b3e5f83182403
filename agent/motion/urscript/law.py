"""How a UR controller of the e-Series moves, as far as it is published, and what of that a plan may ask for.

Speed is a trapezoid with the acceleration that the program says; in a joint move, of the joint that moves farthest. A
blend begins at its radius `r`, and the tool goes around the corner on a circle with the speed that it came with.
Nothing is slowed down for the joints: a program that asks too much of one, or whose blends overlap, is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from agent.motion.fly.blocks import plan_blocks
from agent.motion.fly.interpolator import FlyInterpolator
from agent.motion.fly.profile import ArmLimits
from agent.motion.fly.runs import RunPlanner
from agent.motion.fly.setpoints import Run
from agent.motion.fly_parameters import FlyParameters
from agent.motion.interpolator import MotionError
from agent.motion.path.blend import Corner
from agent.motion.path.segments import CartesianSegment, JointSegment, Segment
from agent.motion.pdl2.settings import FlyTrajectory, FlyType, Pdl2Settings
from agent.motion.program import MotionSettings, Move, Statement
from agent.motion.trajectory import Trajectory
from agent.motion.urscript.settings import UrSettings
from agent.robot import CartesianLimits, RobotDescription, Tool

#: Blends keep so far [m] from each other: by so much points of an arm's own kinematics differ from the nominal ones.
BLEND_MARGIN = 0.002
#: Acceleration [m/s²] that a program's is expressed as a part of.
_WHOLE = 100.0
_PARAMETERS = FlyParameters(ramps="blocks", rise=0.0, blend="circle", curve_share=np.inf, curve_turns=False)


@dataclass(frozen=True)
class _LawSettings(Pdl2Settings):
    """A move of the UR as the planner of paths takes it."""

    joint_speed: float = 1.0
    joint_acceleration: float = 1.0

    @classmethod
    def of(cls, settings: MotionSettings) -> _LawSettings:
        ours = UrSettings.of(settings)
        shared = {field.name: getattr(ours, field.name) for field in fields(MotionSettings)}
        part = min(ours.linear_acceleration / _WHOLE, 1.0)
        return cls(
            **shared | {"speed_override": 1.0, "linear_speed": ours.linear_speed * ours.speed_override},
            fly_type=FlyType.FLY_CART,
            fly_trajectory=FlyTrajectory.FLY_FROM,
            acceleration_override=part,
            deceleration_override=part,
            joint_speed=ours.joint_speed * ours.speed_override,
            joint_acceleration=ours.joint_acceleration,
        )


class UrInterpolator:
    """Plans programs of `movej`, `movel`, `movep` and `movec` at the controller's period (`agent.motion.Interpolator`).

    `tool` is the TCP of moves that name none; `period` [s].
    """

    def __init__(self, robot: RobotDescription, tool: Tool | None = None, period: float = 0.002):
        self.robot = robot
        self._fly = FlyInterpolator(robot, tool, period, _PARAMETERS)
        self._fly._planner = _Planner(robot, ArmLimits.of(robot, _PARAMETERS), period, _PARAMETERS)

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) [rad] to rest.

        Raises:
            MotionError: out of reach, through a singularity, blends that overlap, or more than a joint or the tool can
                do: names move, limit and amount.
        """
        moves = [
            replace(one, settings=_LawSettings.of(one.settings)) if isinstance(one, Move) else one for one in statements
        ]
        trajectory = self._fly.plan(moves, start)
        self._check(trajectory)
        return trajectory

    def _check(self, trajectory: Trajectory) -> None:
        """Raise MotionError for what goes farthest beyond a limit."""
        robot, tool = self.robot, self.robot.cartesian_limits
        checks = [
            (f"{name} {what}", "rad/s" if what == "speed" else "rad/s²", np.abs(values[:, k]), limit[k])
            for what, values, limit in (
                ("speed", trajectory.qd, robot.max_velocity),
                ("acceleration", trajectory.qdd, robot.max_acceleration),
            )
            for k, name in enumerate(robot.joint_names)
        ]
        if tool is not None:
            checks.append(("tool speed", "m/s", trajectory.path_speed, tool.linear_speed))
        limit, unit, values, most = max(checks, key=lambda one: float(np.max(one[2])) / one[3])
        at = int(np.argmax(values))
        if values[at] > most * (1.0 + 1e-6):
            move = int(trajectory.move[at])
            message = (
                f"statement {move + 1}: {limit} would reach {values[at]:.3g} {unit}, and {most:.3g} are allowed; move "
                "more slowly, or blend with a larger radius"
            )
            raise MotionError(message, move, limit, float(values[at] / most - 1.0))


class _Planner(RunPlanner):
    """Plans without a look at the limits of the arm, and refuses blends that overlap."""

    def _run(self, segments: Sequence[Segment], corners: list[Corner], start: np.ndarray) -> Run:
        _refuse_overlap(segments)
        path, shape = self._path(segments, corners, start)
        self._check_positions(path, segments)
        return plan_blocks(path, shape, segments, _limits(segments, self.robot.dof), self.period, self.parameters)


def _limits(segments: Sequence[Segment], joints: int) -> ArmLimits:
    """What bounds the speed: in joint moves that of the leading joint, else the program's own."""
    settings = [one.settings for one in segments if isinstance(one, JointSegment)]
    speed = min((one.joint_speed for one in settings if isinstance(one, _LawSettings)), default=np.inf)
    acceleration = min((one.joint_acceleration for one in settings if isinstance(one, _LawSettings)), default=np.inf)
    turning = any(isinstance(one, CartesianSegment) and one.turning > 0.0 for one in segments)
    tool = CartesianLimits(np.inf, _WHOLE, np.inf, _WHOLE if turning else np.inf)
    return ArmLimits(np.full(joints, speed), np.full(joints, acceleration), np.full(joints, np.inf), tool)


def _refuse_overlap(segments: Sequence[Segment]) -> None:
    """A controller skips the move between blends that overlap."""
    before = 0.0
    for segment, last in zip(segments, [*[False] * (len(segments) - 1), True], strict=True):
        radius = 0.0 if last else segment.settings.fly_distance
        length = segment.extent
        if before + radius > 0.0 and before + radius + BLEND_MARGIN > length:
            raise MotionError(
                f"{segment.label}: the blends at its ends take {1e3 * (before + radius):.1f} mm of its "
                f"{1e3 * length:.1f} mm, so the controller would skip it; blend with a smaller radius",
                segment.move,
                "blend overlap",
                (before + radius + BLEND_MARGIN) / max(length, BLEND_MARGIN) - 1.0,
            )
        before = radius
