"""Distances between the bodies of an arm, its tool and boxes of its cell (Pinocchio's collision geometry).

Beside `dynamics` the only module that imports Pinocchio (docs/decisions/cell-check.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import coal
import numpy as np
import pinocchio as pin

from agent.robot.description import Box, Capsule, RobotDescription
from agent.robot.dynamics import Dynamics, frame_id, pinocchio_model
from agent.robot.kinematics.chain import joint_axes

#: Name of a box in a pair: this and the box's own name.
KEEP_OUT = "keep-out "
#: Taken for the travel of a prismatic joint without limits [m].
ENDLESS_STROKE = 100.0


@dataclass(frozen=True)
class Body:
    """Capsules that move with one link; `name` is what messages call it, `frame` the URDF link they are given in."""

    name: str
    frame: str
    capsules: tuple[Capsule, ...]


@dataclass(frozen=True, eq=False)
class BodyPair:
    """Two bodies, or a body and a box, by name. `reach` (n,): largest approach speed per joint rate [m/rad].

    Joint i changes no distance between the two faster than `reach[i]` times its own speed, whatever the posture.
    """

    first: str
    second: str
    reach: np.ndarray


class CollisionModel:
    """The pairs of bodies that can come nearer to each other, and how far apart they are. Not thread-safe.

    Left out are pairs that no joint or a single joint separates: that joint holds them together, near each other.
    """

    def __init__(self, robot: RobotDescription, bodies: Sequence[Body], boxes: Sequence[Box]):
        self._model = pinocchio_model(robot)
        self._data = self._model.createData()
        self._geometry = pin.GeometryModel()
        self._prismatic = np.array([joint.prismatic for joint in robot.joints])
        self._axes = joint_axes(robot)
        # Origin of each joint's frame in that of the joint before, the base for the first.
        self._origins = np.array([placement.translation for placement in list(self._model.jointPlacements)[1:]])
        self._lengths = np.linalg.norm(self._origins, axis=1)
        strokes = np.max(np.abs(robot.position_limits), axis=0)
        self._strokes = np.where(self._prismatic, np.where(np.isfinite(strokes), strokes, ENDLESS_STROKE), 0.0)
        self._shapes: dict[str, list[int]] = {}
        for body in bodies:
            frame = self._model.frames[frame_id(self._model, body.frame)]
            self._shapes[body.name] = [self._add_capsule(body.name, frame, capsule) for capsule in body.capsules]
        joints = {
            name: int(self._geometry.geometryObjects[shapes[0]].parentJoint) for name, shapes in self._shapes.items()
        }
        pairs = [(a, b) for a, b in combinations(joints, 2) if abs(joints[a] - joints[b]) > 1]
        for box in boxes:
            name = f"{KEEP_OUT}{box.name}"
            lower, upper = np.array(box.minimum, dtype=float), np.array(box.maximum, dtype=float)
            centre = pin.SE3(np.eye(3), (lower + upper) / 2)
            self._shapes[name] = [self._add(name, 0, centre, coal.Box(*(upper - lower)))]
            pairs += [(body, name) for body, joint in joints.items() if joint > 0]
        self._set_pairs(pairs)

    def leave_out(self, pairs: Sequence[BodyPair]) -> None:
        """Consider these pairs no longer."""
        self._geometry.removeAllCollisionPairs()
        self._set_pairs([(pair.first, pair.second) for pair in self.pairs if pair not in pairs])

    def distances(self, q: np.ndarray, wanted: np.ndarray | None = None) -> np.ndarray:
        """(S, pairs) distance between the surfaces [m] at joint positions (S, n); negative is how deep they overlap.

        `wanted` (pairs,): the pairs to measure, the others are given as infinitely far.
        """
        wanted = np.ones(len(self.pairs), dtype=bool) if wanted is None else wanted
        measured = np.flatnonzero(wanted[self._of_shapes])
        for k, is_wanted in enumerate(wanted[self._of_shapes]):
            self._distances.activeCollisionPairs[k] = bool(is_wanted)
        shapes = np.full((len(q), len(self._of_shapes)), np.inf)
        results = [self._distances.distanceResults[int(k)] for k in measured]
        for k in range(len(q)):
            pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._distances, q[k])
            pin.computeDistances(self._geometry, self._distances)
            shapes[k, measured] = [result.min_distance for result in results]
        starts = np.flatnonzero(np.diff(self._of_shapes, prepend=-1))
        return np.minimum.reduceat(shapes, starts, axis=1)

    def _set_pairs(self, names: Sequence[tuple[str, str]]) -> None:
        pairs: list[BodyPair] = []
        of_shapes: list[int] = []
        for first, second in names:
            shapes = [(a, b) for a in self._shapes[first] for b in self._shapes[second]]
            for a, b in shapes:
                self._geometry.addCollisionPair(pin.CollisionPair(a, b))
            of_shapes += [len(pairs)] * len(shapes)
            pairs.append(BodyPair(first, second, np.max([self._reach(a, b) for a, b in shapes], axis=0)))
        self.pairs: tuple[BodyPair, ...] = tuple(pairs)
        self._of_shapes = np.array(of_shapes, dtype=int)
        self._distances = self._geometry.createData()

    def _add_capsule(self, name: str, frame: pin.Frame, capsule: Capsule) -> int:
        start, end = np.array(capsule.start), np.array(capsule.end)
        length = float(np.linalg.norm(end - start))
        if length < 1e-9:
            return self._add(
                name, frame.parentJoint, frame.placement * pin.SE3(np.eye(3), start), coal.Sphere(capsule.radius)
            )
        along = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), (end - start) / length).matrix()
        placement = frame.placement * pin.SE3(along, (start + end) / 2)
        return self._add(name, frame.parentJoint, placement, coal.Capsule(capsule.radius, length))

    def _add(self, name: str, joint: int, placement: pin.SE3, shape: coal.CollisionGeometry) -> int:
        unique = f"{name}#{self._geometry.ngeoms}"
        return self._geometry.addGeometryObject(pin.GeometryObject(unique, joint, placement, shape))

    def _reach(self, first: int, second: int) -> np.ndarray:
        """(n,) bound on the change of distance per change of each joint.

        Turning joint i by δ moves a point at distance r from its axis by at most r δ. Seen from either of the two
        bodies it is the other one that moves, so the smaller r of the two holds.
        """
        inner, outer = sorted((first, second), key=lambda k: self._geometry.geometryObjects[k].parentJoint)
        low, high = (self._geometry.geometryObjects[k].parentJoint for k in (inner, outer))
        reach = np.zeros(self._model.nv)
        for joint in range(low + 1, high + 1):
            if self._prismatic[joint - 1]:
                reach[joint - 1] = 1.0
                continue
            reach[joint - 1] = self._outwards(joint, high, outer)
            if low > 0:
                reach[joint - 1] = min(reach[joint - 1], self._inwards(joint, low, inner))
        return reach

    def _outwards(self, joint: int, last: int, shape: int) -> float:
        """Farthest from a joint's axis that a shape on joint `last` gets: over the joints between, stretched out."""
        ends = self._ends(shape)
        if joint == last:
            return self._from_axis(joint, ends)
        beyond = self._lengths[joint + 1 : last].sum() + np.linalg.norm(ends, axis=1).max()
        return float(self._from_axis(joint, self._origins[joint][None]) + beyond + self._strokes[joint:last].sum())

    def _inwards(self, joint: int, first: int, shape: int) -> float:
        """The same the other way, for a shape on joint `first` before the joint."""
        back = list(self._model.jointPlacements)[joint].inverse()
        ends = self._ends(shape)
        if joint == first + 1:
            return self._from_axis(joint, ends @ back.rotation.T + back.translation)
        beyond = self._lengths[first : joint - 1].sum() + np.linalg.norm(ends, axis=1).max()
        return float(self._from_axis(joint, back.translation[None]) + beyond + self._strokes[first : joint - 1].sum())

    def _from_axis(self, joint: int, points: np.ndarray) -> float:
        """Largest distance of points (m, 3), given in a joint's frame, from its axis."""
        axis = self._axes[joint - 1]
        return float(np.linalg.norm(points - np.outer(points @ axis, axis), axis=1).max())

    def _ends(self, shape: int) -> np.ndarray:
        """(2, 3) ends of a capsule's axis in the frame of its joint; no point of it is farther from anything."""
        body = self._geometry.geometryObjects[shape]
        half = getattr(body.geometry, "halfLength", 0.0) * body.placement.rotation[:, 2]
        return np.array([body.placement.translation + half, body.placement.translation - half])


def skeleton(robot: RobotDescription, radius: float) -> tuple[Body, ...]:
    """A capsule for each link from its own joint to the next one, for an arm whose description has no bodies."""
    return tuple(
        Body(f"link of {name}", name, (Capsule((0.0, 0.0, 0.0), (float(x), float(y), float(z)), radius),))
        for name, (x, y, z) in zip(robot.joint_names, Dynamics(robot).link_ends(), strict=True)
    )
