"""Every run of the development set next to the checkout, against the model of its baseline.

`make test` diagnoses emulated arms with the same effects (`test_result.py`, `test_healthy.py`, `three_joints`). These
belong to `make verify`.
"""

import json
from functools import cache

import numpy as np
import pytest

from agent.diagnosis import diagnose, extended_model
from agent.estimation import estimate
from agent.model import IdentifiedModel
from agent.recording import read_log
from agent.robot import load_robot
from agent.validation import validate

pytestmark = pytest.mark.verify
MOTIONS = ("excite", "moves", "slow")


@pytest.fixture(scope="module")
def arm(shared_data):
    return load_robot(shared_data / "gap-dev")


@pytest.fixture(scope="module")
def baseline(shared_data, arm):
    return estimate(arm, [read_log(shared_data / f"gap-dev/baseline/{name}.mcap", arm) for name in MOTIONS[:2]])


@pytest.fixture(scope="module")
def runs(shared_data, arm):
    folder = shared_data / "gap-dev"
    return cache(lambda case: [read_log(folder / f"case_{case:02d}/logs/{name}.mcap", arm) for name in MOTIONS])


@pytest.fixture(scope="module")
def diagnosed(arm, baseline, runs):
    return cache(lambda case: diagnose(arm, runs(case), baseline))


@pytest.fixture(scope="module")
def answers(shared_data):
    return json.loads((shared_data / "gap-dev/ANSWERS.json").read_text())


def test_healthy_runs_have_no_causes(diagnosed, measured):
    result = diagnosed(0).result
    measured("gap-dev, run without an effect", result["verdict"], "", "no_gap", result["verdict"] == "no_gap")
    assert result["verdict"] == "no_gap"
    assert result["causes"] == []


@pytest.mark.parametrize("case", [1, 2, 3, 4])
def test_names_the_effect_and_its_joint(diagnosed, answers, case, measured):
    result = diagnosed(case).result
    (truth,) = answers[f"case_{case:02d}"]
    joints = [f"joint_{truth['joint']}"] if "joint" in truth else []
    cause = result["causes"][0]
    right = (cause["effect"], cause["joints"]) == (truth["id"], joints)
    measured(f"gap-dev {case}, {truth['id']}", f"{cause['effect']} {cause['joints']}", "", "named right", right)
    assert result["verdict"] == "explained"
    assert right
    assert len(result["causes"]) == 1
    assert cause["closure"] > 0.85


def test_a_model_with_the_effect_predicts_what_the_model_did_not(diagnosed, baseline, runs, tmp_path):
    path = tmp_path / "extended.json"
    extended_model(diagnosed(2)).save(path)
    before = validate(baseline, runs(2)).overall.normalised_rmse
    after = validate(IdentifiedModel.load(path), runs(2)).overall.normalised_rmse
    assert np.max(after) < 0.01 < np.max(before)


def test_sizes_match_the_key(diagnosed, answers):
    mass = diagnosed(2).result["causes"][0]["parameters"]["mass"]
    assert mass == pytest.approx(answers["case_02"][0]["mass"], rel=0.02)
    stiffness = diagnosed(3).result["causes"][0]["parameters"]["stiffness"]
    assert stiffness == pytest.approx(answers["case_03"][0]["k"], rel=0.15)
    delay = diagnosed(4).result["causes"][0]["parameters"]["delay"]
    assert delay == pytest.approx(answers["case_04"][0]["delay"], abs=4e-4)


@pytest.mark.parametrize("case", [1, 2, 3, 4])
def test_a_withheld_effect_is_not_replaced_by_a_confident_wrong_name(arm, baseline, runs, answers, case):
    (truth,) = answers[f"case_{case:02d}"]
    result = diagnose(arm, runs(case), baseline, without=[truth["id"]]).result
    assert result["verdict"] in ("unknown", "ambiguous")
    assert truth["id"] not in json.dumps(result["causes"])
    assert result["where"][0]["share"] > 0
