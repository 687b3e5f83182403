"""Effects that no catalogue has: they act, they are drawn from their seed, and nothing drives that should drag."""

import numpy as np
import pytest

from agent.robot import load_robot
from fake_controller.plant import Plant

ROBOT = load_robot("comau_ns16")
FORMS = {
    "rough_bearing": {"amplitude": 60.0, "patch": 0.05},
    "wandering_torque": {"amplitude": 30.0, "memory": 0.3},
    "rubbing_brake": {"drag": 50.0, "on": 0.3, "off": 0.5},
}


def torque(name: str | None, seed: float = 1.0) -> np.ndarray:
    """(S,) on joint 1 while it turns to and fro."""
    effects = (
        [] if name is None else [{"effect": name, "joints": ["joint_1"], "parameters": {**FORMS[name], "seed": seed}}]
    )
    plant = Plant(ROBOT, seed=4, effects=effects)
    time = np.arange(0, 3, 0.002)
    q, qd = np.zeros((len(time), ROBOT.dof)), np.zeros((len(time), ROBOT.dof))
    q[:, 0], qd[:, 0] = 0.5 * (1 - np.cos(2 * time)), np.sin(2 * time)
    plant.rest(q[0])
    return np.concatenate([part.torque for part in plant.run(q, qd)])[:, 0]


@pytest.mark.parametrize("name", FORMS)
def test_the_effect_acts_and_its_seed_determines_it(name):
    without, once, again, other = torque(None), torque(name), torque(name), torque(name, 2.0)
    np.testing.assert_array_equal(once, again)
    size = next(iter(FORMS[name].values()))
    assert 0.1 * size < np.std(once - without) < 1.5 * size
    assert np.std(once - other) > 0.1 * size


@pytest.mark.parametrize("name", ["rough_bearing", "rubbing_brake"])
def test_drag_effects_dissipate_power(name):
    time = np.arange(0, 3, 0.002)
    speed = np.sin(2 * time)
    extra = (torque(name) - torque(None)) * speed
    assert np.mean(extra) > 0
