from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.excitation.criterion import Criterion, log_determinant, torque_weights
from agent.robot import Dynamics, RobotDescription, base_parameters, load_robot


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return load_robot("comau_ns16")


@pytest.fixture(scope="module")
def criterion(robot: RobotDescription) -> Criterion:
    return Criterion(robot)


@pytest.fixture(scope="module")
def states() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    return rng.uniform(-2, 2, (150, 6)), rng.normal(size=(150, 6)), 3 * rng.normal(size=(150, 6))


def brute_force(matrix: np.ndarray, points: int) -> float:
    return float(np.linalg.slogdet(matrix.T @ matrix / points)[1] / np.log(10))


def matrices(rows: tuple[int, int] = (8, 40)) -> st.SearchStrategy[np.ndarray]:
    shape = st.tuples(st.integers(*rows), st.integers(1, 6), st.integers(0, 2**32 - 1))
    return shape.map(lambda s: np.random.default_rng(s[2]).normal(size=s[:2]))


def test_the_ns16_has_58_columns(criterion: Criterion) -> None:
    assert len(criterion.columns) == len(set(criterion.columns)) == 58
    assert criterion.columns[-18:-16] == ("f0 joint_1", "f0 joint_2")


def test_equals_the_log_determinant_of_the_normal_matrix(criterion: Criterion, states: tuple[np.ndarray, ...]) -> None:
    expected = brute_force(criterion.observation_matrix(*states), len(states[0]))
    assert criterion(*states) == pytest.approx(expected, abs=1e-6)


def test_the_matrix_gives_the_weighted_torque(
    robot: RobotDescription, criterion: Criterion, states: tuple[np.ndarray, ...]
) -> None:
    q, qd, qdd = states
    dynamics = Dynamics(robot)
    rotors = np.array([joint.rotor_inertia for joint in robot.joints])
    base = base_parameters(robot).projection @ np.concatenate([dynamics.standard_parameters(), rotors])
    friction = np.random.default_rng(1).uniform(1, 50, (3, 6))
    torque = dynamics.inverse_dynamics(q, qd, qdd) + robot.gear_ratios**2 * rotors * qdd
    torque += friction[0] * np.sign(qd) + friction[1] * qd + friction[2] * np.sign(qd) * qd**2
    weighted = criterion.observation_matrix(q, qd, qdd) @ np.concatenate([base, friction.ravel()])
    nominal = robot.nominal_torque
    np.testing.assert_allclose(weighted.reshape(q.shape), torque * nominal / nominal.max(), atol=1e-7)


def test_without_nominal_torques_every_joint_weighs_the_same(robot: RobotDescription) -> None:
    one_lacks = (replace(robot.joints[0], nominal_motor_torque=None), *robot.joints[1:])
    np.testing.assert_array_equal(torque_weights(replace(robot, joints=one_lacks)), np.ones(6))
    assert torque_weights(robot).max() == 1.0


def test_a_motion_with_a_stationary_joint_scores_minus_infinity(
    criterion: Criterion, states: tuple[np.ndarray, ...]
) -> None:
    q, qd, qdd = (array.copy() for array in states)
    qd[:, 3] = qdd[:, 3] = 0.0
    assert criterion(q, qd, qdd) == -np.inf


def test_running_the_motion_twice_keeps_the_score(criterion: Criterion, states: tuple[np.ndarray, ...]) -> None:
    twice = [np.concatenate([array, array]) for array in states]
    assert criterion(*twice) == pytest.approx(criterion(*states), abs=1e-9)


def test_the_same_motion_has_a_bit_identical_score(criterion: Criterion, states: tuple[np.ndarray, ...]) -> None:
    assert criterion(*states) == criterion(*states)


@given(matrices())
def test_small_cases_agree_with_brute_force(matrix: np.ndarray) -> None:
    assert log_determinant(matrix, 7) == pytest.approx(brute_force(matrix, 7), abs=1e-8)


@given(matrices(), st.integers(1, 1000), st.integers(1, 1000))
def test_the_sample_count_enters_once_per_parameter(matrix: np.ndarray, few: int, many: int) -> None:
    apart = log_determinant(matrix, few) - log_determinant(matrix, many)
    assert apart == pytest.approx(matrix.shape[1] * np.log10(many / few), abs=1e-9)


@given(matrices(), matrices(), st.lists(st.floats(1e-9, 1e9), min_size=6, max_size=6))
def test_units_of_the_parameters_do_not_change_the_ranking(
    first: np.ndarray, second: np.ndarray, factors: list[float]
) -> None:
    columns = min(first.shape[1], second.shape[1])
    first, second, scale = first[:, :columns], second[:, :columns], np.array(factors[:columns])
    shift = log_determinant(first * scale, 9) - log_determinant(first, 9)
    assert shift == pytest.approx(2 * np.log10(scale).sum(), abs=1e-7)
    assert log_determinant(second * scale, 9) - log_determinant(second, 9) == pytest.approx(shift, abs=1e-7)


#: Large enough for their products to keep full precision.
WEIGHTS = st.one_of(st.just(0.0), st.floats(1e-12, 10), st.floats(-10, -1e-12))


@given(matrices(rows=(12, 40)), st.data())
@settings(max_examples=50)
def test_dependent_columns_score_minus_infinity(matrix: np.ndarray, data: st.DataObject) -> None:
    weights = np.array(data.draw(st.lists(WEIGHTS, min_size=matrix.shape[1], max_size=matrix.shape[1])))
    place = data.draw(st.integers(0, matrix.shape[1]))
    dependent = np.insert(matrix, place, matrix @ weights, axis=1)
    assert log_determinant(dependent, 5) == -np.inf


def test_fewer_rows_than_columns_score_minus_infinity() -> None:
    assert log_determinant(np.random.default_rng(0).normal(size=(4, 5)), 4) == -np.inf
