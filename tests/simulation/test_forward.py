"""Forward simulation: energy, a second integrator, and the laws an integrator must keep."""

from dataclasses import replace

import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp

from agent.robot import Dynamics, rotor_mass_matrix
from agent.simulators import ForwardSimulation, RigidActuation, ServoGains
from fake_controller.actuation.drive import Drive, SteppedSimulation, rigid_actuation
from fake_controller.actuation.machine import draw_machine

ROTORS = 2e-4


def no_torque(dof: int) -> ServoGains:
    """Drives that are switched off."""
    return ServoGains.tuned(np.ones(dof), np.zeros(dof))


def frictionless(dof: int) -> RigidActuation:
    return RigidActuation(*(np.zeros(dof),) * 4)


def total_energy(robot, q, qd):
    links = links_energy(Dynamics(robot), q, qd)
    rotors = rotor_mass_matrix(robot, np.full(robot.dof, ROTORS))
    return links[0] + 0.5 * np.einsum("si,ij,sj->s", qd, rotors, qd), links[1]


def links_energy(dynamics, q, qd):
    """(2, S) kinetic and potential energy [J] of the rigid bodies, by Pinocchio."""
    model, data = dynamics._model, dynamics._data
    kinetic = [pinocchio.computeKineticEnergy(model, data, a, b) for a, b in zip(q, qd, strict=True)]
    return np.array([kinetic, [pinocchio.computePotentialEnergy(model, data, a) for a in q]])


class Watched:
    """An actuation that remembers what went in and out, step by step."""

    def __init__(self, inner):
        self.inner = inner
        self.rigid = inner.rigid
        self.reset, self.motors = inner.reset, inner.motors
        self.torques, self.loads, self.speeds = [], [], []

    def step(self, time, position, velocity, torque, dt):
        load = self.inner.step(time, position, velocity, torque, dt)
        self.torques.append(list(torque))
        self.loads.append(list(load))
        self.speeds.append(list(velocity))
        return load


@pytest.mark.parametrize("coupled", [False, True])
def test_a_falling_arm_conserves_energy(make_arm, coupled):
    coupling = np.eye(3) + (np.eye(3, k=-1) * 0.4 if coupled else 0.0)
    robot = make_arm(3, coupling=coupling)
    simulation = ForwardSimulation(Dynamics(robot), np.full(3, ROTORS), frictionless(3), no_torque(3), period=0.0005)
    simulation.rest(np.array([0.2, -0.3, 0.4]))
    motion = simulation.run(np.zeros((6000, 3)), np.zeros((6000, 3)))
    kinetic, potential = total_energy(robot, motion.position, motion.velocity)
    exchanged = kinetic.max()
    assert exchanged > 30.0
    assert np.abs(kinetic + potential - potential[0]).max() < 1e-3 * exchanged


def test_motor_work_equals_energy_plus_dissipation(ns16, stop_and_go):
    machine = draw_machine(ns16, 5)
    drive = Watched(Drive(machine))
    dynamics = machine.dynamics()
    gains = ServoGains.tuned(machine.typical_inertia, machine.limit)
    simulation = SteppedSimulation(dynamics, machine.rotor_inertias, drive, gains, period=0.0005)
    q, qd = stop_and_go(np.array([[0, 0, -1.5, 0, 0, 0], [0.8, 0.5, -1.0, 1.0, -0.8, 1.5]]), 1.2, period=0.0005)
    simulation.rest(q[0])
    simulation.run(q[:1600], qd[:1600])
    dt, speeds = 0.0005, np.array(drive.speeds)
    torques, loads = np.array(drive.torques), np.array(drive.loads)
    work = np.sum(torques * speeds) * dt
    heat = np.sum((torques - loads) * speeds) * dt
    state, velocity = simulation.position, simulation.velocity
    rotors = rotor_mass_matrix(ns16, machine.rotor_inertias)
    before, after = links_energy(dynamics, [q[0], state], [np.zeros(6), velocity]).sum(axis=0)
    energy = after - before + 0.5 * velocity @ rotors @ velocity
    assert heat > 50.0  # the friction of all axles over this motion, in joules
    assert abs(work - heat - energy) < 2e-3 * (abs(work) + heat)


def test_a_second_integrator_agrees_and_the_difference_is_first_order_in_the_step(make_arm):
    robot = make_arm(2)
    period = 0.002
    dynamics = Dynamics(robot)
    rotors = np.full(2, ROTORS)
    gains = ServoGains.tuned(np.array([8.0, 4.0]), np.full(2, 1e4))
    friction = np.array([6.0, 4.0]), np.array([2.0, 1.0]), np.array([0.3, 0.2]), np.array([0.05, 0.05])
    start, amplitude, rate = np.array([0.3, -0.4]), np.array([0.4, -0.5]), 4.0

    def reference(t):
        return start + amplitude * (1 - np.cos(rate * t)) / 2, amplitude * rate * np.sin(rate * t) / 2

    matrix = rotor_mass_matrix(robot, rotors)
    f0, f1, f2, transition = friction

    def ode(t, state):
        q, v, integral = state[:2], state[2:4], state[4:]
        r, rd = reference(max(t - period, 0.0))  # the drive is one set-point behind
        error = gains.feedforward * rd + gains.position * (r - q) - v
        motor = gains.velocity * error + integral
        load = motor - f0 * np.tanh(v / transition) - f1 * v - f2 * np.abs(v) * v
        bias = dynamics.inverse_dynamics(q[None], v[None], np.zeros((1, 2)))[0]
        return np.concatenate(
            [v, np.linalg.solve(dynamics.mass_matrix(q) + matrix, load - bias), gains.integral * error]
        )

    hold = dynamics.inverse_dynamics(start[None], np.zeros((1, 2)), np.zeros((1, 2)))[0]
    t = period * np.arange(750)
    exact = (
        solve_ivp(
            ode,
            (0, t[-1]),
            np.concatenate([start, np.zeros(2), hold]),
            "DOP853",
            t,
            rtol=1e-9,
            atol=1e-11,
            max_step=0.01,
        )
        .y[:2]
        .T
    )
    worst = {}
    for inner in (2000.0, 4000.0):
        simulation = ForwardSimulation(dynamics, rotors, RigidActuation(*friction), gains, period, inner)
        simulation.rest(start)
        motion = simulation.run(*reference(t[:, None]))
        worst[inner] = np.abs(motion.position - exact).max()
    assert worst[2000.0] < 2e-4
    assert worst[4000.0] < 0.6 * worst[2000.0]


def test_the_bristles_agree_with_a_stiff_integrator(make_arm):
    robot = make_arm(1)
    machine = draw_machine(robot, 3)
    dynamics = machine.dynamics()
    curve = machine.friction[0]
    rotor = machine.reflected_rotors[0]
    gains = ServoGains.tuned(machine.typical_inertia, machine.limit)
    period, rate = 0.002, 5.0

    def reference(t):
        return 0.3 * (1 - np.cos(rate * t)), 0.3 * rate * np.sin(rate * t)

    def ode(t, state):
        q, v, integral, z = state
        r, rd = reference(max(t - period, 0.0))
        error = gains.feedforward[0] * rd + gains.position[0] * (r - q) - v
        motor = gains.velocity[0] * error + integral
        level = curve.coulomb + curve.rise * np.exp(-((v / curve.stribeck_speed) ** 2))
        load = motor - z - curve.viscous * v / (1 + abs(v) / curve.knee)
        inertia = dynamics.mass_matrix(np.array([q]))[0, 0] + rotor
        bias = dynamics.inverse_dynamics(np.array([[q]]), np.array([[v]]), np.zeros((1, 1)))[0, 0]
        return [v, (load - bias) / inertia, gains.integral[0] * error, curve.stiffness * (v - abs(v) * z / level)]

    t = period * np.arange(1000)
    exact = solve_ivp(ode, (0, t[-1]), np.zeros(4), "LSODA", t, rtol=1e-8, atol=1e-10, max_step=0.01).y
    simulation = SteppedSimulation(dynamics, machine.rotor_inertias, Drive(machine), gains, period)
    simulation.rest(np.zeros(1))
    q, qd = reference(t)
    motion = simulation.run(q[:, None], qd[:, None])
    assert np.abs(exact[0]).max() > 0.5
    assert np.abs(motion.position[:, 0] - exact[0]).max() < 3e-4
    # The reversals, where friction swings from one side to the other, agree to a few percent of that swing.
    torque = gains.velocity[0] * (
        gains.feedforward[0] * reference(np.maximum(t - period, 0))[1]
        + gains.position[0] * (reference(np.maximum(t - period, 0))[0] - exact[0])
        - exact[1]
    )
    torque += exact[2]
    assert np.sqrt(np.mean((motion.torque[:, 0] - torque) ** 2)) < 0.05 * curve.coulomb


@given(links=st.integers(1, 7), seed=st.integers(0, 1000), factor=st.sampled_from([0.0, 0.3]), damped=st.booleans())
@settings(max_examples=25, deadline=None)
def test_accelerations_are_consistent_with_inverse_dynamics(make_arm, links, seed, factor, damped):
    robot = make_arm(links, coupling=np.eye(links) + factor * np.eye(links, k=-1))
    rng = np.random.default_rng(seed)
    dynamics = Dynamics(robot)
    q, qd, torque = rng.normal(size=(3, links))
    axle_inertia, added = rng.uniform(0.1, 3.0, (2, links))
    qdd = dynamics.acceleration_function(axle_inertia)(q, qd, torque, added if damped else None).copy()
    rotors = robot.coupling.T @ np.diag(axle_inertia + (added if damped else 0.0)) @ robot.coupling
    back = dynamics.inverse_dynamics(q[None], qd[None], qdd[None])[0] + rotors @ qdd
    assert np.allclose(back, torque, atol=1e-8 * (1 + np.abs(qdd).max()))


@given(transition=st.sampled_from([0.0, 1e-6, 1e-3]), coulomb=st.floats(80.0, 1e5))
@settings(max_examples=15, deadline=None)
def test_steep_friction_holds_an_unpowered_arm(make_arm, transition, coulomb):
    robot = make_arm(1)
    arm = replace(robot, gravity=(0.0, -9.80665, 0.0))
    friction = RigidActuation(np.full(1, coulomb), np.zeros(1), np.zeros(1), np.full(1, transition))
    simulation = ForwardSimulation(Dynamics(arm), np.full(1, ROTORS), friction, no_torque(1))
    simulation.rest(np.zeros(1))
    motion = simulation.run(np.zeros((500, 1)), np.zeros((500, 1)))
    # Gravity is 39 N·m: the tanh creeps at less than its transition speed, and nothing oscillates.
    assert np.abs(motion.velocity[10:]).max() <= 0.6 * transition + 1e-8
    assert np.abs(np.diff(motion.velocity[50:], axis=0)).max() < 1e-6


@pytest.mark.parametrize("case", ["wrist", "sliding", "seven"])
def test_compiled_steps_equal_the_python_actuation(ns16, make_arm, stop_and_go, case):
    robot = {"sliding": lambda: make_arm(3, prismatic_first=True), "wrist": lambda: ns16}.get(
        case, lambda: make_arm(7)
    )()
    machine = draw_machine(robot, 1)
    gains = ServoGains.tuned(machine.typical_inertia, 0.5 * machine.limit)
    ends = np.random.default_rng(3).uniform(-0.5, 0.5, (2, robot.dof))
    q, qd = stop_and_go(ends, 0.6)
    for push in (None, lambda time, q, qd: 0.05 * machine.limit * np.sin(9.0 * time + q + qd)):
        runs = []
        arms = (ForwardSimulation, rigid_actuation(machine)), (SteppedSimulation, Drive(machine))
        for kind, drive in arms:
            simulation = kind(machine.dynamics(), machine.rotor_inertias, drive, gains, external=push)
            simulation.rest(q[0])
            runs.append(simulation.run(q, qd))
        for what in ("time", "position", "velocity", "motor_position", "motor_velocity", "torque"):
            compiled, asked = (getattr(run, what) for run in runs)
            np.testing.assert_allclose(compiled, asked, rtol=0, atol=1e-9 * np.abs(asked).max())


def test_a_torque_from_outside_is_asked_for_or_known_of_every_sample(make_arm, stop_and_go):
    robot = make_arm(2)
    q, qd = stop_and_go(np.array([[0.1, -0.2], [0.4, 0.3]]), 0.6)
    push = 3.0 * np.sin(np.arange(2 * len(q)) / 40)[:, None] * [1.0, 0.5]
    gains, runs = ServoGains.tuned(np.ones(2), np.full(2, np.inf)), []
    for external in (push, lambda time, q, qd: push[round(time / 0.002)]):
        simulation = ForwardSimulation(Dynamics(robot), np.ones(2), frictionless(2), gains, external=external)
        simulation.rest(q[0])
        runs.append([simulation.run(q, qd).torque for _ in range(2)])
    np.testing.assert_array_equal(*runs)


def test_set_points_are_reached_one_period_later_and_the_state_persists(ns16, stop_and_go):
    machine = draw_machine(ns16, 1)
    gains = ServoGains.tuned(machine.typical_inertia, machine.limit)
    q, qd = stop_and_go(np.array([[0, 0, -1.5, 0, 0.3, 0], [0.4, 0.2, -1.2, 0.5, -0.2, 0.6]]), 0.8)
    runs = []
    for pieces in (1, 7):
        simulation = SteppedSimulation(machine.dynamics(), machine.rotor_inertias, Drive(machine), gains)
        simulation.rest(q[0])
        parts = [
            simulation.run(a, b) for a, b in zip(np.array_split(q, pieces), np.array_split(qd, pieces), strict=True)
        ]
        runs.append(np.concatenate([part.position for part in parts]))
        assert np.allclose(np.concatenate([part.time for part in parts]), 0.002 * np.arange(len(q)))
    assert np.array_equal(*runs)
    moving = np.abs(qd[:, 0]) > 0.3
    lag = np.mean((q - runs[0])[moving, 0] / qd[moving, 0])
    assert 0.002 < lag < 0.008


def test_a_diverging_arm_gives_nan_instead_of_an_error(make_arm):
    """Gains of a thousand tonnes on a rotor of a feather, without bristles."""
    friction = RigidActuation(np.zeros(1), np.full(1, 0.01), np.zeros(1), np.zeros(1))
    gains = ServoGains.tuned(np.full(1, 1e6), np.full(1, np.inf))
    simulation = ForwardSimulation(Dynamics(make_arm(1)), np.full(1, ROTORS), friction, gains)
    simulation.rest(np.zeros(1))
    with np.errstate(all="ignore"):
        motion = simulation.run(np.full((2000, 1), 0.5), np.zeros((2000, 1)))
    assert not np.all(np.isfinite(motion.position))
