"""A simulator read from a file, ready to be diagnosed: the error it should have and the filter, both from the logs.

Its file stores no held-out error. What a model of such logs usually leaves stands in for it, the same share of torque
as where no model is given (`DecisionLimits.unknown_error`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.limits import LIMITS, DecisionLimits
from agent.estimation.filtering import FilterSettings, resolve_cutoff
from agent.model.identified import IdentifiedModel
from agent.recording.log import Log


def with_expected_error(
    model: IdentifiedModel, logs: Sequence[Log], limits: DecisionLimits = LIMITS
) -> IdentifiedModel:
    """The model with a held-out error (n,) [N·m] and a cut-off that suit the logs."""
    torque = np.concatenate([log.effort for log in logs if log.effort is not None])
    usual = limits.unknown_error * np.std(torque, axis=0)
    nominal = model.robot.nominal_torque
    least = np.where(np.isfinite(nominal), limits.least_background * nominal, 0.0)
    error = np.maximum(np.maximum(usual, least), 1e-9)
    settings = FilterSettings()
    cutoff = min(resolve_cutoff(log, settings) for log in logs)
    return replace(
        model,
        cutoff=cutoff,
        order=settings.order,
        residual_rmse=error,
        held_out_rmse=error,
        weights=1 / np.stack([error**2] * 2),
    )
