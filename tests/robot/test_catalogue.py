"""The built-in robots against the figures published for them."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.robot import Dynamics, RobotDescription, Tool, builtin_robots, kinematics_for, load_robot
from tests.small_arms import make_arm

#: a [m], d [m], alpha [deg], sign, bias [deg] of the standard Denavit-Hartenberg convention.
DH = (
    (0.300, 0.600, -90, -1, 0),
    (0.700, 0.0, 0, 1, -90),
    (0.185, 0.0, -90, -1, -90),
    (0.0, 0.624, 90, -1, 0),
    (0.0, 0.0, -90, 1, 0),
    (0.0, 0.135, 0, -1, 180),
)


def denavit_hartenberg(degrees: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    for q, (a, d, alpha, sign, bias) in zip(degrees, DH, strict=True):
        turn, twist = np.radians(sign * q + bias), np.radians(alpha)
        about_z = np.array(
            [[np.cos(turn), -np.sin(turn), 0, 0], [np.sin(turn), np.cos(turn), 0, 0], [0, 0, 1, d], [0, 0, 0, 1]]
        )
        about_x = np.array(
            [[1, 0, 0, a], [0, np.cos(twist), -np.sin(twist), 0], [0, np.sin(twist), np.cos(twist), 0], [0, 0, 0, 1]]
        )
        pose = pose @ about_z @ about_x
    return pose


@settings(deadline=None)
@given(st.lists(st.floats(-720, 720), min_size=6, max_size=6))
def test_forward_kinematics_match_the_published_table(ns16: RobotDescription, degrees: list[float]) -> None:
    q = np.radians([degrees])
    expected = denavit_hartenberg(np.array(degrees))
    np.testing.assert_allclose(Dynamics(ns16).tcp_pose(q)[0], expected, atol=1e-12)
    np.testing.assert_allclose(kinematics_for(ns16).forward(q)[0], expected, atol=1e-12)


def test_drive_data_match_the_data_sheet(ns16: RobotDescription) -> None:
    assert "comau_ns16" in builtin_robots()
    np.testing.assert_allclose(ns16.gear_ratios, [-181.587, 159.261, 162.474, 72.586, 78.75, -50.0])
    np.testing.assert_allclose(ns16.nominal_torque, np.abs(ns16.gear_ratios) * [3, 6, 3, 0.7, 0.7, 0.7])
    np.testing.assert_allclose(np.degrees(ns16.max_velocity), [155, 155, 170, 360, 350, 550])
    ramp = ns16.max_velocity / ns16.max_acceleration
    np.testing.assert_allclose(ramp, [0.823] * 3 + [0.388] * 3)
    lower, upper = ns16.position_limits
    np.testing.assert_allclose(np.degrees(lower), [-180, -60, -170, -720, -120, -720])
    np.testing.assert_allclose(np.degrees(upper), [180, 155, 110, 720, 120, 720])


@pytest.mark.parametrize("name", builtin_robots())
def test_every_link_is_a_physical_body(name: str) -> None:
    """The pseudo-inertia of each link is positive definite (Wensing, Kim, Slotine, RA-L 2018)."""
    for m, mx, my, mz, xx, xy, yy, xz, yz, zz in Dynamics(load_robot(name)).standard_parameters().reshape(6, 10):
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        first = np.array([[mx], [my], [mz]])
        assert np.linalg.eigvalsh(np.block([[second, first], [first.T, np.array([[m]])]])).min() > 0


def test_the_motors_can_hold_the_outstretched_arm(ns16: RobotDescription) -> None:
    q = np.radians([[0.0, 90.0, -16.5, 0.0, 0.0, 0.0]])
    torque = np.abs(Dynamics(ns16).inverse_dynamics(q, 0 * q, 0 * q)[0])
    assert torque[1] > 300
    assert (torque < ns16.nominal_torque).all()


def test_the_reach_equals_the_outstretched_length(arms: dict[str, RobotDescription]) -> None:
    assert 0.79 < Dynamics(arms["planar"]).reach <= 0.8


@pytest.mark.parametrize("joints", [1, 3, 6])
def test_batch_torque_equals_single_sample_torque(ns16: RobotDescription, joints: int) -> None:
    motion = np.random.default_rng(0).uniform(-1.0, 1.0, (3, 200, joints))
    robot = ns16 if joints == 6 else make_arm("RPR"[:joints])
    arm = Dynamics(robot, Tool(np.eye(4), 2.0, np.array([0.0, 0.0, 0.1])))
    for dynamics in (arm, arm.with_parameters(1.1 * arm.standard_parameters())):
        one_by_one = [dynamics.inverse_dynamics(*sample[:, None])[0] for sample in motion.transpose(1, 0, 2)]
        np.testing.assert_array_equal(dynamics.inverse_dynamics(*motion), one_by_one)


def test_bodies_do_not_collide_in_the_working_range(ns16: RobotDescription) -> None:
    rng = np.random.default_rng(0)
    q = np.radians(rng.uniform([-180, -50, -160, -180, -120, -180], [180, 110, -20, 180, 120, 180], (1500, 6)))
    dynamics = Dynamics(ns16)
    along = np.linspace(0.0, 1.0, 8)[:, None]
    points = {}
    for link, (capsule,) in ns16.bodies.items():
        pose = dynamics.link_poses(q, link)
        inside = np.array(capsule.start) + along * (np.array(capsule.end) - np.array(capsule.start))
        points[link] = inside @ pose[:, :3, :3].transpose(0, 2, 1) + pose[:, None, :3, 3], capsule.radius
    names = list(ns16.bodies)
    for one, other in combinations(range(len(names)), 2):
        if other - one > 1:
            (a, ra), (b, rb) = points[names[one]], points[names[other]]
            assert np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min() > ra + rb, (names[one], names[other])


def test_a_description_round_trips_through_a_dictionary(ns16: RobotDescription) -> None:
    assert RobotDescription.from_dict(ns16.to_dict()) == ns16


@pytest.mark.parametrize("joint", range(6))
def test_limits_come_from_the_urdf(ns16: RobotDescription, joint: int) -> None:
    kinematics = kinematics_for(ns16)
    q = np.zeros((2, 6))
    q[:, joint] = ns16.joints[joint].upper + np.array([-1e-6, 1e-6])
    assert kinematics.within_limits(q).tolist() == [True, False]


#: a2, a3 and d1, d4, d5, d6 [m]; masses [kg]; centres of mass of the upper arm and of the first wrist link [m], in the
#: distal frame; torques of the joints [N·m] and their speeds [deg/s], as the vendor publishes them.
UNIVERSAL_ROBOTS = {
    "ur3e": (
        (-0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921),
        (1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
        ((0.13, 0, 0.1157), (0, 0, 0.01)),
        (54, 54, 28, 9, 9, 9),
        (180, 180, 180, 360, 360, 360),
    ),
    "ur5e": (
        (-0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996),
        (3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
        ((0.2125, 0, 0.11336), (0, -0.0018, 0.01634)),
        (150, 150, 150, 28, 28, 28),
        (180,) * 6,
    ),
    "ur10e": (
        (-0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655),
        (7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
        ((0.38, 0, 0.158), (0, 0.007, 0.018)),
        (330, 330, 150, 54, 54, 54),
        (120, 120, 180, 180, 180, 180),
    ),
}


@pytest.mark.parametrize("name", UNIVERSAL_ROBOTS)
def test_loads_the_built_in_universal_robots(name: str) -> None:
    """Frames of the URDF are those of the table before its shift and twist, so centres are carried over here."""
    (a2, a3, d1, d4, d5, d6), masses, (upper_arm, wrist), torques, speeds = UNIVERSAL_ROBOTS[name]
    robot = load_robot(name)
    straight = np.zeros((1, 6))
    tip = Dynamics(robot).tcp_pose(straight)[0]
    np.testing.assert_allclose(tip[:3, 3], [a2 + a3, -d4 - d6, d1 - d5], atol=1e-9)
    np.testing.assert_allclose(tip[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-9)
    links = Dynamics(robot).standard_parameters().reshape(6, 10)
    np.testing.assert_allclose(links[:, 0], masses)
    np.testing.assert_allclose(links[1, 1:4] / masses[1], np.add(upper_arm, [a2, 0, 0]), atol=1e-9)
    np.testing.assert_allclose(links[3, 1:4] / masses[3], [wrist[0], -wrist[2], wrist[1] + d4], atol=1e-9)
    np.testing.assert_allclose(robot.nominal_torque, torques, rtol=1e-5)
    np.testing.assert_allclose(np.degrees(robot.max_velocity), speeds)
    np.testing.assert_array_equal(robot.gear_ratios, 101)
    assert all(0.07 < (joint.torque_constant or 0) < 0.12 for joint in robot.joints)
    fixed = [joint.name for joint in robot.joints if not np.isclose(joint.upper, 2 * np.pi)]
    assert fixed == (["wrist_3_joint"] if name == "ur3e" else [])
