"""Position-controlled servos without torque: what their file says of them stands in, and is judged."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core import InputError
from agent.core.console import Console
from agent.diagnosis import with_servo_torque
from agent.diagnosis.forward import windows as forward_windows
from agent.model import ModelEffect
from agent.pipeline.gap.diagnose import GapQuestion, diagnose_files
from agent.pipeline.gap.printed_diagnosis import diagnosis_text
from agent.recording import Log, read_log
from agent.recording.mcap.log_file import write_log
from agent.simulators import load_simulator, write_corrected
from tests.model.correcting import corrected

mujoco = pytest.importorskip("mujoco")
RATE, SECONDS, STEP = 50.0, 14.0, 0.001
ARM = """<mujoco model="hobby">
  <default><joint armature="0.03" damping="0.3" frictionloss="0.05"/>SERVO</default>
  <worldbody><body name="upper"><joint name="lift" axis="0 1 0"/>
    <inertial pos="0.12 0 0" mass="0.25" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="fore" pos="0.2 0 0"><joint name="elbow" axis="0 1 0"/>
      <inertial pos="0.1 0 0" mass="0.15" diaginertia="5e-4 5e-4 5e-4"/></body></body></worldbody>
  <actuator>ELBOW<position joint="lift"/></actuator>
</mujoco>
"""
PLAIN, RANGE = '<position kp="20" kv="0.5"/>', ' forcerange="-3 3"'
ELBOW = '<position joint="elbow"/>'


def arm(path: Path, servo: str = PLAIN, elbow: str = ELBOW) -> Path:
    path.write_text(ARM.replace("SERVO", servo).replace("ELBOW", elbow), encoding="utf-8")
    return path


def recorded(path: Path, source: Path, phase: float, change=lambda model: None, late: float = 0.0) -> Path:
    """A log of positions and set-points of the arm of a file, changed, whose set-points are held."""
    model = mujoco.MjModel.from_xml_path(str(source))
    model.opt.timestep = STEP
    change(model)
    data = mujoco.MjData(model)
    dofs = [model.joint(name).id for name in ("lift", "elbow")]
    inputs = [next(a for a in range(model.nu) if model.actuator_trnid[a, 0] == dof) for dof in dofs]
    t = np.arange(int(SECONDS * RATE)) / RATE
    parts = ((0.5, 1.1), (0.25, 2.7), (0.08, 6.1))
    r = sum(a * np.sin(np.outer(t, w * np.array([1, 1.2])) + phase * w + [0, 1]) for a, w in parts)
    each, q, waiting = round(1 / RATE / STEP), np.empty(r.shape), [r[0]] * round(late / STEP)
    for k in range(-int(RATE), len(t)):
        if k >= 0:
            q[k] = data.qpos[dofs]
        for _ in range(each):
            waiting.append(r[max(k, 0)])
            data.ctrl[inputs] = waiting.pop(0)
            mujoco.mj_step(model, data)
    log = Log(path, ("lift", "elbow"), t, q, None, None, r, None, RATE, 100.0, ((0, len(t)),), metadata={"robot": "x"})
    write_log(path, log)
    return path


def softer_elbow(model) -> None:
    """Its servo has 0.7 of the file's gain, and the joint three times its friction."""
    model.dof_frictionloss[1] *= 3
    elbow = next(a for a in range(model.nu) if model.actuator_trnid[a, 0] == 1)
    model.actuator_gainprm[elbow, 0] *= 0.7
    model.actuator_biasprm[elbow, 1:3] *= 0.7


@pytest.fixture(scope="module")
def softer(tmp_path_factory):
    """A diagnosis of logs of an arm whose elbow's servo is softer than the file's: its folder and result."""
    folder = tmp_path_factory.mktemp("servos")
    source = arm(folder / "arm.xml", PLAIN.replace("/>", RANGE + "/>"))
    logs = [recorded(folder / f"{k}.mcap", source, k, softer_elbow) for k in (1, 2)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(forward_windows, "_WINDOWS", 4)
        question = GapQuestion(source, out=folder / "fixed.xml", report=folder / "page.html")
        return folder, diagnose_files(None, logs, question, Console(-1))


@pytest.mark.xfail(strict=True, reason="released numbers of the file take up a servo's gain, so an offset is named")
def test_names_a_wrong_servo_gain_and_corrects_the_file(softer):
    folder, result = softer
    cause = result["causes"][0]
    assert (cause["effect"], cause["joints"]) == ("torque_constant", ["elbow"])
    assert cause["parameters"]["scale_error"] == pytest.approx(1 / 0.7 - 1, rel=0.05)
    changes = json.loads((folder / "fixed.changes.json").read_text())["changes"]
    gains = {c["attribute"]: (c["old"], c["new"]) for c in changes if c["element"] == "actuator of elbow"}
    assert gains["kp"] == (20, pytest.approx(14, rel=0.05))
    assert gains["kv"] == (0.5, pytest.approx(0.35, rel=0.05))
    assert not [c for c in changes if c["element"] == "actuator of lift"]
    level = next(c for c in changes if (c["element"], c["attribute"]) == ("joint elbow", "frictionloss"))
    assert level["new"] == pytest.approx(0.15, rel=0.05)  # of the gain it has, not of the file's
    fixed = mujoco.MjModel.from_xml_path(str(folder / "fixed.xml"))
    assert sorted(-fixed.actuator_biasprm[:, 1]) == [pytest.approx(14, rel=0.05), 20]


@pytest.mark.xfail(strict=True, reason="released numbers of the file take up a servo's gain, so an offset is named")
def test_reports_the_motion_gap_and_that_torque_comes_from_the_servo_model(softer):
    folder, result = softer
    forward = result["forward"]
    assert forward["driven_by"] == "set_points"
    assert np.all(np.max(forward["after"], axis=1) < 0.2 * np.max(forward["before"], axis=1))
    assert result["torque_of"] == "servos"
    assert "no torque was measured" in result["warnings"][0]
    text, page = diagnosis_text(result), (folder / "page.html").read_text()
    assert (
        text.index("position error of")
        < text.index("that of the simulated servos")
        < text.index("torque error on held-out")
    )
    assert page.index("How far it drifts") < page.index("Where it is")
    assert "its servo has another gain" in page


def test_late_set_points_are_distinguished_from_friction(tmp_path, monkeypatch):
    monkeypatch.setattr(forward_windows, "_WINDOWS", 4)
    source = arm(tmp_path / "arm.xml")
    logs = [recorded(tmp_path / f"{k}.mcap", source, k, late=0.03) for k in (1, 2)]
    result = diagnose_files(None, logs, GapQuestion(source, out=tmp_path / "fixed.xml"), Console(-1))
    assert result["causes"][0]["effect"] == "time_delay"
    assert result["causes"][0]["parameters"]["delay"] == pytest.approx(0.03, abs=0.002)
    assert np.max(result["forward"]["after"]) < 0.2 * np.max(result["forward"]["before"])
    assert "ms after they are recorded" in json.loads((tmp_path / "fixed.changes.json").read_text())["notes"][0]


def test_samples_at_the_servo_limit_are_left_out_and_counted(tmp_path):
    source = arm(tmp_path / "arm.xml", PLAIN.replace("/>", ' forcerange="-1.3 1.3"/>'))
    log = read_log(recorded(tmp_path / "1.mcap", source, 1))
    simulator, (driven,), said = with_servo_torque(load_simulator(source, None, log.joint_names), [log])
    assert simulator.servos is not None
    assert np.abs(driven.effort).max() < 1.3
    assert 0 < len(log.t) - len(driven.t) < len(log.t) / 2
    assert f"{len(log.t) - len(driven.t)} of {len(log.t)} samples are left out" in said[1]
    assert [b - a for a, b in driven.segments] != [len(driven.t)]


@pytest.mark.parametrize(
    ("elbow", "servo"),
    [
        ('<general joint="elbow" gear="2" gainprm="3" biastype="affine" biasprm="0.6 -5 -0.125"/>', PLAIN),
        ('<position joint="elbow" gear="2" kp="5" kv="0.125"/><motor joint="elbow"/>', PLAIN),
    ],
)
def test_servo_torque_does_not_depend_on_gear_and_units(tmp_path, elbow, servo):
    plain, other = arm(tmp_path / "a.xml", servo), arm(tmp_path / "b.xml", servo, elbow)
    log = read_log(recorded(tmp_path / "1.mcap", plain, 1))
    torque = [
        with_servo_torque(load_simulator(path, None, log.joint_names), [log])[1][0].effort for path in (plain, other)
    ]
    np.testing.assert_allclose(torque[0], torque[1], atol=1e-12)


MASS = {"mass": 0.2, "moment_x": 0.02, "moment_y": 0, "moment_z": 0, "inertia": 0.003}
HEAVY = {"m0": 0.2, "hx0": 0.02, "hy0": 0, "hz0": 0, **MASS}


@pytest.mark.parametrize(
    ("servo", "elbow"),
    [
        ('<position kp="20" dampratio="1"/>', '<position joint="elbow" kv="0.4"/>'),
        ('<position kp="20" kv="0.2"/>', '<position joint="elbow" dampratio="0.5"/>'),
        ('<general gainprm="20" biastype="affine" biasprm="0 -20 -0.4"/>', '<general joint="elbow"/>'),
    ],
)
def test_gains_are_written_in_the_files_own_form_and_damping_is_kept(tmp_path, servo, elbow):
    source = tmp_path / "arm.xml"
    arm(source, servo, elbow)
    if "general" in servo:
        source.write_text(source.read_text().replace("position", "general"))
    given = load_simulator(source, None, ("lift", "elbow"))
    given = replace(given, servos=given.arm.servos)
    found = (
        ModelEffect("torque_constant", ("elbow",), {"scale_error": 0.25}),
        ModelEffect("payload", (), HEAVY),
        ModelEffect("torque_offset", ("lift",), {"offset": 0.4}),
    )
    correction = corrected(given, found, links=(1,))
    assert (correction.effects, correction.commands.shift[0]) == ((), pytest.approx(0.02))
    write_corrected(given, correction, tmp_path / "fixed.xml")
    before, after = (mujoco.MjModel.from_xml_path(str(tmp_path / name)) for name in ("arm.xml", "fixed.xml"))
    assert after.body_mass[2] > before.body_mass[2]
    scale = np.where(before.actuator_trnid[:, 0] == 1, 0.8, 1.0)[:, None]
    np.testing.assert_allclose(after.actuator_biasprm[:, :3], scale * before.actuator_biasprm[:, :3], rtol=1e-9)
    np.testing.assert_allclose(after.actuator_gainprm[:, :1], scale * before.actuator_gainprm[:, :1], rtol=1e-9)


def copied(log: Log) -> Log:
    return replace(log, reference_position=log.position)


def in_degrees(log: Log) -> Log:
    return replace(log, reference_position=np.degrees(log.reference_position))


def without(log: Log) -> Log:
    return replace(log, reference_position=None)


def measured(log: Log) -> Log:
    return replace(log, effort=np.sin(log.position))


TENDON = '<position tendon="cable" kp="20"/>'
FLOATING = '</actuator><worldbody><body gravcomp="1"><geom size="0.1"/></body></worldbody><actuator>'
CABLE = '</actuator><tendon><fixed name="cable"><joint joint="elbow" coef="1"/></fixed></tendon><actuator>'


@pytest.mark.parametrize(
    ("elbow", "servo", "change", "message"),
    [
        ("", PLAIN, None, r"1\.mcap: no torque .* arm\.xml has no position servo .* elbow has no position actuator"),
        ("<motor joint='elbow'/>", PLAIN, None, r"elbow has no position actuator \(what drives it holds no position\)"),
        (TENDON + CABLE, PLAIN, None, r"elbow is driven through a tendon"),
        (ELBOW + '<velocity joint="elbow" kv="1"/><position joint="elbow"/>', PLAIN, None, "elbow has several"),
        (ELBOW + FLOATING, PLAIN, None, "it compensates gravity"),
        (ELBOW, '<position kp="20" timeconst="0.1"/>', None, "has a gain, filter or delay of its own"),
        (ELBOW, PLAIN, without, r"2\.mcap: neither torque .* nor set-points"),
        (ELBOW, PLAIN, copied, r"2\.mcap: the set-points of lift, elbow are the measured positions themselves"),
        (ELBOW, PLAIN, in_degrees, r"2\.mcap: \w+ is .* from its set-points in the middle: .* another unit or zero"),
        (ELBOW, PLAIN, measured, r"1\.mcap: no torque .* was recorded, and 2\.mcap has some"),
        (ELBOW, '<position kp="2000" forcerange="-0.01 0.01"/>', None, r"1\.mcap: .* at their largest torque all the"),
    ],
)
def test_an_unusable_servo_gives_one_message(tmp_path, elbow, servo, change, message):
    source = arm(tmp_path / "arm.xml", servo, elbow)
    first = read_log(recorded(tmp_path / "1.mcap", arm(tmp_path / "right.xml"), 1))
    write_log(tmp_path / "2.mcap", first if change is None else change(first))
    with pytest.raises(InputError, match=message):
        diagnose_files(None, [tmp_path / "1.mcap", tmp_path / "2.mcap"], GapQuestion(source), Console(-1))


def test_unsigned_efforts_are_ignored_if_servos_give_torque(tmp_path):
    source = arm(tmp_path / "arm.xml")
    log = read_log(recorded(tmp_path / "1.mcap", source, 1))
    amount = replace(log, effort=np.abs(np.gradient(log.position, axis=0)))
    simulator = load_simulator(source, None, log.joint_names)
    known, (driven,), said = with_servo_torque(simulator, [amount])
    assert known.servos is not None
    assert "no sign" in said[1]
    np.testing.assert_array_equal(driven.effort, with_servo_torque(simulator, [log])[1][0].effort)
    assert with_servo_torque(simulator, [measured(log)])[2] == ()
