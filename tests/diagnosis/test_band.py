"""What takes the noise of rounded positions out of the prediction is no elasticity; a gear that gives way is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis.band import gain_in_band
from agent.diagnosis.dataset import assemble
from agent.diagnosis.limits import LIMITS
from agent.model.effects import CATALOGUE

STIFFNESS = 133e3  # N·m/rad, of case 3


@pytest.mark.parametrize(("case", "rounded", "real"), [(0, 1e-4, False), (3, None, True)])
def test_a_gain_counts_where_the_torque_is_predicted(arm, baseline, runs, case, rounded, real):
    logs = runs(case)
    if rounded:
        rough = [np.round(log.position / rounded) * rounded for log in logs]
        logs = [
            replace(log, position=q, velocity=np.gradient(q, log.t, axis=0)) for log, q in zip(logs, rough, strict=True)
        ]
    fit = assemble(arm, baseline, logs, 40.0 if rounded else None).fit
    tried = [{"stiffness": STIFFNESS * f, "damping": d} for f in (0.1, 0.3, 1.0, 3.0) for d in (0.03, 0.12)]
    gear = CATALOGUE["joint_elasticity"]
    score = max(fit.score([fit.candidate(gear, (1,), settings) for settings in tried]), key=lambda score: score.gain)
    assert score.gain > LIMITS.least_gain * fit.count.sum()
    assert (gain_in_band(fit, score) > LIMITS.in_band_gain) == real
    assert gain_in_band(fit, score) > 0.9 or not real
