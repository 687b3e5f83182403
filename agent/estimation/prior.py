"""The prior: links are roughly as the URDF says, everything else has a plausible size.

A prior of the standard parameters becomes one of the base parameters, β = P π. Directions that the motion does not
excite stay near the URDF; excited ones hardly depend on it. Many URDFs hold placeholders, so held-out error decides
whether the prior uses the URDF's links or only their possible size (see `selection.choose_links`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.estimation.signals.observation import Observation
from agent.model import FORMS, FrictionTerm, link_scale
from agent.robot import ParameterLayout

_LINK_DOUBT = 0.5  # standard deviation of a link's mass, first moment and inertia, relative
_FREE_DOUBT = 2.5  # the same of a link with unknown inertia, relative to what the torques could hold
_FREE_RADIUS = 0.5  # of the reach: size of such a link
_OFFSET = 0.1  # standard deviation of a torque offset over the largest torque: gravity is more likely


#: Source of the links' prior: the description's inertials, or only what the torques could hold.
DESCRIPTION, SIZE = "description", "size"
#: As SIZE, if neither held-out error nor evidence favours the description, and held-out error does not reject it.
EITHER = "either"


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian: mean (p,) and precision (p, p), the inverse covariance."""

    mean: np.ndarray
    precision: np.ndarray

    def select(self, chosen: np.ndarray) -> Prior:
        """The prior of some parameters, with the others at their mean."""
        return Prior(self.mean[chosen], self.precision[np.ix_(chosen, chosen)])


def physical_prior(observation: Observation, terms: tuple[FrictionTerm, ...], links: str = DESCRIPTION) -> Prior:
    """Prior of the base parameters and friction terms of an observation.

    Args:
        observation: filtered logs.
        terms: friction terms of the model.
        links: which prior of the links: description, none or the better of both.
    """
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

    A link's size is its radius of gyration, at least 10 % of the reach. A massless link has at least 2 % of the robot's
    mass, or of the mass that its torques could hold; all of that with `SIZE`. A rotor may be as large as the measured
    torque and acceleration allow.
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
