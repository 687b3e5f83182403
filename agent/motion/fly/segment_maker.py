"""From the statements of a program to segments: frames, targets and curves resolved, settings checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from agent.core import InputError
from agent.motion import rotation
from agent.motion.fly.move_geometry import (
    Arc,
    CartesianSegment,
    EulerAngles,
    JointSegment,
    Line,
    Segment,
    SingleAxis,
    arc_through,
    euler_angles,
    single_axis,
)
from agent.motion.fly.path import motion_error, solve_cartesian
from agent.motion.interpolator import MotionError
from agent.motion.path_settings import OrientationType, PathSettings
from agent.motion.program import (
    CartesianTarget,
    Frame,
    JointTarget,
    MotionSettings,
    Move,
    MoveType,
    Target,
    frame_of,
    matrix_of,
    pose_in_robot_base,
    tool_frame,
)
from agent.robot import Kinematics, KinematicsError, RobotDescription, kinematics_for

if TYPE_CHECKING:
    from agent.robot import Tool

#: Moves shorter than this in every respect [m, rad] are no motion.
_NOTHING = 1e-9
#: Step of the sweep that finds the arm's joints at the end of moves not yet planned [m, rad].
_SWEEP = 0.02

_PERCENTAGES = ("fly_percent", "stress_percent")
_OVERRIDES = ("speed_override", "acceleration_override", "deceleration_override", "arm_override")
_SPEEDS = ("linear_speed", "rotational_speed")


class SegmentMaker:
    """Makes segments for one arm; keeps the kinematics of every tool it has met.

    `lever` [m/rad]: what the rotation of a Cartesian move counts for where it does little else.
    """

    def __init__(self, robot: RobotDescription, tool: Tool | None, lever: float):
        self.robot = robot
        self._lever = lever
        self._speeds = robot.max_velocity
        lower, upper = robot.position_limits
        prismatic = np.array([joint.prismatic for joint in robot.joints])
        self._turning = ~prismatic & (upper - lower > 2 * np.pi)
        self.kinematics = kinematics_for(robot, tool)
        own = frame_of(tool_frame(tool))
        self._of_tool: dict[Frame | None, Kinematics] = {None: self.kinematics, own: self.kinematics}

    def checked_start(self, start: np.ndarray) -> np.ndarray:
        """The start (n,) as floats.

        Raises:
            InputError: not n finite numbers.
        """
        q = np.asarray(start, dtype=float)
        if q.shape != (self.robot.dof,) or not np.isfinite(q).all():
            raise InputError(f"start of the motion: {self.robot.dof} finite joint positions are needed, not {start}")
        return q

    def pose_at(self, q: np.ndarray) -> np.ndarray:
        """(7,) position [m] and orientation (unit quaternion) of the interpolator's own TCP at joints (n,)."""
        return np.concatenate(_pose_of(self.kinematics, q))

    def segment(self, index: int, move: Move, pending: Sequence[Segment], stop: np.ndarray) -> Segment | None:
        """The segment of a move that follows `pending` ones, from a stop at `stop` (n,); None where it moves nothing.

        Raises:
            MotionError: a target out of reach or beyond a joint limit, three points that make no circle.
            InputError: settings that make no sense.
        """
        label = _label(index, move)
        settings = PathSettings.of(move.settings)
        _check(settings, label)
        kinematics = self._with_tool(settings)
        if move.type is MoveType.JOINT:
            start = _end_joints(pending, stop)
            end = self._joints(index, label, move, kinematics, start)
            if not settings.multi_turn:
                end = np.where(self._turning, start + (end - start + np.pi) % (2 * np.pi) - np.pi, end)
            if np.max(np.abs(end - start)) < _NOTHING:
                return None
            duration = float(np.max(np.abs(end - start) / self._speeds))
            return JointSegment(index, label, settings, kinematics, start, end, duration)
        return self._cartesian(index, label, move, kinematics, pending, stop)

    def _cartesian(
        self, index: int, label: str, move: Move, kinematics: Kinematics, pending: Sequence[Segment], stop: np.ndarray
    ) -> Segment | None:
        settings = PathSettings.of(move.settings)
        style = settings.orientation
        if style is OrientationType.WRIST_JNT:
            reason = "$ORNT_TYPE WRIST_JNT is not planned; use RS_WORLD, or MOVE JOINT through the singularity"
            raise MotionError(f"{label}: {reason}", index, "orientation", 1.0)
        start, start_turn = self._end_pose(pending, stop, kinematics)
        end, end_turn = self._pose(label, move.target, move.settings, kinematics)
        curve: Line | Arc = Line(start, end)
        if move.type is MoveType.CIRCULAR:
            curve = self._arc(index, label, move, kinematics, start, end)
        if style is OrientationType.EUL_WORLD:
            world = rotation.from_matrix(matrix_of(move.settings.base)[:3, :3])
            orientation: SingleAxis | EulerAngles = euler_angles(start_turn, end_turn, world)
        else:
            along = isinstance(curve, Arc) and style is OrientationType.RS_TRAJ
            orientation = single_axis(start_turn, end_turn, curve if along else None)
        careful = settings.configuration_care or settings.turn_care
        flags = move.target.configuration if careful and isinstance(move.target, CartesianTarget) else ""
        segment = CartesianSegment(index, label, settings, kinematics, curve, orientation, flags, lever=self._lever)
        if self.robot.dof > 6:
            segment = replace(segment, ends=self._ends(segment, move.target, _end_joints(pending, stop)))
        return None if segment.curve.length < _NOTHING and segment.angle < _NOTHING else segment

    def _ends(self, segment: CartesianSegment, target: Target, start: np.ndarray) -> np.ndarray:
        """(2, n) joints at start and target; where the target is a pose, those that the least motion leads to."""
        if isinstance(target, JointTarget):
            return np.array([start, self._joint_target(segment.label, target)])
        return np.array([start, _end_of_sweep(segment, start)])

    def _end_pose(
        self, pending: Sequence[Segment], stop: np.ndarray, kinematics: Kinematics
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the TCP after the pending moves: exactly the last target where that has the same TCP."""
        if pending and isinstance(pending[-1], CartesianSegment) and pending[-1].kinematics is kinematics:
            return pending[-1].curve.last, pending[-1].turn.last
        return _pose_of(kinematics, _end_joints(pending, stop))

    def _arc(
        self, index: int, label: str, move: Move, kinematics: Kinematics, start: np.ndarray, end: np.ndarray
    ) -> Arc:
        if move.via is None:
            raise InputError(f"{label}: a CIRCULAR move needs a VIA point")
        via = self._pose(label, move.via, move.settings, kinematics)[0]
        arc = arc_through(start, via, end)
        if arc is None:
            raise MotionError(
                f"{label}: start, VIA and target lie on one line or coincide, so they give no circle; "
                "move the VIA point or use LINEAR",
                index,
                "circle",
                1.0,
            )
        return arc

    def _joints(self, index: int, label: str, move: Move, kinematics: Kinematics, start: np.ndarray) -> np.ndarray:
        if isinstance(move.target, JointTarget):
            return self._joint_target(label, move.target)
        pose = rotation.to_pose(*self._pose(label, move.target, move.settings, kinematics))
        try:
            if move.target.configuration:
                return kinematics.solve_configuration(pose, move.target.configuration)
            return kinematics.solve(pose, start)
        except KinematicsError as error:
            raise motion_error(error, index, label) from None

    def _joint_target(self, label: str, target: JointTarget) -> np.ndarray:
        q = np.asarray(target.position, dtype=float)
        if q.shape != (self.robot.dof,) or not np.isfinite(q).all():
            raise InputError(
                f"{label}: a JOINTPOS of this arm has {self.robot.dof} finite values, not {target.position}"
            )
        return q

    def _pose(
        self, label: str, target: Target, settings: MotionSettings, kinematics: Kinematics
    ) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and orientation (4,) of the TCP in the robot's base."""
        if isinstance(target, JointTarget):
            pose = kinematics.forward(self._joint_target(label, target)[None])[0]
        else:
            target_pose = np.asarray(target.pose, dtype=float)
            if target_pose.shape != (4, 4) or not np.isfinite(target_pose).all():
                raise InputError(f"{label}: the target is not a pose of finite numbers")
            if not rotation.is_rotation(target_pose[:3, :3]):
                raise InputError(f"{label}: the target's orientation is not a rotation")
            pose = pose_in_robot_base(target, settings)
        return pose[:3, 3].copy(), rotation.from_matrix(pose[:3, :3])

    def _with_tool(self, settings: MotionSettings) -> Kinematics:
        if settings.tool not in self._of_tool:
            from agent.robot import Tool  # loads Pinocchio

            self._of_tool[settings.tool] = kinematics_for(self.robot, Tool(frame=matrix_of(settings.tool)))
        return self._of_tool[settings.tool]


def _pose_of(kinematics: Kinematics, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) [m] and orientation (4,) of the TCP at joints (n,)."""
    pose = kinematics.forward(q[None])[0]
    return pose[:3, 3].copy(), rotation.from_matrix(pose[:3, :3])


def _end_joints(pending: Sequence[Segment], stop: np.ndarray) -> np.ndarray:
    """Joints (n,) at the end of the pending moves: given by the last one, or found by sweeping the Cartesian ones."""
    trailing: list[CartesianSegment] = []
    for segment in reversed(pending):
        if not isinstance(segment, CartesianSegment):
            break
        trailing.insert(0, segment)
    first = len(pending) - len(trailing)
    q = stop if first == 0 else pending[first - 1].end  # type: ignore[union-attr]
    for segment in trailing:
        q = _end_of_sweep(segment, q) if segment.ends is None else segment.ends[1]
    return q


def _end_of_sweep(segment: CartesianSegment, q: np.ndarray, step: float = _SWEEP) -> np.ndarray:
    count = int(np.clip((segment.curve.length + segment.angle) / step, 2, 5000)) + 1
    sigma, move = np.linspace(0.0, 1.0, count), np.full(count, segment.move)
    try:
        return solve_cartesian([segment], move, segment.curve.position(sigma), segment.turn.orientation(sigma), q)[-1]
    except MotionError as error:
        if error.limit != "branch" or step < _SWEEP:
            raise
        return _end_of_sweep(segment, q, 0.1 * _SWEEP)  # joints may turn fast near a singularity without crossing it


def _label(index: int, move: Move) -> str:
    names = [part for part in (move.name, f"line {move.line}" if move.line else "") if part]
    return f"statement {index + 1}" + (f" ({', '.join(names)})" if names else "")


def _check(settings: PathSettings, label: str) -> None:
    for name in _SPEEDS:
        if not 0.0 < getattr(settings, name) < np.inf:
            raise InputError(f"{label}: {name} is {getattr(settings, name)}; it has to be positive")
    for name in _PERCENTAGES:
        if not 1.0 <= getattr(settings, name) <= 100.0:
            raise InputError(f"{label}: {name} is {getattr(settings, name)}; it has to be 1 to 100 percent")
    for name in _OVERRIDES:
        if not 0.0 < getattr(settings, name) <= 1.0:
            raise InputError(f"{label}: {name} is {getattr(settings, name)}; it has to be more than 0 and at most 1")
    if not 0.0 <= settings.fly_distance < np.inf:
        raise InputError(f"{label}: fly_distance is {settings.fly_distance} m; it cannot be negative")
