"""`estimate --structure auto`: what an arm has beyond bodies and friction becomes part of its model."""

from dataclasses import replace

import numpy as np
from typer.testing import CliRunner

from agent.cli.app import app
from agent.diagnosis.structure import with_structure
from agent.estimation import EstimationSettings, estimate
from agent.model.identified_model import IdentifiedModel
from agent.validation import validate
from tests.estimation.conftest import _arm, _links, _log, _multisine

ROBOT = _arm(2)


def _recorded(seed: int, spring: float):
    """Ten seconds of two joints, the second with a torsion spring."""
    t = np.arange(1000) / 100
    q, qd, qdd = _multisine(2, t, seed=seed)
    torque = _links(ROBOT, q, qd, qdd) + 5 * np.tanh(qd / 0.01) + 2 * qd + spring * (q - 0.2) * [0, 1]
    return _log(ROBOT, t, q, torque + 0.3 * np.random.default_rng(seed).normal(size=q.shape), name=f"{seed}.mcap")


def _both(spring: float) -> tuple[IdentifiedModel, IdentifiedModel]:
    logs = [_recorded(seed, spring) for seed in (1, 2)]
    rigid = estimate(ROBOT, logs, EstimationSettings.create(cutoff=10, method="weighted"))
    return rigid, with_structure(ROBOT, logs, rigid, lambda text: None)


def test_a_spring_becomes_part_of_the_model(tmp_path):
    rigid, model = _both(60.0)
    assert [(effect.effect, effect.joints) for effect in model.effects] == [("gravity_spring", ("joint_2",))]
    assert any(note.startswith("Structure: gravity_spring on joint_2 is part") for note in model.notes)
    model.save(tmp_path / "model.json")
    errors = [
        validate(m, [_recorded(3, 60.0)], 10).overall.relative_error_all_joints
        for m in (rigid, IdentifiedModel.load(tmp_path / "model.json"))
    ]
    assert errors[1] < 0.5 * errors[0]
    assert model.held_out_rmse[1] < 0.5 * rigid.held_out_rmse[1]


def test_an_effect_that_the_model_has_already_is_not_added_again():
    """The diagnosis fits no offset of its own, so that it can name one; the model has it."""
    logs = [replace(log, effort=log.effort + [0.0, 8.0]) for log in (_recorded(seed, 0.0) for seed in (1, 2))]
    rigid = estimate(ROBOT, logs, EstimationSettings.create(cutoff=10, method="weighted"))
    assert "offset" in {term.form for term in rigid.terms}
    model = with_structure(ROBOT, logs, rigid, lambda text: None)
    assert (model.effects, model.values.tolist()) == ((), rigid.values.tolist())


def test_an_arm_without_structure_keeps_its_model():
    rigid, model = _both(0.0)
    assert model.effects == ()
    assert np.array_equal(model.values, rigid.values)
    assert model.notes[-1].startswith("Structure: no effect of the catalogue is added")


def test_an_unknown_structure_is_refused_before_the_work(tmp_path):
    out = tmp_path / "model.json"
    arguments = ["estimate", "--robot", "ns16", "--structure", "soft", "-o", str(out), str(tmp_path / "a.mcap")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code != 0
    assert "choose rigid or auto" in str(result.exception)
    assert not out.exists()
