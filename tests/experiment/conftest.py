"""A diagnosis that leaves two rivals open, and where a further motion may lie."""

import numpy as np
import pytest

from agent.diagnosis import Diagnosis
from agent.excitation import LoopProblem
from agent.motion import FlyTrajectory, FlyType, Pdl2Settings, ViaRegions
from agent.motion.regions import BoxRegion
from agent.robot import RobotDescription, kinematics_for
from tests.experiment.examples import one_sided
from tests.small_arms import make_arm


@pytest.fixture(scope="session")
def arm() -> RobotDescription:
    return make_arm("RR")


@pytest.fixture(scope="session")
def ambiguous(arm) -> Diagnosis:
    return one_sided(arm)


@pytest.fixture(scope="session")
def problem() -> LoopProblem:
    arm = make_arm("RRRRRR")
    pose = kinematics_for(arm, None).forward(np.array([[0.2, 0.2, 1.2, 0.3, 0.8, 0.2]]))[0]
    region = BoxRegion(pose, np.full(3, 0.1), 0.3)
    fly = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02)
    return LoopProblem(robot=arm, regions=ViaRegions((region,) * 4), settings=fly.changed(linear_speed=0.5))
