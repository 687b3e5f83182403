"""The sub-region: each via-point's own bounded region of position and orientation (the paper's Fig. 1).

A genome has six genes in [0, 1] a via-point: three move the TCP, three turn the tool, each linearly between the bounds
of the region. How turns are meant is in `docs/decisions/via-regions.md`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Protocol

import numpy as np

from agent.core import InputError
from agent.motion import rotation
from agent.motion.rotation import pose_of

if TYPE_CHECKING:
    from scipy.spatial.transform import Slerp

#: [rad] how far the tool may turn around a task.
_TASK_CONE = np.radians(10.0)


class Region(Protocol):
    """Where one via-point may lie."""

    def poses(self, genes: np.ndarray) -> np.ndarray:
        """(N, 4, 4) from six genes in [0, 1] each (N, 6)."""
        ...


@dataclass(frozen=True, eq=False)
class PointRegion:
    """x, y, z [m] and Euler ZYZ a, e, r [rad] (6,), plus or minus `spread` (6,)."""

    middle: np.ndarray
    spread: np.ndarray

    def poses(self, genes: np.ndarray) -> np.ndarray:
        return pose_of(self.middle + (2.0 * genes - 1.0) * self.spread)


@dataclass(frozen=True, eq=False)
class BoxRegion:
    """A box and a cone: `middle` (4, 4), half edges (3,) [m] along the base's axes, `cone` [rad].

    The tool turns by a rotation vector in the template's own frame: its parts across the tool axis are at most
    cone / √2 each, so that the axis tilts by at most `cone`; the part along it is at most `cone`.
    """

    middle: np.ndarray
    half: np.ndarray
    cone: float

    def poses(self, genes: np.ndarray) -> np.ndarray:
        poses = np.tile(self.middle, (len(genes), 1, 1))
        poses[:, :3, 3] += (2.0 * genes[:, :3] - 1.0) * self.half
        poses[:, :3, :3] = self.middle[:3, :3] @ _turns(genes, self.cone)
        return poses


def _turns(genes: np.ndarray, cone: float) -> np.ndarray:
    """(N, 3, 3) turns of the tool within `cone` [rad] by the last three of six genes (N, 6)."""
    most = cone * np.array([np.sqrt(0.5), np.sqrt(0.5), 1.0])
    return rotation.to_matrix(rotation.from_rotation_vector((2.0 * genes[:, 3:] - 1.0) * most))


@dataclass(frozen=True, eq=False)
class TubeRegion:
    """A stretch of a path: `points` (M, 3) [m] at arc lengths `along` (M,) from `begin` to `end`, turned by `turns`.

    One position gene runs along the path, two across it within `radius` [m]; the tool turns as in a `BoxRegion`.
    """

    along: np.ndarray
    points: np.ndarray
    turns: Slerp
    begin: float
    end: float
    radius: float
    cone: float

    def poses(self, genes: np.ndarray) -> np.ndarray:
        length = self.begin + genes[:, 0] * (self.end - self.begin)
        chords = np.diff(self.points, axis=0)
        tangent = chords[np.clip(np.searchsorted(self.along, length, side="right") - 1, 0, len(chords) - 1)]
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        first = np.cross(tangent, np.eye(3)[np.argmin(np.abs(tangent), axis=1)])
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        aside = np.sqrt(0.5) * self.radius * (2.0 * genes[:, 1:3] - 1.0)
        poses = np.tile(np.eye(4), (len(genes), 1, 1))
        for axis in range(3):
            poses[:, axis, 3] = np.interp(length, self.along, self.points[:, axis])
        poses[:, :3, 3] += aside[:, :1] * first + aside[:, 1:] * np.cross(tangent, first)
        poses[:, :3, :3] = self.turns(np.clip(length, 0.0, self.along[-1])).as_matrix() @ _turns(genes, self.cone)
        return poses


@dataclass(frozen=True, eq=False)
class ViaRegions:
    """One region a via-point, in the order of the loop."""

    regions: tuple[Region, ...]

    @property
    def count(self) -> int:
        """Number of via-points K."""
        return len(self.regions)

    @property
    def genes(self) -> int:
        """Length of a genome: six a via-point."""
        return 6 * len(self.regions)

    def poses(self, genome: np.ndarray) -> np.ndarray:
        """(K, 4, 4) via-points of a genome (6K,) in [0, 1]; (N, K, 4, 4) of several (N, 6K).

        Raises:
            InputError: a genome of another length, or outside [0, 1].
        """
        genes = np.asarray(genome, dtype=float)
        if genes.shape[-1:] != (self.genes,) or not (genes >= 0.0).all() or not (genes <= 1.0).all():
            raise InputError(f"a genome of {self.genes} numbers from 0 to 1 is needed for {self.count} via-points")
        parts = genes.reshape(-1, self.count, 6)
        poses = np.stack([region.poses(parts[:, k]) for k, region in enumerate(self.regions)], axis=1)
        return poses.reshape(*genes.shape[:-1], self.count, 4, 4)

    @classmethod
    def from_points(
        cls, poses: Sequence[Sequence[float]] | np.ndarray, ranges: Sequence[Sequence[float]] | np.ndarray
    ) -> ViaRegions:
        """A region for each pose (K, 6), x, y, z [m] and Euler ZYZ a, e, r [rad], plus or minus ranges (K, 6)."""
        middles, spreads = np.asarray(poses, dtype=float), np.abs(np.asarray(ranges, dtype=float))
        if middles.shape != spreads.shape or middles.ndim != 2 or middles.shape[1] != 6:
            raise InputError("via-points: a pose of six numbers and a range of six numbers are needed for each point")
        return cls(tuple(PointRegion(middle, spread) for middle, spread in zip(middles, spreads, strict=True)))

    @classmethod
    def from_box(
        cls, count: int, centre: Sequence[float], size: Sequence[float], orientation: Sequence[float], cone: float = 0.0
    ) -> ViaRegions:
        """The same box for all: centre, size (3,) [m], orientation Euler ZYZ (3,) [rad], largest tilt `cone` [rad]."""
        box = BoxRegion(pose_of([*centre, *orientation]), 0.5 * np.asarray(size, dtype=float), float(cone))
        return cls((box,) * count)

    @classmethod
    def from_tube(
        cls, count: int, path: Sequence[np.ndarray] | np.ndarray, radius: float, cone: float = 0.0
    ) -> ViaRegions:
        """Regions along a taught path of poses (M, 4, 4), joined by lines: within `radius` [m] and `cone` [rad].

        Each via-point has its own stretch of the path, all stretches are equally long.
        """
        from scipy.spatial.transform import Rotation, Slerp

        poses = np.asarray(path, dtype=float)
        moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) > 1e-9
        poses = poses[np.concatenate(([True], moved))]
        if len(poses) < 2:
            raise InputError("a tube needs a path of at least two different points")
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))))
        turns = Slerp(along, Rotation.from_matrix(poses[:, :3, :3]))
        cuts = np.linspace(0.0, along[-1], count + 1)
        return cls(
            tuple(
                TubeRegion(along, poses[:, :3, 3], turns, float(begin), float(end), float(radius), float(cone))
                for begin, end in pairwise(cuts)
            )
        )

    @classmethod
    def from_envelope(cls, count: int, poses: Sequence[np.ndarray] | np.ndarray, around: float) -> ViaRegions:
        """Regions around a task: where poses (S, 4, 4) of a program or a log go, plus or minus `around` [m].

        Each via-point has its own, equally long stretch of the task: the box around the stretch grown by `around`, and
        the stretch's mean orientation, with the tilt that occurs there and 10° more.
        """
        task = np.asarray(poses, dtype=float)
        travel = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(task[:, :3, 3], axis=0), axis=1))))
        if travel[-1] < 1e-6:
            raise InputError("the task does not move, so there is no region around it; its tool centre has to move")
        cuts = np.linspace(0.0, travel[-1], count + 1)
        regions = []
        for begin, end in pairwise(cuts):
            first, last = np.searchsorted(travel, begin), np.searchsorted(travel, end, side="right")
            ends = np.array([np.interp([begin, end], travel, task[:, axis, 3]) for axis in range(3)]).T
            stretch = task[max(first - 1, 0) : last + 1]
            points = np.concatenate((ends, task[first:last, :3, 3]))
            regions.append(_box_around(points, rotation.from_matrices(stretch[:, :3, :3]), around))
        return cls(tuple(regions))


def _box_around(points: np.ndarray, turns: np.ndarray, around: float) -> BoxRegion:
    # The mean of rotations: the first eigenvector of the sum of q qᵀ, which ignores the signs of the q.
    mean = np.linalg.eigh(turns.T @ turns)[1][:, -1]
    middle = rotation.to_pose(0.5 * (points.min(axis=0) + points.max(axis=0)), mean)
    axes = rotation.to_matrix(turns)[:, :, 2]
    cosines: np.ndarray = axes @ middle[:3, 2]
    tilt = float(np.arccos(np.clip(cosines, -1.0, 1.0)).max())
    return BoxRegion(middle, 0.5 * np.ptp(points, axis=0) + around, min(tilt + _TASK_CONE, np.pi))
