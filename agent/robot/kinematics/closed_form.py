"""What the kinematics of arms with eight closed-form branches have in common: shoulder, elbow and wrist, two ways each.

A branch is three signs. Each belongs to a distance from a singularity that is zero where its two ways meet: the reach
of the wrist in the plane of the arm, the sine of the elbow, and the sine of the wrist.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any, NoReturn

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.kinematics.base import (
    LARGEST_STEP,
    SINGULAR_DISTANCE,
    InverseSolutions,
    Kinematics,
    KinematicsError,
    pose_error,
    position_text,
    singular,
)
from agent.robot.kinematics.chain import KinematicChain

#: Signs of shoulder, elbow and wrist, in the order of the branches of `inverse`.
BRANCHES = tuple(product((1, -1), repeat=3))
_SIGNS = np.array(BRANCHES, dtype=float).T
SINGULARITIES = ("shoulder", "elbow", "wrist")
_BEYOND = -2e-9  # a squared margin below this is out of reach, above it round-off at the border
_BEND = 0.15  # least sin γ Newton steps begin with; of 1 500 random arms 3 fail at 0.05, 0 at 0.1 to 0.2, 161 at 0.3
_REACHED, _NEARLY = 1e-9, 1e-5  # m and rad: Newton steps that leave more have not converged, or do not converge


class AtZero:
    """An arm of six revolute joints at zero: axes and points (6, 3) of its joints and `tcp` (4, 4), in the base frame.

    `base` (3, 3) and `origin` (3,) are frame B (see `ArmGeometry`), for axes that are within `tolerance` [rad, or as
    part of the arm's size] of what a closed form needs.
    """

    def __init__(self, chain: KinematicChain, tolerance: float):
        self.axes, self.points, self.tcp = chain.axes_at_zero()
        self.size = float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())
        self.tolerance = tolerance

    @cached_property
    def base(self) -> np.ndarray:
        axes, points = self.axes, self.points
        frame = frame_of(axes[0] if axes[0, 2] > -self.tolerance else -axes[0], axes[1])
        backwards = frame[:, 0] @ (points[1] - points[0]) < -self.tolerance * self.size
        return frame @ np.diag([-1.0, -1.0, 1.0]) if backwards else frame

    @cached_property
    def origin(self) -> np.ndarray:
        return np.asarray(self.points[0] + self.axes[0] * ((self.points[1] - self.points[0]) @ self.axes[0]))

    def nearest(self, axis: int) -> np.ndarray:
        """(3,) the point of an axis that is nearest to the next axis, which is perpendicular to it."""
        axes, points = self.axes, self.points
        return np.asarray(points[axis] + axes[axis] * ((points[axis + 1] - points[axis]) @ axes[axis]))

    def fits(
        self,
        end: np.ndarray,
        crossing: Sequence[int],
        parallel: Sequence[int],
        meeting: Sequence[tuple[int, np.ndarray]],
    ) -> bool:
        """Whether axes cross the next one at a right angle, are parallel to it, and pass through points (3,), and both
        the upper arm and the forearm, which leads to `end` (3,), have a length in the plane of the arm."""
        axes = self.axes
        off = [abs(axes[k] @ axes[k + 1]) for k in crossing]
        off += [np.linalg.norm(np.cross(axes[k], axes[k + 1])) for k in parallel]
        off += [np.linalg.norm(np.cross(axes[k], point - self.points[k])) / self.size for k, point in meeting]
        if max(off) > self.tolerance:
            return False
        long = np.diff([*self.points[1:3], end], axis=0) @ self.base
        return bool(np.all(np.hypot(long[:, 0], long[:, 2]) >= self.tolerance * self.size))


@dataclass(frozen=True, eq=False)
class ArmGeometry:
    """Constants of an arm whose axis 2 is across axis 1 and whose axis 3 is parallel to axis 2.

    Frame B stands on axis 1 at the height of axis 2, with y along axis 2 when q₁ = 0, and x forward: where axis 2 lies
    from axis 1 or, where they meet, where axis 2 leans an upright arm when it turns positively. Angles in its xz plane
    count from z towards x, as a rotation about y turns.

    shoulder_offset a₁: from axis 1 to axis 2; lateral_offset b: of the wrist centre along y; upper_arm l₂, forearm l₃
    [m]; upper_arm_angle and forearm_angle: of both at zero; senses: +1 or -1, how the first joints count against B's
    axes; wrist_angle: β at q₅ = 0; selection (12, 16): takes a flattened pose to the wrist's rotation in B (9, row by
    row) and the wrist centre in B (3). One kind of arm has a hand [m] between forearm and wrist centre, at hand_angle;
    the other a forearm_rotation (3, 3) from B to the wrist's axes (z axis 4, y axis 5).
    """

    shoulder_offset: float
    lateral_offset: float
    upper_arm: float
    forearm: float
    upper_arm_angle: float
    forearm_angle: float
    senses: tuple[float, ...]
    wrist_angle: float
    selection: np.ndarray
    hand: float = 0.0
    hand_angle: float = 0.0
    forearm_rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    @classmethod
    def of(
        cls,
        arm: AtZero,
        end: np.ndarray,
        centre: np.ndarray,
        wrist: np.ndarray,
        wrist_angle: float,
        **more: Any,
    ) -> ArmGeometry:
        """From an arm at zero, where its forearm ends, its wrist centre (3,), and the wrist's axes (3, 3) there.

        `more`: what only one kind of arm has.
        """
        axes, points, base = arm.axes, arm.points, arm.base
        upper_arm, forearm = base.T @ (points[2] - points[1]), base.T @ (end - points[2])
        selection = np.zeros((12, 16))
        entries = [0, 1, 2, 4, 5, 6, 8, 9, 10]  # of the rotation in a flattened pose
        selection[:9, entries] = np.kron(base.T, (arm.tcp[:3, :3].T @ wrist).T)
        selection[9:, entries] = -np.kron(base.T, arm.tcp[:3, :3].T @ (arm.tcp[:3, 3] - centre))
        selection[9:, [3, 7, 11]] = base.T
        selection[9:, 15] = -base.T @ arm.origin
        return cls(
            shoulder_offset=float((base.T @ (points[1] - arm.origin))[0]),
            lateral_offset=float((base.T @ (centre - arm.origin))[1]),
            upper_arm=float(np.hypot(upper_arm[0], upper_arm[2])),
            forearm=float(np.hypot(forearm[0], forearm[2])),
            upper_arm_angle=float(np.arctan2(upper_arm[0], upper_arm[2])),
            forearm_angle=float(np.arctan2(forearm[0], forearm[2])),
            senses=tuple(float(np.sign(axes[k] @ base[:, across])) for k, across in enumerate((2, 1, 1, 1))),
            wrist_angle=wrist_angle,
            selection=selection,
            **more,
        )

    @property
    def reach(self) -> float:
        """Length of the stretched arm from axis 2 to the end of the forearm [m]."""
        return self.upper_arm + self.forearm


class ClosedFormKinematics(Kinematics):
    """Eight branches in closed form: shoulder, elbow and wrist signs, in the order of `BRANCHES`.

    Newton steps remove what an arm that fits the form only nearly leaves of an error. `at_shoulder` and `at_wrist` say
    what is so in such a singularity.
    """

    at_shoulder = ": its wrist centre is on axis 1"
    at_wrist = ": it has axes 4 and 6 in line"

    def __init__(self, robot: RobotDescription, chain: KinematicChain, geometry: ArmGeometry):
        super().__init__(robot, chain)
        self._arm = geometry
        # Least sin² γ to begin with, and least squares of the distances from singularities for a branch to be tried.
        self._bend, self._least = 0.0, np.full(3, SINGULAR_DISTANCE**2)
        self._exact = self._is_exact()
        if not self._exact:
            self._bend, self._least[1] = _BEND**2, -_BEND

    def inverse(self, poses: np.ndarray) -> InverseSolutions:
        poses = np.asarray(poses, dtype=float)
        samples = len(poses)
        angles, squares = self._branch(np.repeat(self._wrist(poses), 8, axis=1), np.tile(_SIGNS, samples))
        q = self.nearest_turn(angles.T, self.middle).reshape(samples, 8, 6)
        margins = squares.T.reshape(samples, 8, 3)
        reached = np.all(margins >= _BEYOND, axis=2)
        valid = np.all(margins >= self._least, axis=2)
        if not self._exact:
            q[valid], valid[valid] = self._polish(np.repeat(poses, valid.sum(axis=1), axis=0), q[valid])
        q[~valid] = np.nan
        return InverseSolutions(
            q=q,
            valid=valid,
            within_limits=valid & self.within_limits(q),
            singular=reached & ~valid,
            unreachable=~(reached | valid).any(axis=1),
        )

    def follow(self, poses: np.ndarray, start: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        poses = np.asarray(poses, dtype=float)
        start = np.asarray(start, dtype=float)
        if len(poses) == 0:
            return np.empty((0, 6))
        distances = self._signed_distances(start[None])[:, 0]
        nearest = int(np.abs(distances).argmin())
        if abs(distances[nearest]) < SINGULAR_DISTANCE:
            raise singular(0, poses[0], float(abs(distances[nearest])), self._meanings[nearest], "the start")
        signs = tuple(int(sign) for sign in np.sign(distances))
        angles, margins = self._branch(self._wrist(poses), signs)
        if not (margins >= self._least[:, None]).all():
            self._raise_margin(poses, margins, signs)
        q, reached = self._polish(poses, np.ascontiguousarray(self._unwrapped(angles, start, poses).T))
        for index in np.flatnonzero(~reached):
            raise singular(int(index), poses[index], 0.0, ", or nearly so, in the arm's exact geometry")
        return q

    def find_on_branch(self, poses: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distances = self._signed_distances(seeds)
        # One by one: the last digit of a product depends on how many columns there are.
        wrist = np.concatenate([self._wrist(pose[None]) for pose in poses], axis=1)
        angles, margins = self._branch(wrist, np.sign(distances))
        solved = (margins >= self._least[:, None]).all(axis=0) & (np.abs(distances) >= SINGULAR_DISTANCE).all(axis=0)
        q = angles.T + 2 * np.pi * np.round((seeds - angles.T) / (2 * np.pi))
        q[solved], solved[solved] = self._polish(poses[solved], q[solved])
        q[solved] = self.turned_into_limits(q[solved])
        solved &= self.within_limits(q)
        if not solved.all():
            q[~solved], solved[~solved] = self.find(poses[~solved], seeds[~solved])
        return q, solved

    def singularity(self, q: np.ndarray) -> np.ndarray:
        """Distances in the order of `SINGULARITIES`.

        shoulder: reach of the wrist centre in the plane of the arm over the arm's length, 0 where axis 1 cannot move
        it across that plane; elbow: |sin γ|, 0 where stretched or folded; wrist: |sin β|, 0 where axes 4 and 6 are
        parallel (|sin q₅| on the NS16).
        """
        return np.abs(self._signed_distances(np.asarray(q, dtype=float))).T

    def branch(self, q: np.ndarray) -> tuple[int, int, int]:
        """Signs of shoulder, elbow and wrist at one configuration (n,)."""
        shoulder, elbow, wrist = (
            1 if value >= 0 else -1 for value in self._signed_distances(np.asarray(q)[None])[:, 0]
        )
        return shoulder, elbow, wrist

    @abstractmethod
    def _branch(self, wrist: np.ndarray, signs: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles (6, S) on one branch, and the squares (3, S) of the distances from its singularities.

        `wrist` (12, S) is that of `_wrist`; `signs` are those of one branch (3,), or of each pose's own (3, S). A
        negative square is out of reach, and its angles are those of the border.
        """

    def _signed_distances(self, q: np.ndarray) -> np.ndarray:
        """(3, S): radial reach over arm length, sin γ, sin β; their signs are the branch."""
        g = self._arm
        upper = g.upper_arm_angle + g.senses[1] * q[:, 1]
        elbow = g.senses[2] * q[:, 2] + g.forearm_angle - g.upper_arm_angle
        radial = g.shoulder_offset + g.upper_arm * np.sin(upper) + g.forearm * np.sin(upper + elbow)
        radial += g.hand * np.sin(upper + elbow + g.senses[3] * q[:, 3] + g.hand_angle - g.forearm_angle)
        return np.stack([radial / g.reach, np.sin(elbow), np.sin(q[:, 4] + g.wrist_angle)])

    def _from_axis_2(self, wrist: np.ndarray, signs: Sequence[int]) -> float:
        """How far [m] the end of the forearm is from axis 2, for one pose's wrist (12,)."""
        g = self._arm
        _, radial, cos1, sin1 = self._shoulder(wrist[9], wrist[10], signs[0])
        forward, up = cos1 * wrist[2] + sin1 * wrist[5], wrist[8]
        hand = g.hand * signs[2] / max(np.hypot(forward, up), np.finfo(float).tiny)
        return float(np.hypot(radial - g.shoulder_offset - hand * up, wrist[11] + hand * forward))

    @property
    def _meanings(self) -> tuple[str, str, str]:
        return self.at_shoulder, ": its elbow is stretched or folded", self.at_wrist

    def _candidates(self, poses: np.ndarray, seeds: np.ndarray) -> InverseSolutions:
        return self.inverse(poses)

    def _refuse(self, pose: np.ndarray) -> NoReturn:
        wrist = self._wrist(pose[None])
        tried = [(self._branch(wrist, signs)[1], signs) for signs in BRANCHES]
        margins, signs = max(tried, key=lambda branch: branch[0].min())
        self._raise_margin(pose[None], margins, signs)

    def _wrist(self, poses: np.ndarray) -> np.ndarray:
        """(12, S): the wrist's rotation in B row by row, and the wrist centre in B."""
        return self._arm.selection @ poses.reshape(len(poses), 16).T

    def _shoulder(
        self, x: np.ndarray, y: np.ndarray, sign: int | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Square of the shoulder's distance, radial reach, and cosine and sine of the turn of B about axis 1; (S,)."""
        g = self._arm
        distance2 = x * x + y * y
        radial2 = distance2 - g.lateral_offset**2
        radial = sign * np.sqrt(np.maximum(radial2, 0.0))
        distance2 = np.maximum(distance2, np.finfo(float).tiny)
        cos1 = (x * radial + y * g.lateral_offset) / distance2
        sin1 = (y * radial - x * g.lateral_offset) / distance2
        return radial2 / g.reach**2, radial, cos1, sin1

    def _elbow(
        self, ahead: np.ndarray, z: np.ndarray, sign: int | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Square of the elbow's distance, sine and cosine of the upper arm's angle, and those of γ; (S,).

        `ahead` and `z` are where the forearm ends, from axis 2.
        """
        g = self._arm
        cos_elbow = (ahead * ahead + z * z - (g.upper_arm**2 + g.forearm**2)) / (2 * g.upper_arm * g.forearm)
        margin = 1.0 - cos_elbow * cos_elbow
        cos_elbow = np.clip(cos_elbow, -np.sqrt(1.0 - self._bend), np.sqrt(1.0 - self._bend))
        sin_elbow = sign * np.sqrt(np.maximum(margin, self._bend))
        along = g.upper_arm + g.forearm * cos_elbow
        across = g.forearm * sin_elbow
        span = np.maximum(along * along + across * across, np.finfo(float).tiny)
        sin2 = (ahead * along - z * across) / span  # of the angle of the upper arm from z
        cos2 = (z * along + ahead * across) / span
        return margin, sin2, cos2, sin_elbow, cos_elbow

    def _unwrapped(self, angles: np.ndarray, start: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Angles (6, S) made continuous by full turns, the first nearest to `start`."""
        steps = np.diff(angles, axis=1)
        jumping = np.abs(steps).max(axis=1, initial=0.0) > np.pi
        for joint in np.flatnonzero(jumping):
            turns = np.round(steps[joint] / (2 * np.pi))
            angles[joint, 1:] -= 2 * np.pi * np.cumsum(turns)
            steps[joint] -= 2 * np.pi * turns
        largest = np.abs(steps).max(axis=0, initial=0.0)
        if largest.max(initial=0.0) > LARGEST_STEP:
            index = int(np.flatnonzero(largest > LARGEST_STEP)[0])
            name = self.robot.joint_names[int(np.abs(steps[:, index]).argmax())]
            raise KinematicsError(
                index + 1,
                "branch",
                f"between poses {index} and {index + 1}, at {position_text(poses[index])}, {name} would have to turn "
                f"by {largest[index]:.2f} rad at once: the path crosses a singularity there",
                float(largest.max() / LARGEST_STEP - 1.0),
            )
        return angles + 2 * np.pi * np.round((start - angles[:, 0]) / (2 * np.pi))[:, None]

    def _raise_margin(self, poses: np.ndarray, margins: np.ndarray, signs: tuple[int, ...]) -> NoReturn:
        """Say which is the first pose that is out of reach or singular on this branch."""
        smallest = margins.min(axis=0)
        index = int(np.flatnonzero(~(margins >= self._least[:, None]).all(axis=0))[0])
        if smallest[index] >= _BEYOND:
            distance = float(np.sqrt(max(smallest[index], 0.0)))
            raise singular(index, poses[index], distance, self._meanings[int(margins[:, index].argmin())])
        g = self._arm
        wrist = self._wrist(poses)[:, index]
        if margins[0, index] < _BEYOND:
            wrist_distance = np.hypot(wrist[9], wrist[10])
            why = f"{wrist_distance:.3f} m from axis 1, and the arm comes no nearer than {abs(g.lateral_offset):.3f} m"
        else:
            distance = self._from_axis_2(wrist, signs)
            nearest = abs(g.upper_arm - g.forearm)
            why = f"{distance:.3f} m from axis 2, and the arm reaches from {nearest:.3f} to {g.reach:.3f} m"
            # On a line that leads out of reach the first point is only just out of it.
            beyond = max(distance - g.reach, nearest - distance)
            if beyond < 0.01:
                why += f", {1000 * beyond:.2g} mm too {'far' if distance > g.reach else 'near'}"
        raise KinematicsError(
            index,
            "unreachable",
            f"pose {index} at {position_text(poses[index])} is out of reach: its wrist centre is {why}",
            float(np.sqrt(-smallest.min())) if np.isfinite(smallest).all() else np.inf,
        )

    def _polish(self, poses: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Newton steps (S, n) that remove what an inexact geometry leaves; where (S,) they reach it on their branch."""
        if self._exact or len(q) == 0:
            return q, np.ones(len(q), dtype=bool)
        error, late, branch = pose_error(poses, self.forward(q)), np.arange(len(q)), np.sign(self._signed_distances(q))
        for step in range(5):
            q[late] += np.linalg.solve(self.jacobian(q[late]), error[late, :, None])[:, :, 0]
            error[late] = pose_error(poses[late], self.forward(q[late]))
            if step >= 2:  # near a singularity three steps may leave a little, which the next ones square
                size = np.abs(error).max(axis=1)
                late = np.flatnonzero((size >= _REACHED) & (size < _NEARLY))
        stays = (branch * self._signed_distances(q) >= SINGULAR_DISTANCE).all(axis=0)
        return q, stays & (np.abs(error).max(axis=1) < _REACHED)

    def _is_exact(self) -> bool:
        q = np.random.default_rng(0).uniform(-3.0, 3.0, (10, 6))
        poses = self.forward(q)
        solved = [
            self._branch(self._wrist(pose[None]), self.branch(row))[0][:, 0] for pose, row in zip(poses, q, strict=True)
        ]
        return bool(np.abs(self.forward(np.array(solved)) - poses).max() < _REACHED)


def frame_of(z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(3, 3) rotation with third column z and second column y, made exactly perpendicular."""
    y = y - z * (z @ y)
    y = y / np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])
