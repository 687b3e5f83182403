"""Interface of the kinematics of every arm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from agent.core import InputError
from agent.robot.description import RobotDescription
from agent.robot.kinematics.chain import KinematicChain

#: A configuration nearer to a singularity than this (normalised, see `Kinematics.singularity`) is not returned.
SINGULAR_DISTANCE = 1e-4
#: A revolute joint that turns farther than this [rad] between two samples of a path has left its branch.
LARGEST_STEP = np.pi / 2
#: Slack on joint limits [rad or m], for round-off only.
LIMIT_SLACK = 1e-9


class KinematicsError(InputError):
    """A pose that cannot be reached as asked.

    `index` of the first such pose, `reason` "unreachable", "singular" or "branch", and `excess` > 0: how far beyond
    what is possible the worst pose is, dimensionless, so that a search can rank candidates.
    """

    def __init__(self, index: int, reason: str, message: str, excess: float):
        super().__init__(message)
        self.index = index
        self.reason = reason
        self.excess = excess


@dataclass(frozen=True, eq=False)
class InverseSolutions:
    """All solutions of S poses on B branches.

    q (S, B, n), NaN where not `valid`; valid (S, B): reaches the pose and is not singular; within_limits (S, B): also
    keeps the joint limits; singular (S, B): reaches the pose in a singular configuration; unreachable (S,): no branch
    reaches the pose.
    """

    q: np.ndarray
    valid: np.ndarray
    within_limits: np.ndarray
    singular: np.ndarray
    unreachable: np.ndarray


class Kinematics(ABC):
    """Kinematics of one arm with one tool. Joint positions q are (S, n) in rad (m on a prismatic joint)."""

    def __init__(self, robot: RobotDescription, chain: KinematicChain):
        self.robot = robot
        self.chain = chain
        self.lower, self.upper = robot.position_limits
        self._revolute = ~chain.prismatic
        bounded = np.isfinite(self.lower) & np.isfinite(self.upper)
        self.middle = np.where(bounded, self.lower, 0.0) / 2 + np.where(bounded, self.upper, 0.0) / 2

    @property
    def dof(self) -> int:
        """Number of joints n."""
        return self.chain.dof

    def forward(self, q: np.ndarray) -> np.ndarray:
        """(S, 4, 4) poses of the TCP."""
        return self.chain.forward_and_jacobian(q)[0]

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """(S, 6, n) Jacobian of the TCP in the base frame: rows linear, then angular velocity."""
        return self.chain.forward_and_jacobian(q)[1]

    def within_limits(self, q: np.ndarray) -> np.ndarray:
        """(...) bool for q (..., n): every joint inside its limits."""
        return np.all((q >= self.lower - LIMIT_SLACK) & (q <= self.upper + LIMIT_SLACK), axis=-1)

    def nearest_turn(self, q: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """q (..., n) with full turns added to revolute joints so that each comes nearest to the reference (..., n)."""
        turns = np.round((reference - q) / (2 * np.pi))
        return q + 2 * np.pi * np.where(self._revolute, turns, 0.0)

    def turned_into_limits(self, q: np.ndarray) -> np.ndarray:
        """q (..., n) with the fewest full turns that bring each revolute joint into its limits, where that can be."""
        over = np.ceil((q - self.upper - LIMIT_SLACK) / (2 * np.pi)).clip(min=0)
        under = np.ceil((self.lower - LIMIT_SLACK - q) / (2 * np.pi)).clip(min=0)
        return q + 2 * np.pi * np.where(self._revolute, under - over, 0.0)

    def solve(self, pose: np.ndarray, seed: np.ndarray, on_branch: bool = False) -> np.ndarray:
        """(n,) the solution for one pose (4, 4) nearest to `seed` (n,), within the joint limits.

        With `on_branch` it is on the branch of `seed` where an arm has such and a solution there keeps the limits: the
        nearest joints may be on another branch, where the same pose bends hoses and loads gears otherwise.

        Raises:
            KinematicsError: no such solution; index 0.
        """
        pose, seed = np.asarray(pose, dtype=float), np.asarray(seed, dtype=float)
        q, solved = (self.find_on_branch if on_branch else self.find)(pose[None], seed[None])
        if not solved[0]:
            raise self.refusal(pose, seed)
        return q[0]

    def find(self, poses: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, n) what `solve` says of each of poses (S, 4, 4), nearest to `seeds` (S, n), and where it does (S,)."""
        candidates, _, allowed = self._options(poses, seeds)
        distance = np.where(allowed, np.linalg.norm(candidates - seeds[:, None], axis=2), np.inf)
        return candidates[np.arange(len(poses)), distance.argmin(axis=1)], np.any(allowed, axis=1)

    def find_on_branch(self, poses: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, n) what `solve` on the branch says of each of poses (S, 4, 4), and where it does (S,)."""
        return self.find(poses, seeds)

    def _options(self, poses: np.ndarray, seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solutions (S, B, n) at the turns nearest to `seeds` that the limits allow, which are some (S, B), and which
        keep the limits (S, B)."""
        branches = self._candidates(poses, seeds)
        candidates = self.turned_into_limits(self.nearest_turn(branches.q, seeds[:, None]))
        return candidates, branches.valid, branches.valid & self.within_limits(candidates)

    def refusal(self, pose: np.ndarray, seed: np.ndarray) -> KinematicsError:
        """Why there is no solution for a pose (4, 4) near joints (n,) where `find` has found none."""
        candidates, valid, _ = self._options(pose[None], seed[None])
        try:
            if not valid.any():
                self._refuse(pose)
            self._refuse_limits(pose, candidates[valid])
        except KinematicsError as error:
            return error

    def _refuse_limits(self, pose: np.ndarray, candidates: np.ndarray) -> NoReturn:
        # A turn that brings a joint below its upper limit may take it far below the lower one.
        turns = np.stack([candidates, self.nearest_turn(candidates, self.middle)])
        beyond = np.maximum(turns - self.upper, self.lower - turns).min(axis=0)
        best = beyond[beyond.max(axis=1).argmin()]
        joint = int(best.argmax())
        raise KinematicsError(
            0,
            "unreachable",
            f"the pose at {position_text(pose)} is out of reach: every solution breaks a joint limit, the best one "
            f"that of {self.robot.joint_names[joint]} by {best[joint]:.3g} {self.robot.joints[joint].position_unit}",
            float(best[joint]),
        )

    @abstractmethod
    def inverse(self, poses: np.ndarray) -> InverseSolutions:
        """All solutions for poses (S, 4, 4); each revolute joint turned to within half a turn of its range's middle."""

    @abstractmethod
    def follow(self, poses: np.ndarray, start: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """(S, n) continuous joint path through poses (S, 4, 4), on the branch and the turns of `start` (n,).

        Of an arm with more joints than a pose needs: the least motion from pose to pose, which does not lead back to
        the same joints where the poses come back; or with `near` (S, n) the joints nearest to those, which does.

        The samples must be dense enough that no joint turns by more than `LARGEST_STEP` between two of them. Joint
        limits are the caller's to check.

        Raises:
            KinematicsError: at the first pose out of reach, singular, or where the path leaves the branch.
        """

    @abstractmethod
    def singularity(self, q: np.ndarray) -> np.ndarray:
        """(S, k) normalised distances of configurations (S, n) from each kind of singularity; 0 is singular."""

    def solve_configuration(self, pose: np.ndarray, configuration: str) -> np.ndarray:
        """(n,) the solution for a pose (4, 4) with these configuration flags and turns; limits are not checked then.

        Without a spherical wrist an arm has no flags: the empty string gives the solution nearest to mid-range.

        Raises:
            InputError: flags that make no sense for this arm.
            KinematicsError: out of reach in that configuration, or singular; index 0.
        """
        if configuration.strip():
            raise InputError(
                f"robot {self.robot.name} has no spherical wrist: configuration {configuration!r} has no meaning for it"
            )
        return self.solve(pose, self.middle)

    def configuration_text(self, q: np.ndarray) -> str:
        """The configuration string at joint positions q (n,); empty for an arm that has no such flags."""
        return ""

    @abstractmethod
    def _candidates(self, poses: np.ndarray, seeds: np.ndarray) -> InverseSolutions:
        """Solutions for poses (S, 4, 4), some of them near `seeds` (S, n), from which `solve` chooses."""

    @abstractmethod
    def _refuse(self, pose: np.ndarray) -> NoReturn:
        """Raise the KinematicsError of a pose without valid solution."""


def singular(index: int, pose: np.ndarray, distance: float, why: str, what: str = "the pose") -> KinematicsError:
    """A pose (4, 4) that is nearer to a singularity than `SINGULAR_DISTANCE`."""
    return KinematicsError(
        index,
        "singular",
        f"{what} at {position_text(pose)} (pose {index}) is singular{why}; "
        "move the point or turn the tool by a few degrees",
        max(1.0 - distance / SINGULAR_DISTANCE, 1e-9),
    )


def position_text(pose: np.ndarray) -> str:
    """Where a pose is, for messages."""
    return "({:.3f}, {:.3f}, {:.3f}) m".format(*pose[:3, 3])


def pose_error(target: np.ndarray, actual: np.ndarray) -> np.ndarray:
    """(S, 6) from actual to target poses (S, 4, 4): displacement [m], then rotation vector [rad], in the base frame."""
    from agent.compiled import pose_errors

    error, (length, cosine) = pose_errors(target, actual)
    angle = np.arctan2(length, cosine)
    # Tiny angles equal their sines to round-off; half a turn has no axis in it, and any will do to move on.
    scale = np.divide(angle, length, out=np.full(len(length), 0.5), where=length > 1e-12)
    error[:, 3:] *= scale[:, None]
    error[(length <= 1e-12) & (angle > 1), 3] = np.pi
    return error
