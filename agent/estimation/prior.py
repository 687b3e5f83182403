"""What is known before any data: links are roughly what the URDF says, the rest is of a plausible size.

A prior in the standard parameters is carried over to the base parameters, β = P π, so that directions the motion does
not excite stay near the URDF instead of growing without bound, while excited ones hardly feel it. A URDF may hold
placeholders, so the data may overrule it: held-out error decides how far its links are believed, or whether only their
possible size is (see `prior_choice`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.estimation.observation import Observation
from agent.model import FORMS, FrictionTerm, link_scale
from agent.robot import ParameterLayout

_LINK_DOUBT = 0.5  # standard deviation of a link's mass, first moment and inertia, relative
_FREE_DOUBT = (
    2.5  # the same of a link of which only its possible size is known, relative to what the torques could hold
)
_FREE_RADIUS = 0.5  # of the reach: the size of such a link
_OFFSET = 0.1  # standard deviation of a torque offset, of the largest torque: gravity is the likelier constant


#: What a prior of the links may rest on: the description's inertials, or only what the torques could hold.
DESCRIPTION, SIZE = "description", "size"
#: As SIZE, where neither held-out error nor the evidence speaks for the description, and held-out error not against it.
EITHER = "either"


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian: mean (p,) and precision (p, p), the inverse covariance."""

    mean: np.ndarray
    precision: np.ndarray

    def select(self, chosen: np.ndarray) -> Prior:
        """Of some of the parameters, the others being at their mean."""
        return Prior(self.mean[chosen], self.precision[np.ix_(chosen, chosen)])


def physical_prior(observation: Observation, terms: tuple[FrictionTerm, ...], links: str = DESCRIPTION) -> Prior:
    """Prior of the base parameters and friction terms of an observation."""
    robot = observation.robot
    mean, deviation = link_prior(observation, links)
    projection = observation.rigid.projection
    count = observation.rigid.count
    precision = np.zeros((count + len(terms), count + len(terms)))
    precision[:count, :count] = np.linalg.inv((projection * deviation**2) @ projection.T)
    torque = _largest_torque(observation)
    for k, term in enumerate(terms):
        size = 1.0 if term.form == "load" else torque[term.axle] / robot.max_velocity[term.axle] ** FORMS[term.form][1]
        size *= _OFFSET if term.form == "offset" else 1.0
        precision[count + k, count + k] = 1 / max(size, 1e-9) ** 2
    return Prior(np.append(projection @ mean, np.zeros(len(terms))), precision)


def link_prior(observation: Observation, source: str = DESCRIPTION) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (10 n + n,) of the links' standard parameters and the rotor inertias.

    A link's size is its radius of gyration, at least a tenth of the reach; a massless link has at least 2 % of the
    robot's mass, or of what its torques could hold, and all of that where only the size is known (`SIZE`). A rotor may
    be as large as the torque and acceleration seen allow.
    """
    robot, dynamics = observation.robot, observation.rigid.dynamics
    links = ParameterLayout.of(robot).blocks(dynamics.standard_parameters())
    if source != DESCRIPTION:
        links = np.zeros_like(links)
    gravity = max(float(np.linalg.norm(robot.gravity)), 1.0)
    torque = _largest_torque(observation)
    liftable = torque.max() / gravity / dynamics.reach
    if source == DESCRIPTION:
        doubt = _LINK_DOUBT * link_scale(links, 0.02 * max(links[:, 0].sum(), liftable), 0.1 * dynamics.reach)
    else:
        doubt = _FREE_DOUBT * link_scale(links, liftable, _FREE_RADIUS * dynamics.reach)
    rotors = np.array([joint.rotor_inertia or 0.0 for joint in robot.joints])
    acceleration = np.max([np.abs(segment.motion.qdd).max(axis=0) for segment in observation.segments], axis=0)
    largest = torque / np.maximum(acceleration, 0.01 * robot.max_acceleration) / robot.gear_ratios**2
    return np.append(links.ravel(), rotors), np.append(doubt.ravel(), np.maximum(largest, rotors))


def _largest_torque(observation: Observation) -> np.ndarray:
    return np.maximum(np.max([np.abs(segment.torque).max(axis=0) for segment in observation.segments], axis=0), 1e-9)
