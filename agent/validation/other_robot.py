"""Logs of another robot whose joints have the same names.

A fault changes what rubs, pulls or hangs on an arm, not the inertia of its links and rotors. So with a model fitted
to the logs alone, the torque that accelerations need is compared with what the model says, less what any load on the
flange makes of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.core import InputError
from agent.estimation import EstimationSettings, FilterSettings, estimate, motions
from agent.model import IdentifiedModel
from agent.recording import Log
from agent.robot import LINK_PARAMETERS
from agent.validation.torque import PREDICTED

#: Median over the joints of what their torque of acceleration differs by. Of 15 faults on each of three arms, those
#: that a rigid arm explains make 0.28 at most; another arm of a family 0.36 at least.
_ANOTHER = 1 / 3
_EVERY = 20  # samples: enough of a motion for a root mean square


def is_of_another_robot(model: IdentifiedModel, logs: Sequence[Log]) -> bool:
    """Whether a rigid arm explains the torques of logs, and its inertia is not that of the model, whatever it holds."""
    measured = [replace(log, velocity=None, planned_position=None) for log in logs if log.effort is not None]
    settings = FilterSettings(model.cutoff, model.order)
    try:
        again = estimate(model.robot, measured, EstimationSettings(settings, "plain"))
    except InputError:
        return False
    filtered = [motion for log in measured for motion in motions(log, settings)]
    q, qdd = (np.concatenate([getattr(motion, name)[::_EVERY] for motion in filtered]) for name in ("q", "qdd"))
    torque = np.concatenate([motion.torque for motion in filtered if motion.torque is not None])
    moving = np.flatnonzero(np.ptp(q, axis=0) > 0)
    error = again.held_out_rmse if again.group_rmse is None else again.group_rmse[0]
    if np.any(error[moving] > PREDICTED * np.std(torque, axis=0)[moving]):
        return False
    still = np.zeros_like(q)
    columns = (model.rigid.columns(q, still, qdd) - model.rigid.columns(q, still, still))[:, moving]
    own, other = (columns @ fitted.base_values for fitted in (model, again))
    size = np.sqrt(np.minimum(np.mean(own**2, axis=0), np.mean(other**2, axis=0)))
    last = len(LINK_PARAMETERS) * (model.robot.dof - 1)
    load = columns @ model.projection[:, last : last + len(LINK_PARAMETERS)] / size[:, None]
    change = (other - own) / size
    load = load.reshape(-1, len(LINK_PARAMETERS))
    unexplained = change - (load @ np.linalg.lstsq(load, change.ravel(), rcond=1e-8)[0]).reshape(change.shape)
    return bool(np.median(np.sqrt(np.mean(unexplained**2, axis=0))) > _ANOTHER)
