"""Which numbers of a simulator move, and how it is run."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from agent.core import Console
from agent.diagnosis import Search, SelectedCauses, diagnose
from agent.diagnosis.forward.rollout import MujocoEngine
from agent.diagnosis.gap.torque_gap import held_out_gap
from agent.diagnosis.hypotheses.testability import not_testable, smallest_sizes
from agent.diagnosis.rows.dataset import Dataset, assemble
from agent.diagnosis.simulator_file.explanation import Explanation, _possible, replacing_numbers, with_expected_error
from agent.diagnosis.simulator_file.parameter_groups import NumberKind
from agent.diagnosis.simulator_file.released_numbers import ReleasedSimulator, release
from agent.diagnosis.verdict import name_causes
from agent.experiment import open_pairs
from agent.model import CATALOGUE
from agent.pages import headline, verdict_text
from agent.pipeline import GapQuestion, check_plausible
from agent.pipeline.gap.corrected_output import beyond_range
from agent.pipeline.gap.next_steps import after_diagnosis
from agent.recording import read_log
from agent.simulators import load_simulator
from tests.model.bench import CHAIN, URDF, recorded, scene, written
from tests.verdicts import verdict_on


def test_a_dominant_wrist_rotor_is_corrected_fully(tmp_path):
    wrist = URDF.replace('<mass value="3"/>', '<mass value="0.05"/>').replace('xyz="0.2 0 0"', 'xyz="0.01 0 0"')
    wrist = wrist.replace('ixx="0.03" iyy="0.04" izz="0.05"', 'ixx="3e-5" iyy="4e-5" izz="5e-5"')
    model = load_simulator(written(tmp_path, wrist, "arm.urdf"), None, ("pan", "lift")).model
    with_rotor = np.append(model.standard[:20], [0.0, 0.08])  # a thousand times what it turns
    values = np.append(model.projection @ with_rotor, model.values[len(model.independent) :] + [0, 0, 0.2, 0.1])
    robot = replace(model, values=values)
    logs = [read_log(recorded(tmp_path / f"{k}.mcap", robot, k), model.robot) for k in (1, 2)]
    found = release(assemble(model.robot, with_expected_error(model, logs), logs, None))
    assert ("rotor inertia", 1) in found.parts
    assert np.nanstd(found.moved.residual[:, 1]) < 0.01 * np.std(logs[0].effort[:, 1])


def test_a_roll_out_ignores_too_narrow_joint_ranges_of_the_file(tmp_path):
    pytest.importorskip("mujoco")
    narrow = CHAIN.replace('<joint name="lift"', '<joint name="lift" limited="true" range="-5 5"')
    free, held = (
        MujocoEngine(written(tmp_path, scene(bodies), name), ("pan", "lift"))
        for bodies, name in ((CHAIN, "free.xml"), (narrow, "narrow.xml"))
    )
    runs = [each.run(np.zeros(2), np.ones(2), lambda *_: np.zeros(2), np.array([0.3]))[0] for each in (free, held)]
    np.testing.assert_allclose(runs[1], runs[0])
    assert runs[0][0, 1] > 0.2


def test_names_a_joint_that_left_its_range_in_the_file(tmp_path):
    simulator = load_simulator(written(tmp_path, URDF, "arm.urdf"), None, ("pan", "lift"))
    log = SimpleNamespace(position=np.array([[0.0, -1.9], [2.005, 2.4]]))
    found = SimpleNamespace(dataset=SimpleNamespace(logs=[log]))
    (said,) = beyond_range(found, simulator)
    assert "arm.urdf: lift moves from -1.9 to 2.4 rad in the logs, and the file lets it move from -2 to 2" in said


def test_simulator_and_logged_robot_may_have_different_names(tmp_path, robot, capsys, monkeypatch):
    monkeypatch.setattr("agent.pipeline.checked_logs.check_quality", lambda *_: [])
    log = SimpleNamespace(metadata={"robot": "cell 7"}, name="a.mcap")
    check_plausible(robot, [log], False, Console(-1), described=False)
    assert "cell 7" not in capsys.readouterr().err
    check_plausible(robot, [log], False, Console(-1))
    assert "of robot cell 7, not of bench" in capsys.readouterr().err


@pytest.mark.parametrize(("model", "out"), [("arm.xml", "fixed.xml"), ("a/b.urdf", "fixed.urdf"), ("model.json", None)])
def test_the_page_proposes_the_corrected_file_in_the_format_that_was_given(model, out):
    result = {"verdict": "explained", "causes": [{"effect": "stribeck"}], "next_experiment": None}
    (step,) = after_diagnosis(result, None, [Path("a.mcap")], GapQuestion(Path(model)))
    assert step.command == f"agent diagnose --model {model} a.mcap -o {out or 'model_with_effects.json'}"


def sprung_logs(folder: Path, slow: float = 0.0, lighter: float = 0.8, strength: float = 3.0):
    """Model of a file and logs of an arm that weighs otherwise: a spring at its upright axis, friction that rises as
    the other slows down."""
    model = load_simulator(written(folder, URDF, "arm.urdf"), None, ("pan", "lift")).model
    standard = np.append(model.standard[:20] * lighter, [0.5, 0.4])
    friction = model.values[len(model.independent) :] + [1.5, 1.0, 1.5, 2.0]
    robot = replace(model, values=np.append(model.projection @ standard, friction))
    logs = []
    for k in (1, 2):
        log = read_log(recorded(folder / f"{k}.mcap", robot, k), model.robot)
        speed = log.velocity[:, 1]
        rising = slow * np.tanh(speed / 0.01) / (1 + (speed / 0.15) ** 2)
        spring = strength * np.cos(log.position[:, 0] - 0.4)
        logs.append(replace(log, effort=log.effort + np.stack([spring, rising], axis=1)))
    return model, logs


def sprung(folder: Path, slow: float = 0.0) -> Dataset:
    model, logs = sprung_logs(folder, slow)
    return assemble(model.robot, with_expected_error(model, logs, 0.01), logs, None)


def test_a_spring_is_compared_with_a_link_mass_error(tmp_path):
    data = sprung(tmp_path)
    spring = CATALOGUE["gravity_spring"]
    causes = tuple(data.fit.candidates([(spring, (joint,), {"harmonics": 1.0}) for joint in (0, 1)]))
    found = release(data, causes)
    fit = found.moved.fit
    fit = fit.with_chosen(fit.candidates([(spring, cause.joints, cause.settings) for cause in causes]))
    unit = fit.reference.scale
    entry = Explanation(found, SimpleNamespace(), SimpleNamespace(causes=causes), held_out_gap(found.moved, fit, unit))
    assert replacing_numbers(entry, 0, unit) is None, "no link pulls about an upright axis"
    instead = replacing_numbers(entry, 1, unit)
    assert isinstance(instead, ReleasedSimulator)
    assert ("link inertia", 1) in instead.parts
    rubs = data.fit.candidate(CATALOGUE["stribeck"], (1,), {"speed": 0.1, "shape": 1.0})
    friction = replace(entry, selected=SimpleNamespace(causes=(*causes, rubs)))
    assert replacing_numbers(friction, 2, unit) is None, "no link rubs"


@pytest.mark.verify
def test_a_wrong_link_mass_is_not_named_torque_scale_and_spring(tmp_path):
    model, logs = sprung_logs(tmp_path, lighter=0.9, strength=30.0)
    found = diagnose(model.robot, logs, model)
    assert [(cause["effect"], cause["joints"]) for cause in found.result["causes"]] == [("gravity_spring", ["pan"])]
    assert ("link inertia", 1) in found.released.parts


def test_what_moved_numbers_explain_leaves_no_rivals_open(tmp_path):
    """A hundredth of the gap follows no effect: the search names no cause, and the numbers settle the gap."""
    model, logs = sprung_logs(tmp_path, strength=0.0)
    left = [0.8 * np.sin(9 * log.position[:, [1]]) * np.sin(8 * log.velocity[:, [1]]) for log in logs]
    logs = [replace(log, effort=log.effort + more * [0, 1]) for log, more in zip(logs, left, strict=True)]
    others = [name for name in CATALOGUE if name not in ("torque_constant", "encoder_offset", "torque_offset")]
    found = diagnose(model.robot, logs, model, without=others)
    assert (found.result["verdict"], found.selected.causes) == ("explained", ())
    assert any("no known effect explains it" in warning for warning in found.warnings)
    assert {pair.second.effect for pair in open_pairs(found)} <= {"none"}


def test_an_equivalent_cause_makes_the_verdict_ambiguous():
    selected = SelectedCauses(None, None, (), ((), (("dress_pack", (1,)),)), (), 1.0, (), None)  # type: ignore[arg-type]
    links = ("inertial_mismatch", ())
    second = selected.with_rival(1, links)
    assert (verdict_on(second), second.rivals) == ("explained", ((), (links, ("dress_pack", (1,)))))
    assert second.with_rival(1, links).rivals == second.rivals
    assert verdict_on(selected.with_rival(0, links)) == "ambiguous"


def test_finds_a_testable_effect_next_to_a_much_larger_one(tmp_path):
    moved = release(sprung(tmp_path, 0.16)).moved
    places = {("gravity_spring", (0,)), ("stribeck", (1,)), ("torque_constant", (0,)), ("asymmetric_friction", (0,))}
    search = Search(moved.fit, only=places)
    found = name_causes(search.run())
    assert smallest_sizes(moved, search.evidence)["stribeck", (1,)] * 0.01 < 0.016, "of nominal torque, as it has"
    assert {cause.key for cause in found.causes} == {("gravity_spring", (0,)), ("stribeck", (1,))}


def test_a_shoulder_spring_is_not_testable_if_its_link_was_corrected(tmp_path):
    found = release(sprung(tmp_path))
    assert ("link inertia", 1) in found.parts
    places = {("gravity_spring", (0,)), ("gravity_spring", (1,))}
    search = Search(found.moved.fit, only=places)
    search.run()
    untested = not_testable(found.moved, search, smallest_sizes(found.moved, search.evidence))
    said = {entry.joint: entry.why for entry in untested if entry.effect == "gravity_spring"}
    assert set(said) == {"lift"}
    assert "and it matters from 1.0 times on" in said["lift"], "of the model's error: this file has no nominal torque"


def explaining(left: float, *effects: str, servos: object = None) -> Explanation:
    causes = [SimpleNamespace(effect=CATALOGUE[name]) for name in effects]
    gap = SimpleNamespace(after=np.sqrt([left]))
    released = SimpleNamespace(moved=SimpleNamespace(servos=servos))
    return Explanation(released, SimpleNamespace(), SimpleNamespace(causes=causes), gap)


@pytest.mark.parametrize(
    ("effect", "left", "stands"),
    [
        ("stribeck", 0.12, True),
        ("stribeck", 0.16, False),
        ("payload", 0.105, True),
        ("payload", 0.12, False),  # links that all weigh otherwise leave less
        ("gravity_spring", 0.1, True),
        ("gravity_spring", 0.105, False),
    ],
)
def test_a_link_mass_alternative_is_listed_only_if_it_fits_as_well(effect, left, stands):
    assert explaining(left, effect).holds_against(best=0.1, enough=0.05) == stands
    assert explaining(left, "stribeck", effect).holds_against(best=0.1, enough=0.05) == stands


@pytest.mark.parametrize(("left", "stands"), [(0.105, True), (0.12, False)])
def test_an_effect_where_gains_may_be_wrong_leaves_no_more_than_moved_numbers(left, stands):
    assert explaining(left, "stribeck", servos=object()).holds_against(best=0.1, enough=0.05) == stands


def test_of_explanations_that_leave_as_much_the_delay_costs_nothing_and_an_effect_its_settings():
    groups = [
        SimpleNamespace(kind=kind, directions=np.zeros((9, width)))
        for kind, width in ((NumberKind.DELAY, 1), (NumberKind.GAIN, 1))
    ]
    cause = SimpleNamespace(effect=CATALOGUE["stribeck"], names=("rise",), settings={"speed": 0.1, "shape": 1.0})
    released, selected = SimpleNamespace(groups=groups), SimpleNamespace(causes=[cause])
    assert Explanation(released, SimpleNamespace(), selected, SimpleNamespace()).parameters == 4


@pytest.mark.parametrize(("rise", "possible"), [(0.2, True), (-0.2, False)])
def test_regularised_simulator_friction_at_low_speed_is_not_a_cause(tmp_path, rise, possible):
    model = load_simulator(written(tmp_path, URDF, "arm.urdf"), None, ("pan", "lift")).model
    stribeck = SimpleNamespace(effect=CATALOGUE["stribeck"], joints=(0,), names=("rise",), settings={"speed": 0.05})
    fitted = (np.zeros(len(model.values)), [[rise]])
    fit = SimpleNamespace(chosen=[stribeck], fitted=lambda: fitted, reference=SimpleNamespace(model=model))
    assert _possible(model, fit, 0) == possible


def test_reports_file_values_that_close_the_gap_without_an_effect():
    steps = [{"step": "friction of lift", "closes": 0.98}, {"step": "remainder", "closes": 0.02}]
    result = {"verdict": "unknown", "causes": [], "closure": 0.98, "where": [], "waterfall": steps}
    assert "close 98.0 % of the gap; no known effect explains the rest" in verdict_text(result)
    assert headline(result).startswith("Corrected simulator parameters close 98.0 %")
    assert verdict_text({**result, "waterfall": []}) == "there is a gap that no known effect explains"
