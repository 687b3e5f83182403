"""What is known before any data: links are roughly what the URDF says, the rest is of a plausible size.

A prior in the standard parameters is carried over to the base parameters, β = P π, so that directions the motion does
not excite stay near the URDF instead of growing without bound, while excited ones hardly feel it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.estimation.friction_terms import FORMS, FrictionTerm
from agent.estimation.observation import Observation

_LINK_DOUBT = 0.5  # standard deviation of a link's mass, first moment and inertia, relative


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian: mean (p,) and precision (p, p), the inverse covariance."""

    mean: np.ndarray
    precision: np.ndarray

    def select(self, chosen: np.ndarray) -> Prior:
        """Of some parameters: all base parameters and any friction terms, which are independent of all else."""
        return Prior(self.mean[chosen], self.precision[np.ix_(chosen, chosen)])


def physical_prior(observation: Observation, terms: tuple[FrictionTerm, ...]) -> Prior:
    """Prior of the base parameters and friction terms of an observation."""
    rigid, robot = observation.rigid, observation.robot
    motion = [stretch.motion for stretch in observation.stretches]
    torque = np.max([np.abs(stretch.torque).max(axis=0) for stretch in observation.stretches], axis=0)
    acceleration = np.max([np.abs(m.qdd).max(axis=0) for m in motion], axis=0)
    mean, deviation = _links(observation)
    rotors = np.array([joint.rotor_inertia or 0.0 for joint in robot.joints])
    largest = torque / np.maximum(acceleration, 0.01 * robot.max_acceleration) / robot.gear_ratios**2
    mean = np.append(mean, rotors)
    deviation = np.append(deviation, np.maximum(largest, rotors))
    projection = rigid.projection
    count = rigid.count
    precision = np.zeros((count + len(terms), count + len(terms)))
    precision[:count, :count] = np.linalg.inv((projection * deviation**2) @ projection.T)
    for k, term in enumerate(terms):
        speed_power = FORMS[term.form][1]
        size = 1.0 if term.form == "load" else torque[term.axle] / robot.max_velocity[term.axle] ** speed_power
        precision[count + k, count + k] = 1 / max(size, 1e-9) ** 2
    return Prior(np.append(projection @ mean, np.zeros(len(terms))), precision)


def _links(observation: Observation) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (10 n,) of the links' standard parameters."""
    dynamics = observation.rigid.dynamics
    mean = dynamics.standard_parameters()
    rng = np.random.default_rng(0)
    reach = np.linalg.norm(dynamics.tip_pose(rng.uniform(-3, 3, (50, dynamics.dof)))[:, :3, 3], axis=1).max()
    links = mean.reshape(-1, 10)
    gravity = max(float(np.linalg.norm(observation.robot.gravity)), 1.0)
    torque = np.max([np.abs(stretch.torque).max() for stretch in observation.stretches])
    least = 0.02 * max(links[:, 0].sum(), torque / gravity / max(reach, 0.1))
    mass = np.maximum(links[:, 0], least)
    gyration = np.sqrt(np.maximum(links[:, [4, 6, 9]].sum(axis=1), 0) / 2 / mass)
    radius = np.maximum(gyration, 0.1 * max(reach, 0.1))
    scale = mass[:, None] * np.stack([np.ones_like(mass), *[radius] * 3, *[radius**2] * 6], axis=1)
    return mean, _LINK_DOUBT * scale.ravel()
