"""Arms of one to seven joints, slides among them: diagnosed, simulated, extended by every effect, and run again."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis import Diagnosis, diagnose, extended_model, simulate, simulation_part
from agent.diagnosis.rows.dataset import Dataset, assemble
from agent.model import CATALOGUE, IdentifiedModel
from agent.model.identified_model import ModelEffect
from agent.pages import diagnosis_report, diagnosis_summary, headline
from agent.pages.diagnosis.summary import diagnosis_section
from agent.pipeline.gap.printed_diagnosis import diagnosis_text
from agent.recording.log import Log
from agent.validation import predict_log
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

#: Figures for the size of a torque gap and its explained part.
SIZED_GAP = re.compile(r"has [0-9]+ %.{0,20} of the gap|[0-9] % of the (torque )?gap(?! between)|closed:")
#: One of each kind runs with every change: friction, body, position, channel.
QUICK = ("stribeck", "payload", "gravity_spring", "time_delay")
MODELLED = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.verify)
    for name, effect in CATALOGUE.items()
    if not effect.transient and name != "interpolator_mismatch"
]

SWINGING = ("joint_elasticity", "backlash", "torque_ripple")
#: Effects that are not tried on a motion without a trace of them.
LAST_RESORT = {
    "torque_ripple": {"order": 20.0, "harmonics": 1.0},
    "backlash": {"gap": 0.01, "stiffness": 1e5, "damping": 0.1},
    "time_delay": {"delay": 0.006},
    "payload": {"m0": 1.0, "hx0": 0.1, "hy0": 0.0, "hz0": 0.0},
}


@pytest.fixture(scope="module")
def diagnosed(arm, model) -> Diagnosis:
    """A load at the flange that the model does not have."""
    plant = Plant(arm, seed=3, effects=[{"effect": "payload", "parameters": {"mass": 3.0}}])
    return diagnose(arm, [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))], model)


@pytest.fixture(scope="module")
def healthy(arm) -> list[Log]:
    """Logs of the arm as the model has it, with set-points."""
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]


@pytest.fixture(scope="module")
def dataset(arm, model) -> Dataset:
    return assemble(arm, model, [record(Plant(arm, seed=3), "free", 31)], None)


@pytest.fixture(scope="module")
def with_effect(arm, model, dataset) -> Callable[[str], IdentifiedModel]:
    """The model with one effect of a few percent of the arm's largest torque: gears on the first joint, others last."""

    def extend(name: str) -> IdentifiedModel:
        effect = CATALOGUE[name]
        # the first axis is vertical: its load changes sign
        joints = effect.possible_joints(arm)[0 if name in SWINGING else -1]
        forms = [] if name == "time_delay" else effect.settings(dataset.fit, joints)
        forms = forms or [LAST_RESORT[name]]
        settings = forms[len(forms) // 2]
        candidate = dataset.fit.candidate(effect, joints, settings)
        values = np.ones(len(candidate.names))
        torque = max(
            (np.abs(block @ values) * dataset.fit.sigma[:, joint]).max() for joint, block in candidate.blocks.items()
        )
        if candidate.names != ("share",):
            values *= 0.1 * np.abs(dataset.logs[0].effort).max() / torque
        parameters = {**settings, **dict(zip(candidate.names, map(float, values), strict=True))}
        entry = ModelEffect(name, tuple(arm.joint_names[j] for j in joints), parameters)
        return replace(model, effects=(entry,))

    return extend


@pytest.mark.parametrize("name", MODELLED)
def test_a_model_with_an_effect_predicts_it_and_runs_in_the_fake_controller(name, with_effect, model, arm, tmp_path):
    with_effect(name).save(tmp_path / "model.json")
    extended = IdentifiedModel.load(tmp_path / "model.json")
    assert [entry.effect for entry in extended.effects] == [name]
    plain, changed = (record(Plant(arm, model=m), "run", 41) for m in (model, extended))
    predicted = predict_log(extended, changed).predicted - predict_log(model, changed).predicted
    happened = predict_log(model, changed).measured - predict_log(model, plain).measured
    size = np.sqrt(np.mean(predicted**2, axis=0))
    joint = int(np.argmax(size))
    if name in SWINGING:  # a ringing with a slightly different start continues differently
        assert 0.2 < np.sqrt(np.mean(happened[:, joint] ** 2)) / size[joint] < 5
        return
    noise = np.sqrt(np.mean(predict_log(model, plain).error[:, joint] ** 2))
    assert size[joint] > 3 * noise
    assert np.sqrt(np.mean((happened - predicted)[:, joint] ** 2)) < 0.4 * size[joint] + noise


@pytest.mark.verify
def test_named_causes_close_the_gap_in_simulation(diagnosed):
    assert [cause["effect"] for cause in diagnosed.result["causes"]] == ["payload"]
    simulated = simulate(diagnosed)
    assert [(one.log, one.held_out) for one in simulated] == [("one.mcap", True), ("two.mcap", True)]
    part = simulation_part(diagnosed, simulated)
    before, after = (np.array(part["torque"][side]) for side in ("before", "after"))
    assert after.max() < 0.3 * before.max()
    assert max(part["position"]["before"]) < 0.02
    for regime in (regime for entry in diagnosed.result["where"] for regime in entry["regimes"]):
        assert 0 < regime["share"] <= 1
        low, high = regime["interval"] or (0, 1)
        assert 0 <= low <= high <= 1


def test_a_log_without_set_points_is_not_simulated(diagnosed):
    logs = tuple(replace(log, reference_position=None) for log in diagnosed.dataset.logs)
    bare = replace(diagnosed, dataset=replace(diagnosed.dataset, logs=logs))
    assert simulate(bare) == []
    assert simulation_part(bare, []) is None
    assert "nothing was simulated" in diagnosis_report(bare, [])


@pytest.mark.verify
def test_the_extended_model_runs_like_the_machine(diagnosed, arm):
    log = diagnosed.dataset.logs[0]
    again = record(Plant(arm, model=extended_model(diagnosed)), "again", 21)
    before = record(Plant(arm, model=diagnosed.dataset.model), "before", 21)
    measured = predict_log(diagnosed.dataset.model, log).measured
    off = [
        np.sqrt(np.mean((predict_log(diagnosed.dataset.model, other).measured - measured) ** 2, axis=0))
        for other in (again, before)
    ]
    assert off[0].max() < 0.25 * off[1].max()


def test_a_healthy_arm_on_another_path_has_no_gap(healthy, model, arm):
    logs = []
    for number, log in enumerate(healthy):  # corners rounded otherwise on every motion: no law that all share
        planned = np.array(log.reference_position)
        wave = np.sin(2 * np.pi * (3 + 2 * number) * log.t[:, None] / log.t[-1] + np.arange(planned.shape[1]))
        logs.append(replace(log, planned_position=planned, reference_position=planned + 5e-3 * wave))
    found = diagnose(arm, logs, model)
    result = found.result
    assert (result["verdict"], result["causes"]) == ("no_gap", [])
    assert max(result["motion_gap"]["before"]) > 1e-3
    assert any("executed path is not the planned one" in warning for warning in result["warnings"])
    text, page = diagnosis_text(result), diagnosis_report(found)
    assert "interpolator" not in text
    assert "No change found that these logs could show" in page, "of effects as large as the model's error, few show"
    for said in (text, page, "\n".join(diagnosis_section(result).text)):
        assert not SIZED_GAP.search(said), said


@pytest.mark.verify
def test_an_error_that_only_a_usual_change_explains_is_said_although_nothing_is_named(healthy, model, arm):
    """Friction that is 5 % higher differs no more than from day to day, by several times the model's own error."""
    warmer = [
        replace(log, effort=log.effort + 0.05 * model.predict_parts(log.position, log.velocity, 0 * log.position)[1])
        for log in healthy
    ]
    both = [diagnose(arm, logs, model) for logs in (healthy, warmer)]
    assert ["times the model's own" in "; ".join(each.warnings) for each in both] == [False, True]
    assert [each.document.large_error for each in both] == [False, True]


def test_an_explained_path_gap_is_not_a_torque_gap(healthy, model, arm):
    logs = []
    for log in healthy:
        planned = np.array(log.reference_position)
        late = np.concatenate([np.tile(planned[:1], (10, 1)), planned[:-10]])
        logs.append(replace(log, planned_position=planned, reference_position=late))
    result = diagnose(arm, logs, model).result
    assert [cause["effect"] for cause in result["causes"]] == ["interpolator_mismatch"]
    assert result["verdict"] == "explained"
    assert result["closure"] == result["causes"][0]["closure"] >= 0.75
    assert "In torque, these logs show no change" in headline(result)
    assert not SIZED_GAP.search(diagnosis_text(result))
    assert "of the gap between planned and executed path" in diagnosis_summary(result)


COUPLED = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -0.5, 1.0))


@pytest.mark.parametrize("described", [None, pytest.param(COUPLED, marks=pytest.mark.verify)])
def test_recovers_the_built_in_wrist_coupling(arm, model, described):
    """The simulated motor has its own rotor and friction; another coupling in the description changes nothing."""
    if described is not None:
        arm = replace(arm, motor_coupling=described)
        model = learn(arm)
    coupling = {"effect": "wrist_coupling", "joints": ["joint_1", "joint_3"], "parameters": {"factor": -0.28}}
    plant = Plant(arm, seed=3, effects=[coupling])
    found = diagnose(arm, [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))], model)
    (cause,) = found.result["causes"]
    assert (found.result["verdict"], cause["effect"]) == ("explained", "wrist_coupling")
    assert cause["joints"] == coupling["joints"]
    assert cause["closure"] > 0.99
    assert cause["parameters"]["ratio"] == pytest.approx(-0.28, rel=0.03)
    assert cause["parameters"]["share"] == pytest.approx(1, abs=0.05)  # of the model's friction, and of the load


def test_the_page_names_cause_joint_and_next_step(diagnosed):
    page = diagnosis_report(diagnosed, simulate(diagnosed))
    for words in (
        "the flange carries another mass than in the model",
        "Look at: what hangs on the flange",
        "On held-out motion it closes ",
        "Forward simulation",
        "Hypotheses compared",
        "Not testable here",
    ):
        assert words in page
    assert 'src="http' not in page


def test_an_unknown_gap_is_located_on_the_page(arm, model, diagnosed):
    found = diagnose(
        arm, list(diagnosed.dataset.logs), model, without=[name for name in CATALOGUE if name != "backlash"]
    )
    assert found.result["verdict"] == "unknown"
    page = diagnosis_report(found)
    head = page.split("</header>")[0]
    assert "no known effect explains" in head
    assert re.search(r"joint_\d has \d+ %", head)
    assert "Record next" in page


def test_a_gap_around_reversals_is_not_dismissed_as_stiction(arm):
    """All of it lies around reversals, where a stationary joint may have any torque below the Coulomb level."""
    rated = replace(arm, joints=tuple(replace(joint, nominal_motor_torque=1.0) for joint in arm.joints))
    late = {"effect": "presliding", "joints": ["joint_2"], "parameters": {"share": 0.8, "travel": 0.001}}
    plant = Plant(rated, seed=3, effects=[late])
    logs = [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]
    found = diagnose(rated, logs, learn(rated), without=[name for name in CATALOGUE if name != "torque_constant"])
    assert found.result["verdict"] == "unknown"
    assert found.result["where"][0]["joint"] == "joint_2"


@pytest.mark.parametrize(
    "kinds", ["P", "PR", *(pytest.param(kinds, marks=pytest.mark.verify) for kinds in ("PRRR", "RRRRRRR"))]
)
def test_diagnoses_arms_of_any_structure(kinds):
    robot = make_arm(kinds)
    known = learn(robot)
    levels = np.abs(record(Plant(robot, seed=3), "free", 21).effort).max(axis=0)
    # without nominal torques shares are of N·m, so a heavy joint would hide a light one
    joint, level = robot.joint_names[int(np.argmax(levels))], float(levels.max())
    effects = [{"effect": "dress_pack", "joints": [joint], "parameters": {"stiffness": 0.3 * level}}]
    plants = Plant(robot, seed=3), Plant(robot, seed=3, effects=effects)
    free, pulled = (
        diagnose(robot, [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))], known).result
        for plant in plants
    )
    assert free["verdict"] == "no_gap"
    assert pulled["verdict"] in ("explained", "ambiguous")
    assert pulled["where"][0]["joint"] == joint
    first = pulled["causes"][0]
    assert first["joints"] == [joint]
    assert "dress_pack" in {first["effect"], *(other["effect"] for other in first["equivalent_to"])}
