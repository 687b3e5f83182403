"""Whether the description's links are believed: held-out error decides.

Public descriptions often hold placeholders, every link of 1 kg or 3 kg, and a prior that is wrong and sure of itself
spoils the estimate in silence. So there are two hypotheses: links near the description's, and links of which nothing is
known but what the torques could hold. The description is believed where segments held out are clearly predicted better
with it, and not where they are clearly predicted worse. Mostly they are predicted alike: what is held out of a motion
asks for nothing that the rest of it leaves open, other motions do. Then the evidence decides (MacKay, Neural
Computation 4, 1992): a description that is right in the directions that the data tell is likely to be right in those
that they leave open, a placeholder is far off in the former. Links that most have the mass of another one are certainly
placeholders.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.estimation.prior import DESCRIPTION, EITHER, SIZE
from agent.estimation.problem import Problem
from agent.estimation.solving import clear_gain
from agent.robot import LINK_PARAMETERS

_LEAST_GAIN = 0.05  # of the squared error held out
_SAME_MASS = 1e-6  # relative difference of masses that are the same


def choose_links(problem: Problem) -> Problem:
    """The same problem with the prior of the links that predicts held-out segments, and the weight it has then.

    Both are compared under the weights of the open hypothesis: residuals of a wrong prior would hide it.
    """
    opened = problem.with_links(SIZE).with_own_prior_weight()
    if placeholders(problem.observation.rigid.dynamics.standard_parameters()):
        return opened
    weights = opened.weights()
    described = opened.with_links(DESCRIPTION)
    error, other = (np.sum(weights * each.held_out(weights), axis=(1, 2)) for each in (opened, described))
    gain = error - other
    if gain.sum() > _LEAST_GAIN * error.sum() and clear_gain(gain):
        return described.with_own_prior_weight()
    if -gain.sum() > _LEAST_GAIN * error.sum() and clear_gain(-gain):
        return opened
    if described.log_evidence(weights) > opened.log_evidence(weights):
        return described.with_own_prior_weight()
    return replace(opened, links=EITHER)


def placeholders(standard: np.ndarray) -> bool:
    """Whether links (10 n,) have no mass, or most of them the mass of another one: nobody measured those."""
    mass = np.sort(standard[:: len(LINK_PARAMETERS)])
    if mass[-1] <= 0:
        return True
    same = np.diff(mass) <= _SAME_MASS * mass[-1]
    shared = np.append(same, False) | np.append(False, same)
    return bool(2 * shared.sum() > len(mass))
