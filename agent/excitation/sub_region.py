"""Whether the arm reaches its sub-region at all: asked before minutes are spent on a search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.core import InputError
from agent.excitation.candidates import CORNERS, MIDDLE, TURNED, LoopProblem
from agent.robot import Kinematics, KinematicsError, kinematics_for

#: Where in a via-point's region it is asked: the middle, the corners of its position and the ends of its orientation.
_PLACES = {**MIDDLE, **CORNERS, **TURNED}


@dataclass(frozen=True)
class OutOfReach:
    """A place of a via-point's region that the arm does not reach, and the message that says by how much."""

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
            key = np.round(pose, 9).tobytes()  # the points of a box share their places
            if key not in known:
                known[key] = _complaint(kinematics, pose)
            complaint = known[key]
            if complaint is not None:
                missed.append(OutOfReach(point, place, complaint))
    for point in range(regions.count):
        mine = [miss for miss in missed if miss.point == point]
        if any(miss.place == "middle" for miss in mine) or 2 * len(mine) > len(_PLACES):
            raise InputError(
                f"{mine[0]}; {len(mine)} of {len(_PLACES)} places asked in this region are out of reach: "
                "move or shrink motion.via_points"
            )
    return missed


def _complaint(kinematics: Kinematics, pose: np.ndarray) -> str | None:
    try:
        kinematics.solve(pose, kinematics.middle)
    except KinematicsError as error:
        return str(error)
    return None
