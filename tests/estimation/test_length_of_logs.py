"""Logs with too little motion for a model."""

import numpy as np
import pytest

from agent.core import Console, RejectedError
from agent.model import IdentifiedModel
from agent.pipeline import FitQuestion, fit_logs
from agent.robot import Dynamics


@pytest.mark.parametrize(
    ("motion", "still", "size", "enough", "few"),
    [
        (0.55, 0, 1, False, True),
        (0.1, 4, 1, False, True),
        (1.6, 0, 1, True, True),
        (2.5, 0, 1, True, False),
        (2.5, 4, 1, True, True),
        (20, 0, 0.01, True, True),
        (20, 0, 1, True, False),
    ],
)
def test_too_little_motion_is_said_first_and_needs_force(
    arm, multisine, make_log, tmp_path, capsys, motion, still, size, enough, few
):
    robot, t = arm(2), np.arange(round(500 * (motion + still))) / 500
    since = t - still / 2
    q, *moving = (size * values for values in multisine(2, np.clip(since, 0.0, motion)))
    qd, qdd = (np.where((since >= 0) & (since <= motion), values.T, 0.0).T for values in moving)
    noise = 0.01 * np.random.default_rng(0).normal(size=q.shape)
    torque = Dynamics(robot).inverse_dynamics(q, qd, qdd) + 3 * np.sign(qd) + qd + noise
    logs, out = [make_log(robot, t, q, torque)], tmp_path / "model.json"
    if not enough:
        with pytest.raises(RejectedError, match=r"a\.mcap: too little motion: .* postures .* parameters need"):
            fit_logs(robot, logs, FitQuestion(method="weighted"), Console(-1))
    fit_logs(robot, logs, FitQuestion(method="weighted", force=not enough), Console(-1))[0].save(out)
    assert ("warning: Too little motion: these logs leave" in capsys.readouterr().err) is few
    model = IdentifiedModel.load(out)
    for first, usual in (
        (model.text().splitlines()[0], "parameter "),
        (model.summary("Next: drive").splitlines()[0], "Next: drive"),
    ):
        assert first.startswith("Too little motion: these logs leave" if few else usual)
