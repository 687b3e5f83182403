"""How a UR controller of the e-Series moves, as far as it is published, and what of that a plan may ask for.

Speed is a trapezoid with the acceleration that the program says; in a joint move, of the joint that moves farthest. A
blend begins at its radius `r`, and the tool goes around the corner on a circle with the speed that it came with.
Nothing is slowed down for the joints: a program that asks too much of one, or whose blends overlap, is refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.motion.fly.blocks import plan_blocks
from agent.motion.fly.fly_parameters import FlyParameters
from agent.motion.fly.interpolator import FlyInterpolator
from agent.motion.fly.move_geometry import CartesianSegment, JointSegment, Segment, label_of
from agent.motion.fly.profile import ArmLimits, PathShape
from agent.motion.fly.run_planner import RunPlanner
from agent.motion.fly.setpoints import Run
from agent.motion.interpolator import BindingLimit, MotionError, Trajectory
from agent.motion.path_settings import FlyTrajectory, FlyType, PathSettings
from agent.motion.program import Move, MoveType, Statement
from agent.motion.urscript.settings import UrSettings
from agent.robot import CartesianLimits, RobotDescription, Tool

#: Smallest distance [m] between blends: points by an arm's calibrated kinematics differ this far from nominal ones.
BLEND_MARGIN = 0.002
#: Acceleration [m/s²] that a program's is expressed as a part of.
_WHOLE = 100.0
_ROUNDING = 1e-6
_PARAMETERS = FlyParameters(
    ramps="blocks", rise=0.0, blend="circle", curve_share=np.inf, curve_turns=False, stop_angle=np.pi
)


@dataclass(frozen=True)
class _LawSettings(PathSettings):
    """A move of the UR as the planner of paths takes it."""

    joint_speed: float = 1.0
    joint_acceleration: float = 1.0

    @classmethod
    def of_move(cls, move: Move) -> _LawSettings:
        ours = UrSettings.of(move.settings)
        part = 1.0 if move.type is MoveType.JOINT else min(ours.linear_acceleration / _WHOLE, 1.0)
        return cls.of(ours).changed(
            speed_override=1.0,
            linear_speed=ours.linear_speed * ours.speed_override,
            fly_type=FlyType.FLY_CART,
            fly_trajectory=FlyTrajectory.FLY_FROM,
            acceleration_override=part,
            deceleration_override=part,
            joint_speed=ours.joint_speed * ours.speed_override,
            joint_acceleration=ours.joint_acceleration,
        )


class UrLaw:
    """Plans programs of `movej`, `movel`, `movep` and `movec` at the controller's period (`agent.motion.Interpolator`).

    `tool` is the TCP of moves that name none; `period` [s].
    """

    def __init__(self, robot: RobotDescription, tool: Tool | None = None, period: float = 0.002):
        self._fly = FlyInterpolator(robot, tool, period, _PARAMETERS, _Planner)

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) [rad] to rest.

        Raises:
            MotionError: out of reach, through a singularity, blends that overlap, or more than a joint or the tool can
                do: names move, limit and amount.
        """
        moves = [
            replace(statement, settings=_LawSettings.of_move(statement)) if isinstance(statement, Move) else statement
            for statement in statements
        ]
        return self._fly.plan(moves, start)


class _Planner(RunPlanner):
    """Plans without a look at the limits of the arm, and refuses what goes farthest beyond one of them."""

    def timed(self, shape: PathShape, segments: Sequence[Segment]) -> Run:
        run = plan_blocks(shape, segments, _limits(segments, self.robot.dof), self.period, self.parameters)
        worst = max(
            (*_overlaps(segments), *self._beyond(run, segments)), key=lambda violation: violation.excess, default=None
        )
        if worst is not None:
            raise worst
        return run

    def binding_limits(self, runs: Sequence[tuple[float, Run]]) -> tuple[BindingLimit, ...]:
        return ()  # the program alone says how fast it goes

    def _beyond(self, run: Run, segments: Sequence[Segment]) -> Iterator[MotionError]:
        """Limits of joints and tool that the set-points exceed."""
        robot, path, samples = self.robot, run.shape.path, run.samples
        limits = [
            (name, "speed", "rad/s", most) for name, most in zip(robot.joint_names, robot.max_velocity, strict=True)
        ]
        for name, most in zip(robot.joint_names, robot.max_acceleration, strict=True):
            limits.append((name, "acceleration", "rad/s²", most))
        rows = [*np.abs(samples.qd), *np.abs(samples.qdd)]
        if robot.cartesian_limits is not None:
            limits.append(("the tool", "speed", "m/s", robot.cartesian_limits.linear_speed))
            rows.append(np.sqrt(np.einsum("is,is->s", samples.pose_rate[:3], samples.pose_rate[:3])))
        for (name, what, unit, most), values in zip(limits, rows, strict=True):
            at = int(np.argmax(values))
            if values[at] > most * (1.0 + _ROUNDING):
                knot = min(int(np.searchsorted(path.s - path.s[0], samples.s[at])), len(path.move) - 1)
                move = int(path.move[knot])
                message = (
                    f"{label_of(segments, move)}: {name} would reach {values[at]:.3g} {unit}, and {most:.3g} are "
                    "allowed; move more slowly, or blend with a larger radius"
                )
                yield MotionError(message, move, f"{name} {what}", float(values[at] / most - 1.0))


def _limits(segments: Sequence[Segment], joints: int) -> ArmLimits:
    """Speed limit: that of the leading joint in joint moves, else the program's own."""
    settings = [segment.settings for segment in segments if isinstance(segment, JointSegment)]
    speed = min((segment.joint_speed for segment in settings if isinstance(segment, _LawSettings)), default=np.inf)
    acceleration = min(
        (segment.joint_acceleration for segment in settings if isinstance(segment, _LawSettings)), default=np.inf
    )
    turning = any(isinstance(segment, CartesianSegment) and segment.turning > 0.0 for segment in segments)
    tool = CartesianLimits(np.inf, _WHOLE, np.inf, _WHOLE if turning else np.inf)
    return ArmLimits(np.full(joints, speed), np.full(joints, acceleration), np.full(joints, np.inf), tool)


def _apart(segment: Segment) -> float:
    """Distance [m] between the ends of a move: rotation keeps no blends apart."""
    if isinstance(segment, JointSegment):
        start, end = segment.kinematics.forward(np.stack([segment.start, segment.end]))[:, :3, 3]
    else:
        start, end = segment.curve.position(np.array([0.0, 1.0]))
    return float(np.linalg.norm(end - start))


def _overlaps(segments: Sequence[Segment]) -> Iterator[MotionError]:
    """Moves that a controller would skip, as the blends at their ends overlap."""
    before = 0.0
    for segment, last in zip(segments, [*[False] * (len(segments) - 1), True], strict=True):
        radius = 0.0 if last else segment.settings.fly_distance
        length = _apart(segment)
        if before + radius > 0.0 and before + radius + BLEND_MARGIN > length:
            message = (
                f"{segment.label}: the blends at its ends take {1e3 * (before + radius):.1f} mm of its "
                f"{1e3 * length:.1f} mm, so the controller would skip it; blend with a smaller radius"
            )
            excess = (before + radius + BLEND_MARGIN) / max(length, BLEND_MARGIN) - 1.0
            yield MotionError(message, segment.move, "blend overlap", excess)
        before = radius
