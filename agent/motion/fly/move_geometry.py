"""The geometry of one move, over a parameter σ from 0 (its start) to 1 (its target)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agent.compiled import quaternion_products
from agent.motion import rotation
from agent.motion.path_settings import PathSettings
from agent.robot import Kinematics

#: [m/rad] converts a rotation into travel, where a move does little but rotate.
ROTATION_LEVER = 0.1


@dataclass(frozen=True, eq=False)
class Line:
    """A straight stretch of the TCP between two points (3,) [m]."""

    start: np.ndarray
    end: np.ndarray

    @cached_property
    def way(self) -> np.ndarray:
        """(3,) from start to end [m]."""
        return self.end - self.start

    @cached_property
    def length(self) -> float:
        """[m]"""
        return rotation.length(self.way)

    @property
    def last(self) -> np.ndarray:
        """(3,) [m] the position at σ = 1."""
        return self.start + self.way

    def position(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 3) [m]"""
        return self.start + sigma[:, None] * self.way

    def derivative(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 3) dp/dσ [m]"""
        return np.broadcast_to(self.way, (len(sigma), 3))

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """dp/dσ (3,) at start and end."""
        return self.way, self.way

    def path_frame(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 4) rotation of the tangent since the start: none."""
        return np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), (len(sigma), 4))


@dataclass(frozen=True, eq=False)
class Arc:
    """A circular arc of the TCP: centre, unit normal, radius vector at the start (3,) [m], angle [rad] > 0."""

    centre: np.ndarray
    normal: np.ndarray
    radius: np.ndarray
    angle: float

    @cached_property
    def length(self) -> float:
        """[m]"""
        return float(np.linalg.norm(self.radius) * self.angle)

    @property
    def last(self) -> np.ndarray:
        """(3,) [m] the position at σ = 1."""
        return self.position(np.ones(1))[0]

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """dp/dσ (3,) at start and end."""
        start, other = self.derivative(np.array([0.0, 1.0]))
        return start, other

    def position(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 3) [m]"""
        angle = sigma[:, None] * self.angle
        return self.centre + np.cos(angle) * self.radius + np.sin(angle) * np.cross(self.normal, self.radius)

    def derivative(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 3) dp/dσ [m]"""
        angle = sigma[:, None] * self.angle
        side = np.cross(self.normal, self.radius)
        return self.angle * (np.cos(angle) * side - np.sin(angle) * self.radius)

    def path_frame(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 4) rotation of the tangent since the start."""
        return rotation.about(self.normal, sigma * self.angle)


def arc_through(start: np.ndarray, via: np.ndarray, end: np.ndarray) -> Arc | None:
    """The arc from start over via to end (3,); None where the three points lie on a line or coincide."""
    a, b = via - start, end - start
    normal = np.cross(a, b)
    size = float(np.linalg.norm(normal))
    if size < 1e-6 * np.linalg.norm(a) * np.linalg.norm(b) or size < 1e-12:
        return None
    to_centre = (np.dot(a, a) * np.cross(b, normal) + np.dot(b, b) * np.cross(normal, a)) / (2.0 * size**2)
    normal = normal / size
    radius = -to_centre
    chord = end - start - to_centre
    angle = np.arctan2(np.dot(np.cross(radius, chord), normal), np.dot(radius, chord)) % (2.0 * np.pi)
    return Arc(start + to_centre, normal, radius, float(angle))


@dataclass(frozen=True, eq=False)
class SingleAxis:
    """$ORNT_TYPE RS_WORLD and RS_TRAJ: rotation about one axis (3,) by `angle` [rad], from `start` (4,).

    In the world, or with a `curve` relative to the tangent of that path.
    """

    start: np.ndarray
    axis: np.ndarray
    angle: float
    curve: Line | Arc | None = None

    @property
    def last(self) -> np.ndarray:
        """(4,) the orientation at σ = 1."""
        if self.curve is not None:
            return self.orientation(np.ones(1))[0]
        return rotation.multiply(rotation.about(self.axis, np.array(self.angle)), self.start)

    def orientation(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 4) unit quaternions."""
        turned = quaternion_products(rotation.about(self.axis, sigma * self.angle), self.start[None])
        return turned if self.curve is None else rotation.multiply(self.curve.path_frame(sigma), turned)


@dataclass(frozen=True, eq=False)
class EulerAngles:
    """$ORNT_TYPE EUL_WORLD: the three Euler ZYZ angles change in proportion, each the shorter way round."""

    start: np.ndarray
    change: np.ndarray
    world: np.ndarray

    @property
    def last(self) -> np.ndarray:
        """(4,) the orientation at σ = 1."""
        return self.orientation(np.ones(1))[0]

    def orientation(self, sigma: np.ndarray) -> np.ndarray:
        """(S, 4) unit quaternions in the robot's base."""
        return rotation.multiply(self.world, rotation.from_euler(self.start + sigma[:, None] * self.change))


def single_axis(start: np.ndarray, end: np.ndarray, curve: Line | Arc | None = None) -> SingleAxis:
    """Rotation between two quaternions (4,); `curve` makes it relative to that path's tangent."""
    if curve is not None:
        end = rotation.multiply(rotation.conjugate(curve.path_frame(np.ones(1))[0]), end)
    vector = rotation.rotation_vector(rotation.multiply(end, rotation.conjugate(start)))
    angle = rotation.length(vector)
    return SingleAxis(start, vector / angle if angle > 0 else vector, angle, curve)


def euler_angles(start: np.ndarray, end: np.ndarray, world: np.ndarray) -> EulerAngles:
    """Rotation between two quaternions (4,) by Euler angles in the world, where the base stands as `world` (4,)."""
    first, last = (rotation.to_matrix(rotation.multiply(world, q)) for q in (start, end))
    a, b = rotation.to_euler(first), rotation.to_euler(last)
    # Where the middle angle is 0 or π only the sum (difference) of the others is defined: the other end says which.
    for angles, other in ((a, b), (b, a)):
        if np.sin(angles[1]) < 1e-9:
            angles[2] += (angles[0] - other[0]) * np.sign(np.cos(angles[1]))
            angles[0] = other[0]
    change = b - a
    change[[0, 2]] = (change[[0, 2]] + np.pi) % (2.0 * np.pi) - np.pi
    return EulerAngles(a, change, rotation.conjugate(world))


@dataclass(frozen=True, eq=False)
class CartesianSegment:
    """A LINEAR or CIRCULAR move with a prescribed orientation. `move` indexes its statement, `label` names it.

    `configuration` is what $CNFG_CARE and $TURN_CARE ask for at the target, empty where they ask for nothing. `ends`
    (2, n) are the joints at start and target of an arm that has more than the pose needs (else None): of the joints
    that give a pose it takes those nearest to the straight way between them in joint space, so it arrives at both.
    `lever` [m/rad]: what its rotation counts for where it does little else.
    """

    move: int
    label: str
    settings: PathSettings
    kinematics: Kinematics
    curve: Line | Arc
    turn: SingleAxis | EulerAngles
    configuration: str = ""
    ends: np.ndarray | None = None
    lever: float = ROTATION_LEVER

    def near(self, sigma: np.ndarray) -> np.ndarray | None:
        """(S, n) the straight line in joint space; None where the pose determines the joints."""
        return None if self.ends is None else self.ends[0] + sigma[:, None] * (self.ends[1] - self.ends[0])

    @cached_property
    def angle(self) -> float:
        """Angle that the orientation covers [rad]."""
        if isinstance(self.turn, SingleAxis) and self.turn.curve is None:
            return self.turn.angle
        q = self.turn.orientation(np.linspace(0.0, 1.0, 9))
        cosines = np.abs(np.einsum("si,si->s", q[1:], q[:-1]))
        return float(2.0 * np.sum(np.arccos(np.minimum(cosines, 1.0))))

    @cached_property
    def turning(self) -> float:
        """[m] what the rotation adds to the path: 0 where the TCP travels enough to measure the path by its length."""
        return self.lever * self.angle if self.curve.length < 0.5 * self.lever * self.angle else 0.0

    @cached_property
    def extent(self) -> float:
        """[m] size of the move: its TCP length, or its rotation times a lever where it does little else."""
        return float(np.hypot(self.curve.length, self.turning))

    @property
    def metric(self) -> float:
        """Change of the path parameter s over the move [m]."""
        return self.extent


@dataclass(frozen=True, eq=False)
class JointSegment:
    """A JOINT move: all joints (n,) start and stop together.

    `metric` is the change of the path parameter s over the move: its duration at the joints' full speed [s].
    """

    move: int
    label: str
    settings: PathSettings
    kinematics: Kinematics
    start: np.ndarray
    end: np.ndarray
    metric: float

    @cached_property
    def extent(self) -> float:
        """[m] length of the TCP's path, or the largest joint change times a lever where the TCP hardly moves."""
        sigma = np.linspace(0.0, 1.0, 9)[:, None]
        points = self.kinematics.forward(self.start + sigma * (self.end - self.start))[:, :3, 3]
        travel = float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        return max(travel, ROTATION_LEVER * float(np.max(np.abs(self.end - self.start))))


Segment = CartesianSegment | JointSegment


def label_of(segments: Sequence[Segment], move: int) -> str:
    """How messages name a statement, by its index."""
    return next((segment.label for segment in segments if segment.move == move), segments[0].label)
