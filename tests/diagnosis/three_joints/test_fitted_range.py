"""Logs that leave the angles and speeds of the model's fit: said, with joint and figures, and only then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis import diagnose
from agent.estimation import beyond_fit
from agent.model import IdentifiedModel
from agent.validation import predict_log
from fake_controller.plant import Plant
from tests.small_arms import record

USUAL, WIDE = (0.5, 0.5, 0.5), (0.5, 0.5, 3.0)


@pytest.fixture(scope="module")
def logs(arm):
    plant = Plant(arm, seed=3)
    return {share: [record(plant, f"{seed}", seed, share) for seed in (21, 22)] for share in (USUAL, WIDE)}


def test_warns_if_logs_leave_the_fitted_range(arm, model, logs):
    assert not [text for text in diagnose(arm, logs[USUAL], model).warnings if "fitted" in text]
    faster, further = (text for text in diagnose(arm, logs[WIDE], model).warnings if "fitted" in text)
    assert "go faster" in faster
    assert "joint_3 at up to" in faster
    assert "where the model was never fitted" in further
    assert "joint_3 between" in further
    assert "joint_1" not in faster + further


def test_the_fitted_range_is_saved_and_never_guessed(model, logs, tmp_path):
    model.save(tmp_path / "model.json")
    loaded = IdentifiedModel.load(tmp_path / "model.json")
    predicted = [predict_log(loaded, log) for log in logs[WIDE]]
    motions = [(each.position, each.velocity) for each in predicted]
    assert len(list(beyond_fit(loaded, motions))) == 2
    del loaded.provenance["range"]
    assert not list(beyond_fit(loaded, motions))


def test_reports_a_large_error_of_the_model_itself(arm, model, logs):
    assert not [text for text in diagnose(arm, logs[USUAL], model).warnings if "the model errs by" in text]
    size = np.sqrt(np.mean(logs[USUAL][0].effort ** 2, axis=0))
    (said,) = (
        text
        for text in diagnose(arm, logs[USUAL], replace(model, held_out_rmse=0.4 * size)).warnings
        if "the model errs by" in text
    )
    assert "smaller gaps do not show" in said
