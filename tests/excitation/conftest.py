import math
from dataclasses import replace
from typing import Any

import pytest

from agent.excitation import LoopProblem
from agent.motion import FlyTrajectory, FlyType, Pdl2Settings, ViaRegions
from agent.robot import load_robot


@pytest.fixture(scope="session")
def problem() -> LoopProblem:
    """The quickstart's loop."""
    settings = Pdl2Settings(
        fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02, linear_speed=1.0
    )
    regions = box()
    return LoopProblem(load_robot("comau_ns16"), regions, settings)


def box(centre: tuple[float, ...] = (1.0, 0.0, 0.8), size: tuple[float, ...] = (0.5, 0.6, 0.4)) -> ViaRegions:
    """The quickstart's sub-region, or one like it elsewhere."""
    return ViaRegions.from_box(6, centre, size, (0.0, math.pi, 0.0), math.radians(30))


@pytest.fixture(scope="session")
def problem_with(problem: LoopProblem) -> Any:
    """The quickstart's loop with another box, or other fields."""

    def make(centre: tuple[float, ...] | None = None, size: tuple[float, ...] = (0.5, 0.6, 0.4), **changes: Any) -> Any:
        if centre is not None:
            changes["regions"] = box(centre, size)
        return replace(problem, **changes)

    return make
