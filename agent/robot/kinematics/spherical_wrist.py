"""Closed-form kinematics of a six-axis arm with a spherical wrist.

The formulas are in `spherical_wrist_geometry`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import NoReturn

import numpy as np

from agent.robot.description import RobotDescription
from agent.robot.kinematics.base import (
    LARGEST_STEP,
    SINGULAR_DISTANCE,
    InverseSolutions,
    Kinematics,
    KinematicsError,
    SingularityDistance,
    pose_error,
    position_text,
    singular,
)
from agent.robot.kinematics.chain import KinematicChain
from agent.robot.kinematics.configuration import Configuration, parse_configuration
from agent.robot.kinematics.spherical_wrist_geometry import SphericalWristGeometry

#: Signs of shoulder, elbow and wrist, in the order of the branches of `inverse`.
BRANCHES = tuple(product((1, -1), repeat=3))
_SIGNS = np.array(BRANCHES, dtype=float).T
SINGULARITIES = ("shoulder", "elbow", "wrist")
_MEANINGS = (
    ": its wrist centre is on axis 1",
    ": its elbow is stretched or folded",
    ": it has axes 4 and 6 in line",
)
_BEYOND = -2e-9  # a squared margin below this is out of reach, above it round-off at the border


class SphericalWristKinematics(Kinematics):
    """Eight branches in closed form: shoulder, elbow and wrist signs, in the order of `BRANCHES`."""

    def __init__(self, robot: RobotDescription, chain: KinematicChain, geometry: SphericalWristGeometry):
        super().__init__(robot, chain)
        self.geometry = geometry
        self._exact = self._is_exact()

    def inverse(self, poses: np.ndarray) -> InverseSolutions:
        poses = np.asarray(poses, dtype=float)
        samples = len(poses)
        angles, squares = self._branch(np.repeat(self._wrist(poses), 8, axis=1), np.tile(_SIGNS, samples))
        q = self.nearest_turn(angles.T, self.middle).reshape(samples, 8, 6)
        margins = squares.T.reshape(samples, 8, 3)
        reached = np.all(margins >= _BEYOND, axis=2)
        valid = np.all(margins >= SINGULAR_DISTANCE**2, axis=2)
        if not self._exact:
            q[valid] = self._polish(np.repeat(poses, valid.sum(axis=1), axis=0), q[valid])
        q[~valid] = np.nan
        return InverseSolutions(
            q=q,
            valid=valid,
            within_limits=valid & self.within_limits(q),
            singular=reached & ~valid,
            unreachable=~reached.any(axis=1),
        )

    def follow(self, poses: np.ndarray, start: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        poses = np.asarray(poses, dtype=float)
        start = np.asarray(start, dtype=float)
        if len(poses) == 0:
            return np.empty((0, 6))
        distances = self._signed_distances(start[None])[:, 0]
        nearest = int(np.abs(distances).argmin())
        if abs(distances[nearest]) < SINGULAR_DISTANCE:
            raise singular(0, poses[0], float(abs(distances[nearest])), _MEANINGS[nearest], "the start")
        signs = tuple(int(sign) for sign in np.sign(distances))
        angles, margins = self._branch(self._wrist(poses), signs)
        if not margins.min() >= SINGULAR_DISTANCE**2:
            self._raise_margin(poses, margins, signs)
        q = np.ascontiguousarray(self._unwrapped(angles, start, poses).T)
        return self._polish(poses, q)

    def find_on_branch(self, poses: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distances = self._signed_distances(near)
        # One by one: the last digit of a product depends on how many columns there are.
        wrist = np.concatenate([self._wrist(pose[None]) for pose in poses], axis=1)
        angles, margins = self._branch(wrist, np.sign(distances))
        found = (margins >= SINGULAR_DISTANCE**2).all(axis=0) & (np.abs(distances) >= SINGULAR_DISTANCE).all(axis=0)
        q = angles.T + 2 * np.pi * np.round((near - angles.T) / (2 * np.pi))
        q[found] = self.turned_into_limits(self._polish(poses[found], q[found]))
        found &= self.within_limits(q)
        if not found.all():
            q[~found], found[~found] = self.find(poses[~found], near[~found])
        return q, found

    def singularity(self, q: np.ndarray) -> SingularityDistance:
        """Distances in the order of `SINGULARITIES`.

        shoulder: of the wrist centre from axis 1, over the arm's reach; elbow: |sin γ|, 0 where stretched or folded;
        wrist: |sin β|, 0 where axes 4 and 6 are in line (|sin q₅| on the NS16).
        """
        return SingularityDistance(SINGULARITIES, np.abs(self._signed_distances(np.asarray(q, dtype=float))).T)

    def branch(self, q: np.ndarray) -> tuple[int, int, int]:
        """Signs of shoulder, elbow and wrist at one configuration (n,)."""
        shoulder, elbow, wrist = (
            1 if value >= 0 else -1 for value in self._signed_distances(np.asarray(q)[None])[:, 0]
        )
        return shoulder, elbow, wrist

    def solve_configuration(self, pose: np.ndarray, configuration: str) -> np.ndarray:
        wanted = parse_configuration(configuration)
        poses = np.asarray(pose, dtype=float)[None]
        angles, margins = self._branch(self._wrist(poses), wanted.signs)
        if not margins.min() >= SINGULAR_DISTANCE**2:
            self._raise_margin(poses, margins, wanted.signs)
        q = self._polish(poses, self.nearest_turn(angles.T, self.middle))[0]
        return wanted.turned(q)

    def configuration(self, q: np.ndarray) -> Configuration:
        """Flags and turns at one configuration (n,)."""
        return Configuration.of(self.branch(q), np.asarray(q, dtype=float))

    def configuration_text(self, q: np.ndarray) -> str:
        return str(self.configuration(q))

    def _candidates(self, poses: np.ndarray, near: np.ndarray) -> InverseSolutions:
        return self.inverse(poses)

    def _refuse(self, pose: np.ndarray) -> NoReturn:
        wrist = self._wrist(pose[None])
        tried = [(self._branch(wrist, signs)[1], signs) for signs in BRANCHES]
        margins, signs = max(tried, key=lambda branch: branch[0].min())
        self._raise_margin(pose[None], margins, signs)

    def _wrist(self, poses: np.ndarray) -> np.ndarray:
        """(12, S): the wrist's rotation in B row by row, and the wrist centre in B."""
        return self.geometry.selection @ poses.reshape(len(poses), 16).T

    def _branch(self, wrist: np.ndarray, signs: Sequence[int] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joint angles (6, S) on one branch, and the squares (3, S) of the distances from its singularities.

        `signs` are those of one branch (3,), or of each pose's own (3, S).

        A negative square is out of reach, and its angles are those of the border. Sines and cosines of the first three
        joints come from the triangle itself, so that only the angles asked for cost a transcendental function.
        """
        g = self.geometry
        r00, r01, r02, r10, r11, r12, r20, r21, r22, x, y, z = wrist
        distance2 = x * x + y * y
        margins = np.empty((3, wrist.shape[1]))
        radial2 = distance2 - g.lateral_offset**2
        margins[0] = radial2 / g.reach**2
        radial = signs[0] * np.sqrt(np.maximum(radial2, 0.0))
        distance2 = np.maximum(distance2, np.finfo(float).tiny)
        cos1 = (x * radial + y * g.lateral_offset) / distance2
        sin1 = (y * radial - x * g.lateral_offset) / distance2

        ahead = radial - g.shoulder_offset
        cos_elbow = (ahead * ahead + z * z - (g.upper_arm**2 + g.forearm**2)) / (2 * g.upper_arm * g.forearm)
        margins[1] = 1.0 - cos_elbow * cos_elbow
        cos_elbow = np.clip(cos_elbow, -1.0, 1.0)
        sin_elbow = signs[1] * np.sqrt(np.maximum(margins[1], 0.0))
        along = g.upper_arm + g.forearm * cos_elbow
        across = g.forearm * sin_elbow
        span = np.maximum(along * along + across * across, np.finfo(float).tiny)
        sin2 = (ahead * along - z * across) / span  # of the angle of the upper arm from z
        cos2 = (z * along + ahead * across) / span
        cos0, sin0 = np.cos(g.forearm_angle), np.sin(g.forearm_angle)
        sin3, cos3 = sin2 * cos_elbow + cos2 * sin_elbow, cos2 * cos_elbow - sin2 * sin_elbow  # and of the forearm
        sin, cos = sin3 * cos0 - cos3 * sin0, cos3 * cos0 + sin3 * sin0  # of the rotation of link 3 about y

        # Third column of what rotation is left, in the wrist's axes: (cos q4 sin β, sin q4 sin β, cos β).
        forward = cos1 * r02 + sin1 * r12
        last = np.stack([cos * forward - sin * r22, cos1 * r12 - sin1 * r02, sin * forward + cos * r22])
        c4, s4, cos5 = g.forearm_rotation @ last
        margins[2] = c4 * c4 + s4 * s4
        # Third row: axis 4 in B against the first two columns of the wrist's rotation: (-sin β cos q6, sin β sin q6).
        kx, ky, kz = g.forearm_rotation[2]
        ahead4, up4 = cos * kx + sin * kz, cos * kz - sin * kx
        ax, ay = cos1 * ahead4 - sin1 * ky, sin1 * ahead4 + cos1 * ky
        c6 = -(ax * r00 + ay * r10 + up4 * r20)
        s6 = ax * r01 + ay * r11 + up4 * r21

        q = np.empty((6, wrist.shape[1]))
        np.arctan2(sin1, cos1, out=q[0])
        q[0] *= g.senses[0]
        np.arctan2(sin2, cos2, out=q[1])
        q[1] -= g.upper_arm_angle
        q[1] *= g.senses[1]
        np.arctan2(sin_elbow, cos_elbow, out=q[2])
        q[2] -= g.forearm_angle - g.upper_arm_angle
        q[2] *= g.senses[2]
        np.arctan2(signs[2] * s4, signs[2] * c4, out=q[3])
        np.arctan2(signs[2] * np.sqrt(margins[2]), cos5, out=q[4])
        q[4] -= g.wrist_angle
        np.arctan2(signs[2] * s6, signs[2] * c6, out=q[5])
        return q, margins

    def _signed_distances(self, q: np.ndarray) -> np.ndarray:
        """(3, S): radial reach over arm length, sin γ, sin β; their signs are the branch."""
        g = self.geometry
        upper = g.upper_arm_angle + g.senses[1] * q[:, 1]
        elbow = g.senses[2] * q[:, 2] + g.forearm_angle - g.upper_arm_angle
        radial = g.shoulder_offset + g.upper_arm * np.sin(upper) + g.forearm * np.sin(upper + elbow)
        return np.stack([radial / g.reach, np.sin(elbow), np.sin(q[:, 4] + g.wrist_angle)])

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
        index = int(np.flatnonzero(~(smallest >= SINGULAR_DISTANCE**2))[0])
        if smallest[index] >= _BEYOND:
            distance = float(np.sqrt(max(smallest[index], 0.0)))
            raise singular(index, poses[index], distance, _MEANINGS[int(margins[:, index].argmin())])
        g = self.geometry
        x, y, z = self._wrist(poses)[9:, index]
        if margins[0, index] < _BEYOND:
            why = f"{np.hypot(x, y):.3f} m from axis 1, and the arm comes no nearer than {abs(g.lateral_offset):.3f} m"
        else:
            radial = signs[0] * np.sqrt(max(x * x + y * y - g.lateral_offset**2, 0.0))
            distance = np.hypot(radial - g.shoulder_offset, z)
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

    def _polish(self, poses: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Newton steps that remove what an inexact geometry leaves; nothing to do where it is exact."""
        if self._exact or len(q) == 0:
            return q
        for _ in range(3):
            q = q + self.joint_rates(q, pose_error(poses, self.forward(q)))
        return q

    def _is_exact(self) -> bool:
        q = np.random.default_rng(0).uniform(-3.0, 3.0, (10, 6))
        poses = self.forward(q)
        solved = [
            self._branch(self._wrist(pose[None]), self.branch(row))[0][:, 0] for pose, row in zip(poses, q, strict=True)
        ]
        return bool(np.abs(self.forward(np.array(solved)) - poses).max() < 1e-9)
