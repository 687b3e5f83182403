"""The sub-region that a recipe asks for, in SI."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from agent.recipe.schema import ViaPointsSection

Vector = tuple[float, ...]


@dataclass(frozen=True)
class ViaBox:
    """K via-points in one box: centre (3,), edge lengths size (3,) [m], Euler ZYZ orientation (3,), cone [rad]."""

    count: int
    centre: Vector
    size: Vector
    orientation: Vector
    cone: float


@dataclass(frozen=True)
class ViaPointRegion:
    """One via-point's region: pose (6,) plus or minus range (6,); x, y, z [m], Euler ZYZ a, e, r [rad]."""

    pose: Vector
    range: Vector


@dataclass(frozen=True)
class ViaPointList:
    """A region for each via-point."""

    points: tuple[ViaPointRegion, ...]

    @property
    def count(self) -> int:
        """Number of via-points K."""
        return len(self.points)


@dataclass(frozen=True)
class ViaLike:
    """K via-points where an existing program or log goes, plus or minus `around` [m]."""

    count: int
    path: Path
    around: float


@dataclass(frozen=True)
class ViaTube:
    """K via-points within `radius` [m] of a path of poses, each (6,), and within `cone` [rad] of its orientation."""

    count: int
    path: tuple[Vector, ...]
    radius: float
    cone: float


ViaPoints = ViaBox | ViaPointList | ViaLike | ViaTube


def via_points_of(path: Path, section: ViaPointsSection) -> ViaPoints:
    """The sub-region of a recipe at `path`."""
    if section.points is not None:
        return ViaPointList(tuple(ViaPointRegion(point.pose, point.range) for point in section.points))
    count = section.count or 0  # the section requires it beside each of the others
    if section.box is not None:
        return ViaBox(count, **section.box.__dict__)
    if section.tube is not None:
        return ViaTube(count, tuple(section.tube.path), section.tube.radius, section.tube.cone)
    return ViaLike(count, path.parent / str(section.like), section.around or 0.0)
