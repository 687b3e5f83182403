"""Whether the arm reaches its sub-region, checked before a search."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from itertools import product

import numpy as np

from agent.core import InputError
from agent.excitation.candidates import CORNERS, MIDDLE, TURNED, LoopProblem
from agent.motion import ViaRegions, pose_to_pos
from agent.robot import Kinematics, KinematicsError, RobotDescription, kinematics_for

#: Places checked in a via-point's region: the middle, the corners of its position and the ends of its orientation.
_PLACES = {**MIDDLE, **CORNERS, **TURNED}
#: Boxes that are tried for an arm, as parts of its reach: distance and height of the centre, and edges.
_AHEAD, _HEIGHT, _EDGES = (0.5, 0.6, 0.4, 0.7, 0.3), (0.3, 0.45, 0.15, 0.6, 0.0), (0.2, 0.3, 0.15)
#: Tool orientations (Euler ZYZ, deg) that point down: of a z axis along the last axis, and of an x axis.
_DOWN = ((0.0, 180.0, 0.0), (0.0, 90.0, 0.0))


@dataclass(frozen=True)
class OutOfReach:
    """A point of a via-point's region that the arm does not reach, and the message that says by how much."""

    point: int
    place: str
    message: str

    def __str__(self) -> str:
        return f"via-point {self.point + 1}, {self.place} of its region: {self.message}"


def check_sub_region(problem: LoopProblem) -> list[OutOfReach]:
    """Places of the sub-region that the arm does not reach; a search goes around a few of them.

    Raises:
        InputError: the middle of a via-point's region, or most of what was asked, is out of reach; names the point,
            the limit and by how much.
    """
    regions = problem.regions
    kinematics = kinematics_for(problem.robot, problem.tool)
    missed: list[OutOfReach] = []
    known: dict[bytes, str | None] = {}
    for place, genes in _PLACES.items():
        for point, pose in enumerate(regions.poses(np.tile(genes, regions.count))):
            key = np.round(pose, 9).tobytes()  # the points of a box share their coordinates
            if key not in known:
                known[key] = _complaint(kinematics, pose)
            complaint = known[key]
            if complaint is not None:
                missed.append(OutOfReach(point, place, complaint))
    for point in range(regions.count):
        of_point = [miss for miss in missed if miss.point == point]
        if any(miss.place == "middle" for miss in of_point) or 2 * len(of_point) > len(_PLACES):
            (middle,) = regions.poses(np.tile(MIDDLE["middle"], regions.count))[point : point + 1]
            raise InputError(
                f"{of_point[0]}; {len(of_point)} of {len(_PLACES)} places asked in this region are out of reach: "
                f"move or shrink motion.via_points{_turned(kinematics, middle)}"
            )
    return missed


@dataclass(frozen=True)
class WorkingBox:
    """A sub-region in the base frame: centre and size (3,) [m], orientation (3,) Euler ZYZ and cone [deg]."""

    centre: tuple[float, ...]
    size: tuple[float, ...]
    orientation: tuple[float, ...]
    cone: float


def working_box(robot: RobotDescription) -> WorkingBox | None:
    """The largest of some boxes in front of an arm that it reaches completely; None if there is none."""
    kinematics = kinematics_for(robot, None)
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    postures = np.random.default_rng(0).uniform(lower, upper, (200, robot.dof))
    reach = float(np.linalg.norm(kinematics.forward(postures)[:, :3, 3], axis=1).max())
    for shrink, cone in ((1.0, 30.0), (0.5, 10.0)):
        for orientation, height, ahead in product(_DOWN, _HEIGHT, _AHEAD):
            centre = tuple(round(part * reach, 2) for part in (ahead, 0.0, height))
            size = tuple(max(round(float(shrink * reach * edge), 2), 0.01) for edge in _EDGES)
            angles = [float(np.radians(angle)) for angle in orientation]
            regions = ViaRegions.from_box(1, centre, size, angles, float(np.radians(cone)))
            poses = (regions.poses(genes)[0] for genes in _PLACES.values())
            if all(_complaint(kinematics, pose) is None for pose in poses):
                return WorkingBox(centre, size, orientation, cone)
    return None


def _turned(kinematics: Kinematics, pose: np.ndarray) -> str:
    """Advice if only the tool's frame prevents it: many descriptions have x, not z, along the last axis."""
    from scipy.spatial.transform import Rotation

    axes, _, tip = kinematics.chain.axes_at_zero()
    along = tip[:3, :3].T @ axes[-1]
    poses = []
    for sign, spin in product((1.0, -1.0), range(4)):
        onto, _ = Rotation.align_vectors([0.0, 0.0, 1.0], sign * along)
        turned = pose.copy()
        turned[:3, :3] = pose[:3, :3] @ (Rotation.from_euler("z", 90 * spin, degrees=True) * onto).as_matrix()
        with contextlib.suppress(KinematicsError):
            poses.append((np.linalg.norm(kinematics.solve(turned, kinematics.middle) - kinematics.middle), turned))
    if not poses:
        return ""
    _, best = min(poses, key=lambda option: option[0])
    angles = ", ".join(f"{angle:.4g} deg" for angle in np.round(pose_to_pos(best)[3:], 2) + 0.0)
    return (
        f"; or turn the tool: with the orientation {angles} the arm's last axis points where the z axis of this one "
        "does, and the middle is within reach"
    )


def _complaint(kinematics: Kinematics, pose: np.ndarray) -> str | None:
    try:
        kinematics.solve(pose, kinematics.middle)
    except KinematicsError as error:
        return str(error)
    return None
