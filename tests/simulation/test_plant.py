"""The plant behind the fake controller: an honest robot, the same one for the same seed."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from agent.core import InputError
from agent.robot.dynamics import Dynamics
from fake_controller.actuation.drive import Drive
from fake_controller.actuation.machine import draw_machine, weighs_nothing
from fake_controller.plant import Plant
from tests.small_arms import true_torque

HOME = np.array([0.0, 0.0, -1.5, 0.0, 0.0, 0.0])
AWAY = np.array([0.7, 0.4, -1.0, 0.9, -0.8, 1.2])


def follow(plant, q, qd, **options):
    plant.rest(q[0])
    chunks = list(plant.run(q, qd, **options))
    return tuple(np.concatenate([getattr(c, name) for c in chunks]) for name in ("position", "velocity", "torque"))


@pytest.fixture(scope="module")
def motion(stop_and_go):
    return stop_and_go(np.array([HOME, AWAY, HOME, -0.5 * AWAY + 1.5 * HOME]), 1.2, pause=0.3)


@pytest.fixture(scope="module")
def run(ns16, motion):
    plant = Plant(ns16, 7)
    return plant, *follow(plant, *motion)


def test_a_seed_gives_the_same_samples_in_any_block_size(ns16, motion, run):
    _, *whole = run
    q, qd = motion[0][:500], motion[1][:500]
    again = follow(Plant(ns16, 7), q, qd, chunk=33)
    for first, second in zip(whole, again, strict=True):
        assert np.array_equal(first[:500], second)
    other = follow(Plant(ns16, 8), q, qd)
    assert np.abs(other[2] - again[2]).max() > 5.0


def test_tracking_errors_are_those_of_a_servo(ns16, motion, run):
    plant, position, velocity, _ = run
    q = motion[0]
    error = np.abs(position - q)
    assert 5e-4 < error.max() < 2e-2
    list(plant.hold(q[-1], 1.0))
    assert np.abs(plant.position - q[-1]).max() < 5e-5
    # Speed is the difference of counted positions: half a sample late, and no drift.
    assert np.abs(np.cumsum(velocity, axis=0) * 0.002 + position[0] - position).max() < 1e-4


@pytest.mark.parametrize(
    ("element", "wrong", "said"),
    [
        (r'izz="[^"]+"', 'izz="-50"', r"the bodies of this machine cannot exist: .* negative kinetic energy"),
        (r'<mass value="([^"]+)"', r'<mass value="-\1"', r"the link that joint_1 moves has a mass of -137.4 kg"),
    ],
)
def test_bodies_that_cannot_exist_are_refused(ns16, element, wrong, said):
    """Before anything is sent: with them no torque stays a number."""
    with pytest.raises(InputError, match=said):
        Plant(replace(ns16, urdf=re.sub(element, wrong, ns16.urdf)), 3)


def test_runs_wrong_inertias_with_positive_kinetic_energy(ns16):
    """Descriptions with placeholders are common: a link too thin for its inertia still moves."""
    Plant(replace(ns16, urdf=re.sub(r'iyy="[^"]+"', 'iyy="0.001"', ns16.urdf)), 3)


def test_positions_are_counts_of_the_motor_encoder(ns16, run):
    _, position, _, _ = run
    counts = position * np.abs(ns16.gear_ratios) * 2**14 / (2 * np.pi)
    assert np.abs(counts - np.round(counts)).max() < 1e-4


def test_torque_noise_is_half_a_percent_of_nominal(ns16, run):
    plant, *_ = run
    torque = np.concatenate([part.torque for part in plant.hold(HOME, 4.0)])[1000:]
    noise = np.diff(torque, axis=0).std(axis=0) / np.sqrt(2) / ns16.nominal_torque
    assert np.all((noise > 0.0045) & (noise < 0.0058))


def test_the_truth_predicts_the_torque_while_the_arm_moves(ns16, motion, run):
    plant, position, _, torque = run

    def smooth(values, cutoff):
        return sosfiltfilt(butter(4, cutoff, fs=500, output="sos"), values, axis=0)

    q = smooth(position, 100)
    qd = np.gradient(q, 0.002, axis=0)
    predicted = true_torque(plant, q, qd, np.gradient(qd, 0.002, axis=0))
    error = (smooth(torque, 30) - smooth(predicted, 30)) / ns16.nominal_torque
    error[(np.abs(qd) < 0.05) | (np.arange(len(q))[:, None] < 200)] = np.nan
    assert np.all(np.sqrt(np.nanmean(error[:-200] ** 2, axis=0)) < 0.01)


def test_the_truth_differs_slightly_from_the_description(ns16, run):
    truth = run[0].machine
    nominal = Dynamics(ns16).standard_parameters().reshape(6, 10)
    mine = truth.parameters.reshape(6, 10)
    change = mine[:, 0] / nominal[:, 0] - 1
    assert np.all(np.abs(change) < 0.15)
    assert np.abs(change).max() > 0.02
    rotors = truth.rotor_inertias / np.array([joint.rotor_inertia for joint in ns16.joints]) - 1
    assert np.all(np.abs(rotors) <= 0.1)
    assert np.all(rotors != 0)


def without_inertias(robot):
    return replace(robot, urdf=re.sub("<inertial>.*?</inertial>", "", robot.urdf, flags=re.DOTALL))


def test_an_arm_without_masses_gets_typical_ones(ns16):
    bare = draw_machine(without_inertias(ns16), 0)
    assert weighs_nothing(bare.robot)
    assert not weighs_nothing(ns16)
    real = Dynamics(ns16).standard_parameters()[::10].sum()
    assert 0.4 * real < bare.parameters[::10].sum() < 2.5 * real
    at = np.array([[0.0, 0.5, -1.5, 0.0, 0.5, 0.0]])
    held, true = (
        abs(machine.dynamics().inverse_dynamics(at, 0 * at, 0 * at)[0, 1]) for machine in (bare, draw_machine(ns16, 0))
    )
    assert 0.3 * true < held < 3 * true


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("bare", [False, True])
def test_every_machine_has_physical_links(ns16, seed, bare):
    robot = without_inertias(ns16) if bare else ns16
    for m, x, y, z, xx, xy, yy, xz, yz, zz in draw_machine(robot, seed).parameters.reshape(6, 10):
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        pseudo = np.zeros((4, 4))
        pseudo[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        pseudo[:3, 3] = pseudo[3, :3] = x, y, z
        pseudo[3, 3] = m
        assert np.linalg.eigvalsh(pseudo).min() > 0


def test_friction_sticks_gives_way_smoothly_and_saturates(ns16):
    """Pushed back and forth slowly, an axle's friction is a hysteresis loop without a jump."""
    machine = draw_machine(ns16, 7)
    drive, dt = Drive(machine), 0.0005
    position = 1e-3 * np.sin(2 * np.pi * 0.5 * dt * np.arange(8000))
    speed = np.gradient(position, dt)
    still = [0.0] * 6
    friction = -np.array([drive.step(0.0, still, [v, *still[1:]], still, dt)[0] for v in speed])
    curve = machine.friction[0]
    assert 0.9 * curve.coulomb < np.abs(friction[4000:]).max() < 1.05 * (curve.coulomb + curve.rise)
    assert np.abs(np.diff(friction)).max() < 0.1 * curve.coulomb
    loop = np.sum(friction[4000:] * speed[4000:]) * dt
    assert loop == pytest.approx(4 * 1e-3 * curve.coulomb, rel=0.25)


def test_steady_sliding_friction_matches_the_true_curve(ns16):
    machine = draw_machine(ns16, 7)
    drive = Drive(machine)
    still = [0.0] * 6
    for speed in (-1.5, -0.3, -0.01, 0.005, 0.05, 2.0):
        for _ in range(4000):
            load = drive.step(0.0, still, [speed] * 6, still, 0.0005)
        steady = [curve.steady(np.array([speed]))[0] for curve in machine.friction]
        assert np.allclose(-np.array(load), steady, rtol=1e-6)


@pytest.mark.parametrize(
    "form",
    [
        {"links": 1, "prismatic_first": True},
        {"links": 3, "gear": 1.0},
        {"links": 7},
        {"links": 4, "coupling": np.eye(4) + 0.2 * np.eye(4, k=-1)},
    ],
    ids=["one sliding joint", "no gears", "seven joints", "coupled"],
)
def test_simulates_arms_of_any_structure(make_arm, stop_and_go, form):
    robot = make_arm(**form)
    n = robot.dof
    plant = Plant(robot, 2)
    q, qd = stop_and_go(np.array([np.zeros(n), 0.4 * (-1.0) ** np.arange(n)]), 1.0)
    position, _, torque = follow(plant, q, qd)
    assert np.all(np.isfinite(torque))
    assert np.abs(position - q).max() < 1e-2
    list(plant.hold(q[-1], 1.0))
    assert np.abs(plant.position - q[-1]).max() < 5e-4


def test_with_motor_coupling_the_reported_torque_is_joint_torque(make_arm):
    """At rest the effort balances gravity on the joints, whatever the coupling, but for what sticks."""
    coupling = np.array([[1.0, 0.0], [0.5, 1.0]])
    robot = make_arm(2, coupling=coupling)
    plant = Plant(robot, 4)
    target = np.array([0.2, 0.3])
    plant.rest(target)
    torque = np.concatenate([part.torque for part in plant.hold(target, 0.5)]).mean(axis=0)
    gravity = plant.machine.dynamics().inverse_dynamics(target[None], np.zeros((1, 2)), np.zeros((1, 2)))[0]
    noise = 0.005 * plant.machine.nominal @ np.abs(coupling)
    assert np.all(np.abs(torque - gravity) < 3 * noise)
