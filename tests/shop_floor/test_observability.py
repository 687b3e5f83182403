"""What a motion shows: singular values that are those of the matrix, and directions it is blind to."""

from pathlib import Path

import numpy as np
import pytest

from agent.estimation.signals.filtering import FilterSettings, motions
from agent.model import IdentifiedModel
from agent.recording import read_log
from agent.validation.singular_values import observability


@pytest.fixture(scope="module")
def run(calibrated: Path) -> tuple[IdentifiedModel, object]:
    (folder,) = [path for path in (calibrated / "logs").iterdir() if (path / "state.json").exists()]
    model = IdentifiedModel.load(folder / "model.json")
    return model, read_log(folder / "excitation.mcap", model.robot)


def test_singular_values_match_the_matrix(run):
    model, log = run
    found = observability(model, log)
    start, stop = log.middle_cycle()
    (motion,) = motions(log.between(start - 1, stop + 1), FilterSettings(model.cutoff, model.order))
    columns = model.columns(motion.q, motion.qd, motion.qdd) / model.residual_rmse[:, None]
    matrix = motion.low_pass(columns.reshape(len(columns), -1)).reshape(-1, len(model.values))
    expected = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
    np.testing.assert_allclose(found.singular_values, expected, rtol=1e-6)


def test_names_unobservable_parameters(run):
    model, log = run
    found = observability(model, log)
    assert {"m1", "mz1", "Ixx1", "Iyy1"} <= set(found.never_acting), "the first link turns about the vertical alone"
    assert not set(found.never_acting) & set(model.names)
    assert found.weakest[0][0] == pytest.approx(found.singular_values[-1] / found.singular_values[0])
    assert set(found.weakest[0][1]) <= set(model.names)


def test_parameters_of_a_stationary_joint_are_unobservable(run):
    model, log = run
    still = log.position.copy()
    still[:, 5] = still[0, 5]
    found = observability(model, type(log)(**{**log.__dict__, "position": still}))
    assert found.singular_values[-1] < 1e-6 * found.singular_values[0]
