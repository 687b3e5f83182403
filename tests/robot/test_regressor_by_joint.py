"""The compiled regressor against Pinocchio's."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.robot import Dynamics, Tool, load_robot
from tests.arms import Bar, serial_arm

NUMBER = st.floats(-1.0, 1.0)
TRIPLE = st.tuples(NUMBER, NUMBER, NUMBER)
AXIS = TRIPLE.filter(lambda axis: np.linalg.norm(axis) > 0.1)


def text(values: Any) -> str:
    return " ".join(map(str, values))


@st.composite
def arms(draw: Any) -> Any:
    bars = [
        Bar(draw(st.sampled_from("RRP")), text(draw(TRIPLE)), text(draw(AXIS)), 1.0, "0 0 0", (1.0, 1.0, 1.0))
        for _ in range(draw(st.integers(1, 5)))
    ]
    return serial_arm(bars)


def compare(dynamics: Dynamics, samples: int, seed: int) -> None:
    q, qd, qdd = np.random.default_rng(seed).normal(size=(3, samples, dynamics.dof))
    by_joint = dynamics.regressor_by_joint(q, qd, qdd)
    expected = dynamics.regressor(q, qd, qdd).transpose(1, 2, 0)
    np.testing.assert_allclose(by_joint, expected, rtol=0, atol=1e-13 * np.abs(expected).max(initial=1.0))


@settings(max_examples=25, deadline=None)
@given(arms(), st.integers(0, 4), st.integers(0, 2**31))
def test_the_joint_regressor_is_exact_for_any_serial_arm(robot: Any, samples: int, seed: int) -> None:
    compare(Dynamics(robot), samples, seed)


def test_the_joint_regressor_is_exact_with_tool_and_gravity() -> None:
    frame = np.eye(4)
    frame[:3, 3] = 0.1, 0.0, 0.2
    dynamics = Dynamics(load_robot("comau_ns16"), Tool(frame, 5.0, np.array([0.0, 0.05, 0.0])))
    compare(dynamics.with_gravity(np.array([3.0, -4.0, 8.0])), 6, 1)
    q, qd, qdd = np.random.default_rng(2).normal(size=(3, 60, 6))
    torque = (dynamics.standard_parameters() @ dynamics.regressor_by_joint(q, qd, qdd)).T
    np.testing.assert_allclose(torque, dynamics.inverse_dynamics(q, qd, qdd), rtol=1e-12, atol=1e-9)
    with pytest.raises(TypeError):  # compiled for arrays of samples, and nothing else
        dynamics.regressor_by_joint(q[0], qd[0], qdd[0])
