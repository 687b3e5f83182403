"""Instrumental variables: the inverse model with simulated instruments.

Noise in the measured motion is in the regressor too, most of it in the accelerations, and biases least squares.
Instruments W are the regressor of the rigid bodies along a motion that no measurement noise has touched: the same
set-points run through a simulation of the arm with the parameters known so far, in closed loop with a servo of usual
bandwidth. The estimate solves Wᵀ (y - X θ) = 0, weighted and with the prior as in least squares (Janot, Vandanjon and
Gautier, IEEE Trans. Control Systems Technology 22, 2014).

Friction columns are their own instruments: what happens within micrometres of a reversal no simulation repeats.
The simulated motion is shifted by the mean lag of the measured one, so that both reverse together. A log without
set-points is simulated along its own smoothed positions, which only weakens the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.estimation.consistent import consistent
from agent.estimation.filtering import Motion, smooth_and_differentiate
from agent.estimation.moments import collect
from agent.estimation.observation import rigid_columns
from agent.estimation.problem import Estimate, Problem
from agent.robot import ParameterLayout

_LONGEST_LAG = 0.1  # s


def instrumental(problem: Problem) -> Estimate:
    """Weighted instrumental variables."""
    start = consistent(problem)
    observation = problem.observation
    scratch = observation.segments.scratch
    instruments = []
    for segment in observation.segments:
        simulated = _simulate(problem, start, segment.motion)
        instruments.append(replace(segment, rigid=rigid_columns(observation.rigid, simulated, scratch)))
    moments = collect(observation, problem.partition, problem.terms, problem.friction(), instruments=instruments)
    given = all(segment.motion.set_points is not None for segment in observation.segments)
    source = "the controller's set-points" if given else "smoothed measured positions, as set-points are missing"
    return problem.estimate(start.weights, f"Instruments: the motion simulated along {source}.", moments=moments)


def _simulate(problem: Problem, start: Estimate, motion: Motion) -> Motion:
    """The motion that a model of the arm makes of the set-points, filtered and timed like the measured one."""
    from agent.simulators import ForwardSimulation, RigidActuation, ServoGains

    robot = problem.observation.robot
    assert start.standard is not None
    layout = ParameterLayout.of(robot)
    links, rotors = start.standard[layout.links], start.standard[layout.rotors]
    dynamics = problem.observation.rigid.dynamics.with_parameters(links)
    friction = {name: np.zeros(robot.dof) for name in ("coulomb", "viscous", "quadratic")}
    for term, value in zip(problem.terms, start.parameters[problem.observation.rigid.count :], strict=True):
        if term.form in friction:
            friction[term.form][term.axle] = max(value, 0.0)
    fastest = np.abs(motion.qd @ robot.coupling.T).max(axis=0)
    inertia = robot.gear_ratios**2 * rotors + np.mean(
        [np.diag(dynamics.mass_matrix(q)) for q in motion.q[::500]], axis=0
    )
    torque = np.full(robot.dof, np.inf)
    simulation = ForwardSimulation(
        dynamics,
        rotors,
        RigidActuation(**friction, transition=1e-2 * fastest),
        ServoGains.tuned(inertia, torque),
        period=1 / motion.rate,
    )
    set_points = motion.q if motion.set_points is None else motion.set_points
    simulation.rest(set_points[0])
    position = simulation.run(set_points, np.gradient(set_points, 1 / motion.rate, axis=0)).position
    late = _lag(motion.q, position, int(_LONGEST_LAG * motion.rate))
    position = np.roll(position, late, axis=0)
    position[:late] = position[late] if late > 0 else position[:late]
    position[late or len(position) :] = position[late - 1] if late < 0 else position[late or len(position) :]
    stop = min(1.5 * motion.pass_edge, 0.47 * motion.rate)
    q, qd, qdd = smooth_and_differentiate(position, motion.rate, min(motion.pass_edge, 0.8 * stop), stop)
    return replace(motion, q=q, qd=qd, qdd=qdd)


def _lag(measured: np.ndarray, simulated: np.ndarray, longest: int) -> int:
    """By how many samples the simulated motion has to be delayed to lie on the measured one."""
    inner = slice(longest, len(measured) - longest)

    def distance(lag: int) -> float:
        return float(np.sum((measured[inner] - np.roll(simulated, lag, axis=0)[inner]) ** 2))

    return min(range(-longest, longest + 1), key=distance)
