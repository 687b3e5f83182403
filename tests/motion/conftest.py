"""An arm, its interpolator, and random programs."""

from collections.abc import Callable

import numpy as np
import pytest

from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, OrientationType, SpeedOption
from agent.motion.pdl2.settings import Pdl2Settings, Termination
from agent.motion.program import CartesianTarget, Delay, JointTarget, Move, MoveType, Statement
from agent.motion.regions import pose_of
from agent.robot import Kinematics, RobotDescription, kinematics_for

CENTRE = np.array([1.0, 0.0, 0.8])
SIZE = np.array([0.5, 0.6, 0.4])


@pytest.fixture(scope="session")
def kinematics(ns16: RobotDescription) -> Kinematics:
    return kinematics_for(ns16)


@pytest.fixture(scope="session")
def fly(ns16: RobotDescription) -> FlyInterpolator:
    return FlyInterpolator(ns16)


@pytest.fixture(scope="session")
def home(kinematics: Kinematics) -> np.ndarray:
    """Joints with the tool pointing down in the middle of the box that random programs live in."""
    return kinematics.solve(tool_down(CENTRE), np.array([0.0, 0.0, -np.pi / 2, 0.0, np.pi / 3, 0.0]))


def tool_down(position: np.ndarray, tilt: np.ndarray | None = None) -> np.ndarray:
    """(4, 4) at a position (3,), the tool axis down but for a rotation vector (3,)."""
    pose = pose_of([*position, 0.0, np.pi, 0.0])
    if tilt is not None:
        angle = float(np.linalg.norm(tilt))
        axis = tilt / max(angle, 1e-12)
        cross = np.cross(np.eye(3), axis)
        pose[:3, :3] = pose[:3, :3] @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
    return pose


@pytest.fixture(scope="session")
def down() -> Callable[..., np.ndarray]:
    return tool_down


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return tool_down(CENTRE + (rng.random(3) - 0.5) * SIZE, rng.uniform(-0.3, 0.3, 3))


def random_settings(rng: np.random.Generator, **fixed: object) -> Pdl2Settings:
    """Every mode and number that is planned."""

    def one_of(kind):
        return list(kind)[rng.integers(len(kind))]

    values = {
        "fly_type": one_of(FlyType),
        "fly_trajectory": one_of(FlyTrajectory),
        "fly_distance": 10 ** rng.uniform(-3, -1),
        "fly_percent": rng.uniform(1, 100),
        "stress_percent": rng.uniform(1, 100),
        "speed_option": one_of(SpeedOption),
        "linear_speed": rng.uniform(0.1, 1.5),
        "rotational_speed": rng.uniform(0.2, 2),
        "orientation": one_of([one for one in OrientationType if one is not OrientationType.WRIST_JNT]),
        "termination": one_of(Termination),
        "speed_override": rng.uniform(0.3, 1),
        "acceleration_override": rng.uniform(0.3, 1),
        "deceleration_override": rng.uniform(0.3, 1),
        "arm_override": rng.uniform(0.5, 1),
    }
    return Pdl2Settings().changed(**(values | fixed))


@pytest.fixture(scope="session")
def random_program(home: np.ndarray) -> Callable[..., list[Statement]]:
    """`random_program(seed)`: moves of all kinds, FLY or not, some DELAYs, each with its own settings."""

    def program(seed: int, count: int = 5) -> list[Statement]:
        rng = np.random.default_rng(seed)
        statements: list[Statement] = []
        for k in range(count):
            if rng.random() < 0.1:
                statements.append(Delay(rng.uniform(0, 0.2)))
            kind = list(MoveType)[rng.choice(3, p=[0.5, 0.3, 0.2])]
            target = CartesianTarget(random_pose(rng))
            if rng.random() < 0.2:
                target = JointTarget(home + rng.uniform(-0.3, 0.3, 6))
            via = CartesianTarget(random_pose(rng)) if kind is MoveType.CIRCULAR else None
            settings = random_settings(rng)
            statements.append(Move(kind, target, settings, fly=rng.random() < 0.75, via=via, name=f"p{k + 1}"))
        return statements

    return program


@pytest.fixture(scope="session")
def random_lines() -> Callable[..., list[Move]]:
    """`random_lines(seed, **settings)`: a polyline of LINEAR moves that fly, all with the same settings."""

    def program(seed: int, count: int = 5, **settings: object) -> list[Move]:
        rng = np.random.default_rng(seed)
        base = {
            "fly_type": FlyType.FLY_CART,
            "fly_trajectory": FlyTrajectory.FLY_TOL,
            "fly_distance": 10 ** rng.uniform(-3, -1),
            "stress_percent": rng.uniform(1, 100),
            "linear_speed": 10 ** rng.uniform(-1.3, 0.17),
        }
        common = Pdl2Settings().changed(**(base | settings))
        return [
            Move(MoveType.LINEAR, CartesianTarget(random_pose(rng)), common, fly=k < count - 1, name=f"p{k + 1}")
            for k in range(count)
        ]

    return program
