"""What cannot be run is refused with the statement, the limit and by how much, in bounded time."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, MotionError, OrientationType, Pdl2Settings
from agent.motion.program import CartesianTarget, Delay, JointTarget, Move, MoveType

PLAIN = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02)


def line(pose, fly=False, name="", configuration="", **changed):
    target = CartesianTarget(np.asarray(pose), configuration)
    return Move(MoveType.LINEAR, target, PLAIN.changed(**changed), fly=fly, name=name, line=7 if name else 0)


def refusal(fly, program, start) -> MotionError:
    with pytest.raises(MotionError) as caught:
        fly.plan(program, start)
    assert caught.value.exit_code == 2
    return caught.value


def test_out_of_reach_names_the_point_and_grows_with_the_distance(fly, home, down):
    def at(x):
        return refusal(fly, [line(down([1.0, 0.1, 0.8]), fly=True), line(down([x, 0.1, 0.8]), name="far_point")], home)

    errors = [at(x) for x in (1.9, 2.4, 3.5)]
    assert all(error.move == 1 and error.limit == "reach" for error in errors)
    assert "far_point" in str(errors[0])
    assert "line 7" in str(errors[0])
    assert errors[0].excess < errors[1].excess < errors[2].excess


def test_a_joint_limit_names_joint_and_amount(fly, home):
    def beyond(degrees):
        target = home.copy()
        target[4] = np.radians(120 + degrees)
        return refusal(fly, [Move(MoveType.JOINT, JointTarget(target), PLAIN)], home)

    near, far = beyond(2), beyond(30)
    assert near.limit == far.limit == "joint_5 position"
    assert "2 degrees" in str(near)
    assert 0 < near.excess < far.excess


def test_a_line_through_the_wrist_singularity_is_refused(fly, kinematics):
    start = np.radians([0, 0, -90, 0, -25, 0.0])
    end = np.radians([0, 0, -90, 0, 25, 0.0])
    error = refusal(fly, [line(kinematics.forward(end[None])[0], name="beyond")], start)
    assert error.limit in ("singularity", "branch")
    assert "beyond" in str(error)
    assert "singular" in str(error)


def test_singularities_are_kept_away_from_on_request(fly, kinematics):
    start = np.radians([0, 0, -90, 0, 40, 0.0])
    end = np.radians([5, 0, -90, 0, 2, 0.0])
    pose = kinematics.forward(end[None])[0]
    fly.plan([line(pose)], start)
    error = refusal(fly, [line(pose, singularity_care=True)], start)
    assert error.limit == "singularity"
    assert "$SING_CARE" in str(error)


def test_configuration_care_refuses_another_configuration(fly, home, down, kinematics):
    pose = down([1.0, 0.2, 0.8])
    arrival = str(kinematics.configuration(kinematics.solve(pose, home)))
    other = arrival.replace("W ", "") if "W " in arrival else "W " + arrival
    turned = arrival.replace("T1:0", "T1:1")
    fly.plan([line(pose, configuration=other)], home)
    fly.plan([line(pose, configuration=arrival, configuration_care=True, turn_care=True)], home)
    assert refusal(fly, [line(pose, configuration=other, configuration_care=True)], home).limit == "configuration"
    assert refusal(fly, [line(pose, configuration=turned, turn_care=True)], home).limit == "configuration"


def test_refuses_a_circle_through_collinear_points(fly, home, down):
    via = CartesianTarget(down([1.0, 0.1, 0.8]))
    move = Move(MoveType.CIRCULAR, CartesianTarget(down([1.0, 0.2, 0.8])), PLAIN, via=via)
    assert refusal(fly, [move], home).limit == "circle"
    with pytest.raises(InputError, match="VIA"):
        fly.plan([Move(MoveType.CIRCULAR, CartesianTarget(down([1.0, 0.2, 0.8])), PLAIN)], home)


def test_refuses_an_unsupported_orientation_mode_by_name(fly, home, down):
    error = refusal(fly, [line(down([1.0, 0.2, 0.8]), orientation=OrientationType.WRIST_JNT)], home)
    assert error.limit == "orientation"
    assert "WRIST_JNT" in str(error)


def test_motions_without_end_are_refused(fly, home, down):
    assert refusal(fly, [line(down([1.0, 0.2, 0.8]), linear_speed=1e-7)], home).limit == "duration"
    assert refusal(fly, [Delay(1e9)], home).limit == "duration"
    assert refusal(fly, [Delay(float("nan"))], home).limit == "duration"
    assert refusal(fly, [Delay(3000.0), Delay(3000.0)], home).move == 1


@pytest.mark.parametrize(
    "changed",
    [
        {"linear_speed": 0.0},
        {"linear_speed": float("nan")},
        {"rotational_speed": -1.0},
        {"stress_percent": 0.0},
        {"fly_percent": 101.0},
        {"speed_override": 0.0},
        {"arm_override": 1.5},
        {"fly_distance": -0.01},
    ],
)
def test_refuses_invalid_settings(fly, home, down, changed):
    with pytest.raises(InputError, match=next(iter(changed))):
        fly.plan([line(down([1.0, 0.2, 0.8]), **changed)], home)


def test_refuses_invalid_points(fly, home, down):
    sheared = down([1.0, 0.2, 0.8])
    sheared[0, 1] += 0.1
    infinite = down([1.0, np.inf, 0.8])
    for pose in (sheared, infinite, np.eye(3)):
        with pytest.raises(InputError, match="statement 1"):
            fly.plan([line(pose)], home)
    with pytest.raises(InputError, match="6 finite"):
        fly.plan([Move(MoveType.JOINT, JointTarget(np.zeros(5)), PLAIN)], home)
    with pytest.raises(InputError, match="start"):
        fly.plan([], np.zeros(5))
    with pytest.raises(InputError, match="period"):
        FlyInterpolator(fly.robot, period=0.0)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(scale=st.floats(-4, 2), speed=st.floats(-4, 3), distance=st.floats(-6, 2), seed=st.integers(0, 2**32 - 1))
def test_any_sizes_end_in_a_trajectory_or_a_refusal(fly, home, down, scale, speed, distance, seed):
    rng = np.random.default_rng(seed)
    points = [np.array([1.0, 0.0, 0.8]) + 10**scale * rng.uniform(-1, 1, 3) for _ in range(4)]
    changed = {"linear_speed": 10**speed, "fly_distance": 10**distance}
    program = [line(down(point, rng.uniform(-0.2, 0.2, 3)), fly=k < 3, **changed) for k, point in enumerate(points)]
    try:
        trajectory = fly.plan(program, home)
    except MotionError:
        return
    assert np.isfinite(trajectory.q).all()
    assert np.max(np.abs(np.diff(trajectory.q, axis=0)) / 0.002 / fly.robot.max_velocity, initial=0) <= 1
