"""The model file and what a model predicts."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.estimation import EstimationSettings, estimate
from agent.model import FrictionTerm, IdentifiedModel, ModelEffect, Reversal
from tests.estimation.conftest import _links


@pytest.fixture(scope="module")
def model(arm, multisine, make_log):
    coupling = np.eye(3)
    coupling[2, 1] = 1.0
    robot = arm(3, prismatic=(0,), coupling=coupling)
    t = np.arange(5000) / 500
    q, qd, qdd = multisine(3, t)
    torque = np.tanh(qd / 0.01) + 2 * qdd + 5 * np.cos(q) + 0.1 * np.random.default_rng(0).normal(size=q.shape)
    return estimate(robot, [make_log(robot, t, q, torque)], EstimationSettings.create(method="consistent"))


@pytest.fixture
def motion(multisine):
    return multisine(3, np.arange(400) / 500, seed=3)


def test_a_saved_model_is_the_same_model(model, motion, tmp_path):
    path = tmp_path / "model.json"
    model.save(path)
    again = IdentifiedModel.load(path)
    assert np.array_equal(again.predict(*motion), model.predict(*motion))
    assert np.allclose(model.columns(*motion) @ model.values, model.predict(*motion), atol=1e-9)
    assert again.to_dict() == model.to_dict()
    assert again.robot == model.robot
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]
    json.loads(path.read_text(encoding="utf-8"), parse_constant=lambda text: pytest.fail(f"{text} is not JSON"))


def test_a_failed_save_leaves_the_old_model(model, tmp_path, monkeypatch):
    path = tmp_path / "model.json"
    model.save(path)
    before = path.read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="JSON compliant"):
        replace(model, residual_rmse=np.array([np.nan])).save(path)
    assert path.read_text(encoding="utf-8") == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        ("{", r"damaged: .*; name a model\.json that `agent estimate`"),
        ("[]", "not a model file of schema 'model/1'"),
        ('{"schema": "validation/1"}', "it says 'validation/1'"),
        ('{"schema": "model/1"}', "incomplete or damaged"),
    ],
)
def test_a_file_that_is_no_model_says_so(tmp_path, content, message):
    path = tmp_path / "model.json"
    if content is not None:
        path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        IdentifiedModel.load(path)


@pytest.mark.parametrize("key", ["robot", "covariance", "friction", "filter", "independent"])
def test_names_the_missing_part_of_a_model_file(model, tmp_path, key):
    path = tmp_path / "model.json"
    data = model.to_dict()
    del data[key]
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(InputError, match=rf"model\.json.*incomplete.*{key}"):
        IdentifiedModel.load(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: data.update(weights=[[1.0, 2.0]]), "weights is an array"),
        (lambda data: data.update(held_out_rmse=[1.0]), "held_out_rmse is an array"),
        (lambda data: data["prior"].update(data_share=[1.0]), r"prior\.data_share is an array"),
        (lambda data: data.update(standard_parameters=[1.0]), "standard_parameters is an array"),
        (lambda data: data["residual_rmse"].__setitem__(0, None), "residual_rmse.0: .*valid number"),
        (lambda data: data["independent"].__setitem__(0, 999), "independent counts standard parameters"),
        (lambda data: data["independent"].__setitem__(0, data["independent"][1]), "independent names .* twice"),
        (lambda data: data["filter"].update(cutoff_hz=-1.0), r"filter\.cutoff_hz: .*greater than 0"),
        (lambda data: data["filter"].update(order=2.5), r"filter\.order: .*integer"),
        (lambda data: data.update(filter=None), "filter: a mapping is expected"),
        (lambda data: data["weights"][1].__setitem__(0, -1.0), r"weights\.1\.0: .*greater than or equal to 0"),
        (lambda data: data["held_out_rmse"].__setitem__(0, -1.0), r"held_out_rmse\.0: .*greater than or equal to 0"),
        (lambda data: data["friction"][0].update(value=1e308), r"friction\.0\.value: .*less than or equal to"),
        (lambda data: data["friction"][0].update(value="12,5"), r"friction\.0\.value: .*valid number \(got '12,5'\)"),
        (lambda data: data["covariance"][0].__setitem__(1, float("nan")), r"covariance\.0\.1: .*finite"),
        (lambda data: data.update(robot="x"), "robot: a mapping is expected"),
        (lambda data: data["robot"]["joints"][0].update(colour=1), "robot: .*colour"),
        (lambda data: data["friction"][0].update(form="magic"), "unknown friction form 'magic'"),
        (lambda data: data["friction"][0].update(reversal=None), "needs a reversal"),
        (lambda data: data["friction"][0].update(joint="elbow"), "'elbow' is no joint"),
        (lambda data: data["robot"].update(name="../../x"), "files are named after the robot"),
        (lambda data: data["robot"].update(gravity=[1.0]), "gravity is three numbers"),
        (lambda data: data["robot"].update(motor_coupling=[[1.0]]), "motor_coupling is"),
        (
            lambda data: data["robot"].update(urdf=re.sub(' ixx="[^"]*"', "", data["robot"]["urdf"], count=1)),
            r"robot\.urdf: link 'link_1': inertia ixx is missing",
        ),
        (lambda data: data["robot"].update(urdf="<robot"), r"robot\.urdf: unclosed token"),
        (lambda data: data.update(provenance=[]), "provenance: .*valid dictionary"),
        (lambda data: data["provenance"].update(logs=["a.mcap"]), r"provenance\.logs is a list of tables"),
        (lambda data: data["provenance"].update(tool="gripper"), r"provenance\.tool is a list"),
        (lambda data: data["provenance"].update(range={"lowest": [0.0]}), r"range\.lowest is \d finite numbers"),
        (lambda data: data["provenance"].update(range={}), "lowest"),
    ],
)
def test_a_model_with_parts_that_do_not_fit_says_which(model, tmp_path, damage, message):
    data = json.loads(json.dumps(model.to_dict()))
    damage(data)
    path = tmp_path / "model.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(InputError, match=rf"model\.json.*{message}"):
        IdentifiedModel.load(path)


def test_effects_add_torque_and_unknown_ones_are_refused(model, motion, tmp_path):
    shifted = replace(model, effects=(ModelEffect("torque_offset", ("joint_2",), {"offset": 3.0}),))
    shifted.save(tmp_path / "model.json")
    time = 0.01 * np.arange(len(motion[0]))
    added = IdentifiedModel.load(tmp_path / "model.json").predict(*motion, time) - model.predict(*motion)
    assert np.allclose(added, [0, 3, 0])
    unknown = replace(model, effects=(ModelEffect("gremlins", (), {}),))
    with pytest.raises(InputError, match="'gremlins'"):
        unknown.predict(*motion)


def test_the_table_names_units_and_meanings(model):
    header, *rows = model.rows()
    assert header[0] == "parameter"
    by_name = {row[0]: row for row in rows}
    assert len(by_name) == len(model.values)
    assert by_name["f1_1"][4] == "N·s/m"
    assert by_name["f1_2"][4] == "N·m·s/rad"
    assert "joint_3" in by_name["f0_3"][5]
    assert "condition number" in model.text()


@pytest.mark.parametrize(("axle", "way"), [(0, "m"), (1, "rad")])
def test_the_table_gives_reversal_distances_in_joint_units(model, axle, way):
    term = FrictionTerm(axle, "stribeck", Reversal("travel", 1.34e-5), 0.003)
    k = next(k for k, other in enumerate(model.terms) if other.axle == axle)
    table = replace(model, terms=(*model.terms[:k], term, *model.terms[k + 1 :])).rows()
    meaning = table[1 + len(model.independent) + k][5]
    assert meaning.endswith(f"(reversal within 1.34e-05 {way}, fading over 0.003 {way}/s)")


def test_the_table_separates_data_from_prior(arm, multisine, make_log):
    robot = arm(2)
    t = np.arange(3000) / 500
    q, qd, qdd = multisine(2, t)
    for values in (q, qd, qdd):
        values[:, 1] = 0.0
    torque = np.tanh(qd / 0.01) + 2 * qdd + 5 * np.cos(q) + 0.1 * np.random.default_rng(0).normal(size=q.shape)
    log = make_log(robot, t, q, torque)
    share = {row[0]: row[8] for row in estimate(robot, [log], EstimationSettings.create(method="weighted")).rows()}
    assert (share["f0_1"], share["f0_2"]) == ("100", "0")
    paper = estimate(robot, [log], EstimationSettings.create(method="paper"))
    assert {row[6:] for row in paper.rows()[1:]} == {("-", "-", "-")}


def test_the_interval_grows_outside_the_data(model, motion):
    q, qd, qdd = motion
    near = model.prediction_interval(model.columns(q, qd, qdd))
    far = model.prediction_interval(model.columns(q, 20 * qd, 20 * qdd))
    assert np.all(near >= 1.9 * model.residual_rmse)
    assert np.all(far.mean(axis=0) > near.mean(axis=0))


def test_prediction_bounds_differ_in_motion_and_at_standstill(model, motion):
    columns = model.columns(*motion)
    cautious = replace(model, group_rmse=np.array([[1.0] * 3, [5.0] * 3]), standstill_speed=np.full(3, 0.1))
    fast, slow = (cautious.prediction_interval(columns, np.full(motion[0].shape, speed)) for speed in (-0.2, 0.05))
    assert np.allclose(slow**2 - fast**2, 1.95996**2 * 24, rtol=1e-4)


def test_reads_an_older_file_without_groups(model, motion, tmp_path):
    data = model.to_dict()
    del data["group_rmse"], data["standstill_speed"]
    (tmp_path / "old.json").write_text(json.dumps(data), encoding="utf-8")
    old = IdentifiedModel.load(tmp_path / "old.json")
    columns = model.columns(*motion)
    assert np.array_equal(old.prediction_interval(columns, motion[1]), old.prediction_interval(columns))


@pytest.mark.parametrize(
    ("wrong", "note"),
    [
        (lambda q, torque: (np.degrees(q), torque), "joint_1 reaches .* times its highest speed"),
        (lambda q, torque: (q, -torque), "are signs and units of torques"),
        (lambda q, torque: (np.column_stack([q[:, 0], np.full(len(q), 0.3)]), torque), "never move: joint_2"),
    ],
    ids=["degrees", "sign", "dead channel"],
)
def test_notes_doubt_about_a_wrongly_recorded_log(arm, multisine, make_log, wrong, note):
    robot = arm(2)
    t = np.arange(5000) / 500
    q, qd, qdd = multisine(2, t)
    torque = _links(robot, q, qd, qdd) + 5 * np.sign(qd) + 2 * qd
    right, doubted = (estimate(robot, [make_log(robot, t, *data)]) for data in ((q, torque), wrong(q, torque)))
    assert re.search(note, "\n".join(doubted.notes))
    assert not re.search(note, "\n".join(right.notes))
