"""A one-sided friction, and a motion to weigh."""

from collections.abc import Sequence

import numpy as np

from agent.diagnosis import Diagnosis, diagnose
from agent.experiment.pieces import GridMotion
from agent.robot import RobotDescription
from fake_controller.plant import Plant
from tests.small_arms import learn, record


def one_sided(arm: RobotDescription) -> Diagnosis:
    """Friction of joint 2 differs by direction: while the joint moves, an offset would be the same."""
    effect = {"effect": "asymmetric_friction", "joints": ["joint_2"], "parameters": {"coulomb": 0.2}}
    plant = Plant(arm, seed=3, effects=[effect])
    return diagnose(arm, [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))], learn(arm))


def wave(arm: RobotDescription, amplitudes: Sequence[float], seconds: float) -> GridMotion:
    time = np.arange(0, seconds, 0.02)
    w = 2 * np.pi / seconds * np.arange(1, arm.dof + 1)
    a = np.asarray(amplitudes)
    phase = time[:, None] * w
    return GridMotion(time, a * np.sin(phase), a * w * np.cos(phase), -a * w**2 * np.sin(phase))
