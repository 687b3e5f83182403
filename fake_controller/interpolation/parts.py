"""From moves to the parts of a path: targets and legs resolved, speeds read, corners sized."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from agent.motion import (
    CartesianTarget,
    FlyTrajectory,
    FlyType,
    JointTarget,
    MotionError,
    MotionSettings,
    Move,
    MoveType,
    OrientationType,
    Pdl2Settings,
    SpeedOption,
    Target,
)
from agent.robot import Kinematics, KinematicsError, RobotDescription, Tool, kinematics_for
from fake_controller.interpolation.curves import Leg, arc, corner, corner_angle, cut_off

_NOTHING = 1e-9  # m, rad
_SHARPEST = 2.9  # rad; the arm stops at corners that turn by more


@dataclass(frozen=True)
class InterpolationLaw:
    """Differences between the interpolations of controllers.

    blend: `circle` or `parabola`. jerk_time: [s] from no acceleration to all of it, 0 for trapezoidal ramps.
    acceleration: part of the limits that a ramp takes; curve: part of the joints' that a corner takes.
    auto_cut: part of the half leg that FLY_AUTO gives to a corner. linear, turning: [m/s², rad/s²] of a robot that has
    no Cartesian limits.
    """

    blend: str = "circle"
    jerk_time: float = 0.1
    acceleration: float = 0.95
    curve: float = 0.9
    auto_cut: float = 0.5
    linear: float = 2.0
    turning: float = 6.0


def drawn_law(seed: int) -> InterpolationLaw:
    """The law of one controller."""
    rng = np.random.default_rng([seed, 17])
    return InterpolationLaw(
        blend=str(rng.choice(["circle", "parabola"])),
        jerk_time=float(rng.choice([0.0, rng.uniform(0.04, 0.14)])),
        acceleration=float(rng.uniform(0.9, 1.0)),
        curve=float(rng.uniform(0.8, 0.95)),
        auto_cut=float(rng.uniform(0.3, 0.8)),
    )


@dataclass(frozen=True, eq=False)
class Part:
    """A move that moves: its leg (of joints where `kinematics` is None), or the circle through `via`."""

    index: int
    move: Move
    leg: Leg
    kinematics: Kinematics | None
    via: np.ndarray | None = None

    @property
    def settings(self) -> Pdl2Settings:
        return Pdl2Settings.of(self.move.settings)

    @property
    def turns_only(self) -> bool:
        return self.leg.length < _NOTHING


class PartMaker:
    """Makes the parts of one robot's moves; keeps the kinematics of every tool it has met."""

    def __init__(self, robot: RobotDescription, law: InterpolationLaw) -> None:
        self.robot, self.law = robot, law
        self._of_tool: dict[object, Kinematics] = {None: kinematics_for(robot)}

    def flies_on(self, last: Part, move: Move) -> bool:
        """Whether a move has the space and the tool of the part before it."""
        same_space = (move.type is MoveType.JOINT) == (last.kinematics is None)
        return same_space and move.settings.tool == last.move.settings.tool

    def part(self, index: int, move: Move, before: Part | None, q: np.ndarray) -> Part | None:
        """The part of a move that follows `before`, or starts from a standstill at joints q (n,); None without motion.

        Raises:
            MotionError: out of reach, beyond a joint limit, or what this controller has not.
        """
        kinematics = self.kinematics(move.settings)
        none = Rotation.identity()
        if move.type is MoveType.JOINT:
            scale = self.robot.max_velocity
            start = q if before is None else before.leg.end * scale
            end = self._joints(index, move, kinematics, start)
            if np.max(np.abs(end - start)) < _NOTHING:
                return None
            return Part(index, move, Leg(start / scale, end / scale, none, np.zeros(3)), None)
        orientation = Pdl2Settings.of(move.settings).orientation
        if orientation not in (OrientationType.RS_WORLD, OrientationType.RS_TRAJ):
            raise MotionError(f"this controller has no $ORNT_TYPE {orientation.value}", index, "orientation", 1.0)
        if before is None:
            pose = kinematics.forward(q[None])[0]
            place, rotation = pose[:3, 3], Rotation.from_matrix(pose[:3, :3])
        else:
            place, rotation = before.leg.end, before.leg.turn * Rotation.from_rotvec(before.leg.by)
        goal = self._pose(move.target, kinematics)
        leg = Leg(place, goal[:3, 3], rotation, (rotation.inv() * Rotation.from_matrix(goal[:3, :3])).as_rotvec())
        via = None
        if move.type is MoveType.CIRCULAR:
            if move.via is None or arc(place, self._pose(move.via, kinematics)[:3, 3], leg.end, np.zeros(1)) is None:
                raise MotionError("start, VIA and target give no circle", index, "circle", 1.0)
            via = self._pose(move.via, kinematics)[:3, 3]
        moves = max(leg.length, float(np.linalg.norm(leg.by))) >= _NOTHING
        return Part(index, move, leg, kinematics, via) if moves else None

    def _pose(self, target: Target, kinematics: Kinematics) -> np.ndarray:
        if isinstance(target, JointTarget):
            return kinematics.forward(np.asarray(target.position, dtype=float)[None])[0]
        return np.asarray(target.pose, dtype=float)

    def _joints(self, index: int, move: Move, kinematics: Kinematics, start: np.ndarray) -> np.ndarray:
        try:
            if isinstance(move.target, CartesianTarget):
                flags = move.target.configuration
                goal = move.target.pose
                end = kinematics.solve_configuration(goal, flags) if flags else kinematics.solve(goal, start)
            else:
                end = np.asarray(move.target.position, dtype=float)
        except KinematicsError as error:
            raise MotionError(str(error), index, error.reason, error.excess) from None
        if not Pdl2Settings.of(move.settings).multi_turn:
            lower, upper = self.robot.position_limits
            turning = np.array([not joint.prismatic for joint in self.robot.joints]) & (upper - lower > 2 * np.pi)
            end = np.where(turning, start + (end - start + np.pi) % (2 * np.pi) - np.pi, end)
        if not kinematics.within_limits(end[None])[0]:
            raise MotionError("the target is beyond a joint limit", index, "position", 0.1)
        return end

    def kinematics(self, settings: MotionSettings) -> Kinematics:
        """With the tool of these settings."""
        if settings.tool not in self._of_tool:
            self._of_tool[settings.tool] = kinematics_for(self.robot, Tool(frame=np.array(settings.tool)))
        return self._of_tool[settings.tool]

    def cut(self, first: Part, second: Part) -> float:
        """Length of either leg that the corner between them takes."""
        if first.via is not None or second.via is not None or first.turns_only or second.turns_only:
            return 0.0
        settings = first.settings
        angle = corner_angle(first.leg, second.leg)
        most = 0.5 * min(first.leg.length, second.leg.length)
        if angle > _SHARPEST:
            return 0.0
        if settings.fly_type is FlyType.FLY_NORM:
            speed = settings.speed_override * settings.arm_override
            braking = (
                0.05 * speed if first.kinematics is None else (settings.linear_speed * speed) ** 2 / self.law.linear / 2
            )
            most = min(most, settings.fly_percent / 100.0 * braking)
        match settings.fly_trajectory:
            case FlyTrajectory.FLY_PASS:
                return 0.0
            case FlyTrajectory.FLY_AUTO:
                return self.law.auto_cut * most
            case FlyTrajectory.FLY_FROM if first.kinematics is not None:
                return min(most, settings.fly_distance)
        if first.kinematics is not None:
            return min(most, settings.fly_distance / max(cut_off(angle, self.law.blend), 1e-9))
        return self._joint_cut(first, second, most)

    def _joint_cut(self, first: Part, second: Part, most: float) -> float:
        """The largest cut of a corner in joints whose tool stays within the FLY distance of the point."""
        scale, forward = self.robot.max_velocity, self.kinematics(first.move.settings).forward
        point = forward((first.leg.end * scale)[None])[0, :3, 3]
        cut = most
        for _ in range(12):
            places = corner(first.leg, second.leg, cut, self.law.blend)[1] * scale
            off = np.linalg.norm(forward(places)[:, :3, 3] - point, axis=1).min()
            if off <= first.move.settings.fly_distance:
                return cut
            cut *= 0.7
        return 0.0

    def programmed(self, part: Part) -> float:
        """Speed along the way that a move's settings ask for and the tool's limits allow."""
        settings = part.settings
        override = settings.speed_override * settings.arm_override
        if part.kinematics is None:
            return override / float(np.abs(part.leg.direction).max())
        length, angle = part.leg.length, float(np.linalg.norm(part.leg.by))
        metres = 0.0 if part.turns_only else 1.0
        turning = angle / length if metres else 1.0
        linear, rotational = settings.linear_speed, settings.rotational_speed
        by_turning = rotational / turning if turning > 0 else np.inf
        match settings.speed_option:
            case SpeedOption.SPD_LIN:
                asked = linear if metres else by_turning
            case SpeedOption.SPD_ROT:
                asked = by_turning if turning > 0 else linear
            case SpeedOption.SPD_CONST:
                asked = min(linear, by_turning) if metres else by_turning
            case _:
                asked = np.inf
        asked *= override
        if self.robot.cartesian_limits is not None:
            tcp = self.robot.cartesian_limits
            asked = min(asked, tcp.linear_speed if metres else np.inf)
            asked = min(asked, tcp.rotational_speed / turning if turning > 0 else np.inf)
        return float(asked)
