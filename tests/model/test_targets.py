"""The numbers of an arm in files for simulators: each is compiled, and run or checked where its simulator is."""

import ast
import importlib.util
import json
import runpy
import subprocess
import sys
from dataclasses import replace
from math import pi
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core import InputError
from agent.model import CATALOGUE, ModelEffect, effect_torque
from agent.simulators import load_simulator
from agent.simulators.targets import TARGETS, numbers_of_file, write_target
from tests.estimation.test_export import bodies, described, joint, model_of
from tests.model.bench import written

SERVO = """<mujoco model="two"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody><body name="a">
<joint name="pan" axis="0 1 0" armature="0.05" damping="0.4" frictionloss="0.2" range="-1.5 1.5"/>
<inertial pos="0.1 0 0" mass="0.5" diaginertia="0.002 0.002 0.002"/><body name="b" pos="0.3 0 0">
<joint name="slide" type="slide" axis="1 0 0" armature="0.3" damping="2" frictionloss="1.5" stiffness="30"
springref="0.1" range="-0.5 0.5"/><inertial pos="0.05 0 0" mass="0.3" diaginertia="0.001 0.001 0.001"/></body></body>
</worldbody><actuator><position name="p" joint="pan" kp="20" kv="1" forcerange="-5 5"/>
<position name="s" joint="slide" kp="200" kv="10"/></actuator></mujoco>"""
RANGES = """schema: randomisation/1
interval: 0.9
ranges:
  - {"of": "joint pan", "parameter": "frictionloss", "value": 0.2, "low": 0.15, "high": 0.25, "unit": "N·m"}
  - {"of": "joint slide", "parameter": "armature", "value": 0.3, "low": 0.2, "high": 0.4, "unit": "kg"}
  - {"of": "body b", "parameter": "mass", "value": 0.3, "low": 0.27, "high": 0.33, "unit": "kg"}
"""
CHANGES = {
    "schema": "simulator-changes/1",
    "effects": [
        {
            "effect": "stribeck",
            "joints": ["pan"],
            "parameters": {"speed": 0.1, "shape": 1.0, "rise": 0.4},
            "reason": "stribeck of pan: closes 31.0 % of the held-out gap",
        }
    ],
}
LATE = 0.067
LOOSE = '<body pos="0 0 9"><joint name="door"/><geom size="0.1"/></body></worldbody>'


@pytest.fixture(scope="module")
def fixed(tmp_path_factory) -> Path:
    """A corrected file of an arm with a slide, with what stands next to it."""
    pytest.importorskip("mujoco")
    folder = tmp_path_factory.mktemp("fixed")
    written(folder, RANGES, "fixed.ranges.yaml")
    written(folder, json.dumps(CHANGES), "fixed.changes.json")
    return written(folder, SERVO, "fixed.xml")


@pytest.fixture(scope="module")
def numbers(fixed):
    """Its numbers, commands 67 ms late."""
    found = numbers_of_file(fixed)
    return replace(found, joints=tuple(replace(one, delay=LATE) for one in found.joints))


def exported(numbers, name: str, folder: Path) -> tuple[dict[str, Path], list[str]]:
    said: list[str] = []
    return {path.name: path for path in write_target(numbers, name, folder / name, said.append)}, said


@pytest.mark.parametrize("name", TARGETS)
def test_every_simulator_gets_files_that_parse_and_a_list_of_what_it_cannot_say(numbers, tmp_path, name):
    paths, said = exported(numbers, name, tmp_path)
    for path in paths.values():
        if path.suffix == ".py":
            compile(path.read_text(encoding="utf-8"), path.name, "exec")
            assert max(map(len, path.read_text(encoding="utf-8").splitlines())) < 200
    left = json.loads(paths["left_out.json"].read_text(encoding="utf-8"))
    assert [(one["effect"], one["of"]) for one in left["effects"]] == [("stribeck", " of pan")]
    stays = "% of its torque stays out" if name == "mjcf" else "closes 31.0 % of the held-out gap, which stays"
    assert any("stribeck of pan" in text and stays in text for text in said)


def test_what_simulators_can_say_is_known_for_effects_of_the_catalogue():
    table = json.loads((Path(__file__).parents[2] / "agent/simulators/targets/effects.json").read_text("utf-8"))
    assert set(table) <= set(CATALOGUE)
    assert {name for row in table.values() for name in row} <= set(TARGETS)


def test_the_mjcf_moves_as_the_file_with_commands_that_much_later(numbers, fixed, tmp_path):
    import mujoco

    paths, _ = exported(replace(numbers, left=()), "mjcf", tmp_path)
    late, plain = (mujoco.MjModel.from_xml_path(str(path)) for path in (paths["two.xml"], fixed))
    np.testing.assert_allclose(late.actuator_delay, LATE)
    t = np.arange(1000) * 0.002
    command = 0.4 * np.sin(5.0 * t)[:, None] * [1.0, 0.3]
    ahead = np.stack([np.interp(t - LATE, t, column) for column in command.T], axis=1)  # between two steps
    moved = []
    for model, commands in ((late, command), (plain, ahead)):
        data = mujoco.MjData(model)
        places = []
        for control in commands:
            data.ctrl[:] = control
            mujoco.mj_step(model, data)
            places.append(data.qpos.copy())
        moved.append(np.array(places))
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-6)
    assert np.abs(moved[0]).max(axis=0).min() > 0.05
    again = load_simulator(paths["two.xml"], None, ("pan", "slide"))
    np.testing.assert_allclose(again.arm.frictionloss, [0.2, 1.5])
    np.testing.assert_allclose(again.arm.stiffness, [0.0, 30.0])


def test_the_mjcf_solves_friction_and_limits_as_the_file_does(tmp_path):
    import mujoco

    firm = SERVO.replace(
        'range="-1.5 1.5"',
        'range="-1.5 1.5" solimpfriction="0.9999 0.9999 0.001 0.5 2" solreffriction="0.004 1" solreflimit="0.05 0.8" '
        'solimplimit="0.8 0.9 0.002 0.5 2" margin="0.02"',
    )
    source = written(tmp_path, firm, "firm.xml")
    paths, _ = exported(numbers_of_file(source), "mjcf", tmp_path)
    before, after = (mujoco.MjModel.from_xml_path(str(path)) for path in (source, paths["two.xml"]))
    for way in ("dof_solimp", "dof_solref", "jnt_solimp", "jnt_solref", "jnt_margin"):
        np.testing.assert_allclose(getattr(after, way), getattr(before, way), err_msg=way)


def moves(path: Path, command: np.ndarray) -> np.ndarray:
    """(S, 2) positions under controls (S, 2), at steps of the file."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data, places = mujoco.MjData(model), []
    for control in command:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        places.append(data.qpos.copy())
    return np.array(places)


PLAIN = 'kp="20" kv="1" forcerange="-5 5"'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('timestep="0.002" integrator="implicitfast"', 'timestep="0.004" integrator="Euler"'),
        ('timestep="0.002" integrator="implicitfast"', 'timestep="0.005" integrator="RK4"'),
        ('integrator="implicitfast"/>', 'integrator="implicitfast"><flag gravity="disable"/></option>'),
        (PLAIN, 'kp="20" kv="1" forcerange="-1 5"'),
        (PLAIN, 'kp="20" kv="1" ctrlrange="-0.1 0.3"'),
        (PLAIN, 'kp="20" kv="1" delay="0.02" nsample="11"'),
    ],
)
def test_the_mjcf_moves_as_the_file_of_other_people(tmp_path, old, new):
    pytest.importorskip("mujoco")
    source = written(tmp_path, SERVO.replace(old, new), "arm.xml")
    paths, _ = exported(numbers_of_file(source), "mjcf", tmp_path)
    command = 0.4 * np.sin(0.02 * np.arange(500))[:, None] * [1.0, 0.3]
    np.testing.assert_allclose(moves(paths["two.xml"], command), moves(source, command), atol=1e-9)


def test_what_a_file_does_not_say_is_not_made_up(tmp_path):
    pytest.importorskip("mujoco")
    numbers = numbers_of_file(written(tmp_path, SERVO.replace(PLAIN, f'{PLAIN} timeconst="0.1"'), "arm.xml"))
    paths, said = exported(numbers, "isaaclab", tmp_path)
    assert "no servos are in the files: the actuator of pan has a gain or filter of its own" in said
    assert "VELOCITY = {'pan': None, 'slide': None}" in paths["isaaclab_3_0.py"].read_text("utf-8")
    (pan, slide) = ElementTree.parse(paths["two.urdf"]).findall("joint")[:2]
    for element, kind, most in ((pan, "revolute", 1.5), (slide, "prismatic", 0.5)):
        limit = element.find("limit")
        assert (element.get("type"), float(limit.get("lower")), float(limit.get("upper"))) == (kind, -most, most)


@pytest.mark.parametrize("flag", ["frictionloss", "limit", "actuation"])
def test_numbers_that_a_flag_disables_are_refused(tmp_path, flag):
    pytest.importorskip("mujoco")
    option = f'integrator="implicitfast"><flag {flag}="disable"/></option>'
    source = written(tmp_path, SERVO.replace('integrator="implicitfast"/>', option), "arm.xml")
    with pytest.raises(InputError, match=f"its flag {flag} is disabled"):
        numbers_of_file(source)


def test_a_limit_that_differs_by_direction_is_said(tmp_path):
    pytest.importorskip("mujoco")
    source = written(tmp_path, SERVO.replace("-5 5", "-1 5").replace("</worldbody>", LOOSE), "arm.xml")
    _, said = exported(numbers_of_file(source), "genesis", tmp_path)
    assert "pan: its force goes from -1 to 5; where a file has one limit, it is 1" in said
    assert "door ignored: no part of the arm" in said


_TIME = np.arange(0.0, 6.0, 0.002)
#: Time [s], position [rad] and speed [rad/s] of the first joint.
LED = _TIME, 0.8 * np.sin(1.3 * _TIME), 1.04 * np.cos(1.3 * _TIME)


def led(path: Path) -> np.ndarray:
    """(S,) forces on the first joint of a file that is led along that motion."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    data, force = mujoco.MjData(model), np.empty(len(_TIME))
    for k, (_, q, qd) in enumerate(zip(*LED, strict=True)):
        data.qpos[:], data.qvel[:] = (q, 0.0), (qd, 0.0)
        mujoco.mj_forward(model, data)
        force[k] = data.qfrc_passive[0] + data.qfrc_actuator[0] - model.dof_frictionloss[0] * np.sign(qd)
        mujoco.mj_step(model, data)
    return force


@pytest.fixture(scope="module")
def led_without(fixed) -> np.ndarray:
    """The forces without any effect."""
    return led(fixed)


@pytest.mark.parametrize(
    ("effect", "parameters", "near"),
    [
        (
            "torque_ripple",
            {"order": 11.3, "harmonics": 2.0, "cosine_1": 0.1, "sine_1": -0.2, "cosine_2": 0.05, "sine_2": 0},
            0,
        ),
        ("gravity_spring", {"harmonics": 1.0, "cosine_1": 0.5, "sine_1": -0.3}, 0),
        ("gravity_spring", {"constant": 0.3, "stiffness": -0.5}, 0),
        ("viscous_nonlinearity", {"power": 2.0, "bend": 0.4, "viscous_change": 0.1}, 0),
        ("viscous_nonlinearity", {"speed": 0.3, "bend": 0.4, "viscous_change": 0.1}, 0.05),
        ("presliding", {"travel": 0.02, "level": 0.2}, 0.1),
        ("stribeck", {"speed": 0.3, "shape": 2.0, "rise": 0.4}, 0.1),
        (
            "dress_pack",
            {"constant": 0.3, "stiffness": 0.5, "quadratic": -0.2, "cubic": 0.4, "middle": 0.2, "reach": 1.0},
            0,
        ),
        ("dress_pack", {"constant": 0.3, "stiffness": 0.5, "hysteresis": 0.2, "travel": 0.05}, 0.01),
    ],
)
def test_mujoco_gives_the_torque_of_an_effect_that_passive_forces_say(
    fixed, led_without, tmp_path, effect, parameters, near
):
    """The arm is led along a motion in MuJoCo 4, with and without the effect."""
    written(tmp_path, SERVO, "fixed.xml")
    entry = {"effect": effect, "joints": ["pan"], "parameters": parameters, "reason": ""}
    written(tmp_path, json.dumps({"schema": "simulator-changes/1", "effects": [entry]}), "fixed.changes.json")
    paths, _ = exported(numbers_of_file(tmp_path / "fixed.xml"), "mjcf", tmp_path)
    t, q, qd = LED
    error = led_without - led(paths["two.xml"])
    zero = np.zeros_like(q)
    motion = {"time": t, "q": np.stack([q, zero], 1), "qd": np.stack([qd, zero], 1), "qdd": np.zeros((len(t), 2))}
    arm = load_simulator(fixed, None, ("pan", "slide"))
    torque = effect_torque(arm.model, ModelEffect(effect, ("pan",), parameters), motion)[:, 0]
    moving = np.abs(qd) > 0.05  # bristles of MuJoCo bend a little at reversals
    error, torque = (error - torque)[moving], torque[moving]
    assert np.sqrt(np.mean(error**2)) <= (near or 1e-6) * np.sqrt(np.mean(torque**2))
    if effect in ("presliding", "stribeck", "torque_ripple"):
        with pytest.raises(InputError, match="dcmotor 'pan_"):
            load_simulator(paths["two.xml"], None, ("pan", "slide"))


def calls(path: Path) -> dict[str, set[str]]:
    """Names that are called with keywords in a file, and these keywords; of `func=a.b` with `params`, those of b."""
    found: dict[str, set[str]] = {}
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and node.keywords:
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            found.setdefault(name, set()).update(word.arg for word in node.keywords if word.arg)
            words = {word.arg: word.value for word in node.keywords}
            if isinstance(words.get("func"), ast.Attribute) and isinstance(words.get("params"), ast.Dict):
                keys = {key.value for key in words["params"].keys if isinstance(key, ast.Constant)}
                found.setdefault(words["func"].attr, set()).update(keys)
    return found


@pytest.mark.parametrize("version", ["2.3", "3.0"])
def test_isaac_lab_gets_fields_that_its_version_has_and_the_delay_in_physics_steps(numbers, tmp_path, version):
    known = json.loads((Path(__file__).parents[2] / "agent/simulators/targets/isaaclab_fields.json").read_text("utf-8"))
    paths, said = exported(numbers, "isaaclab", tmp_path)
    path = paths[f"isaaclab_{version.replace('.', '_')}.py"]
    used = calls(path)["DelayedPDActuatorCfg"]
    assert used <= set(known["fields"][version])
    assert {"min_delay", "max_delay", "armature", "viscous_friction"} <= used
    fake = "class DelayedPDActuatorCfg(dict): pass"
    text = path.read_text(encoding="utf-8").replace("from isaaclab.actuators import DelayedPDActuatorCfg", fake)
    made = runpy.run_path(str(written(tmp_path, text, f"run_{version[0]}.py")))
    arm = made["ACTUATORS"]["arm"]
    assert made["PHYSICS_DT"] == 0.002, "that of the file"
    assert arm["min_delay"] == arm["max_delay"] == round(LATE / 0.002)
    assert arm["stiffness"] == {"pan": 20.0, "slide": 200.0}
    assert arm[known["versions"][version]["effort"]] == {"pan": 5.0, "slide": 1e9}, "the slide has no limit"
    assert "MASSES = {'b_2': (0.9, 1.1)}" in paths["isaaclab_events.py"].read_text("utf-8"), "as the URDF calls it"
    assert '<link name="b_2">' in paths["two.urdf"].read_text("utf-8")
    events = calls(paths["isaaclab_events.py"])
    for name in ("randomize_joint_parameters", "randomize_rigid_body_mass"):
        assert events[name] <= set(known["events"][name])
    assert '"operation": "scale"' in paths["isaaclab_events.py"].read_text("utf-8")
    assert not any("explicit servo" in text for text in said)


def test_isaac_lab_gets_a_group_of_actuators_for_each_delay(numbers, tmp_path):
    slow, quick = numbers.joints
    both = replace(numbers, joints=(slow, replace(quick, delay=0.02)))
    path = exported(both, "isaaclab", tmp_path)[0]["isaaclab_3_0.py"]
    fake = "class DelayedPDActuatorCfg(dict): pass"
    text = path.read_text(encoding="utf-8").replace("from isaaclab.actuators import DelayedPDActuatorCfg", fake)
    groups = runpy.run_path(str(written(tmp_path, text, "run_groups.py")))["ACTUATORS"].values()
    told = {tuple(group["joint_names_expr"]): group["min_delay"] for group in groups}
    assert told == {("pan",): round(LATE / 0.002), ("slide",): 10}
    assert all(list(group["armature"]) == group["joint_names_expr"] for group in groups)


def test_gains_that_an_explicit_servo_cannot_have_are_said(numbers, tmp_path):
    _, said = exported(replace(numbers, step=0.1), "isaaclab", tmp_path)
    (slide, *_) = [text for text in said if text.startswith("slide: at a physics step of 100 ms")]
    assert "stable below kp" in slide
    assert "it has 200 and 10" in slide


def test_usd_has_angles_in_degrees_where_its_schemas_do(numbers, tmp_path):
    rows = json.loads(exported(numbers, "usd", tmp_path)[0]["usd_attributes.json"].read_text("utf-8"))["attributes"]
    value = {(row["joint"], row["attribute"]): row["value"] for row in rows}
    assert value["pan", "drive:angular:physics:stiffness"] == pytest.approx(20 * pi / 180)
    assert value["pan", "physxJointAxis:angular:viscousFrictionCoefficient"] == pytest.approx(0.4 * pi / 180)
    assert value["pan", "newton:damping"] == pytest.approx(0.4 * pi / 180)
    assert value["pan", "mjc:damping"] == pytest.approx(0.4)
    assert value["pan", "physxJointAxis:angular:staticFrictionEffort"] == pytest.approx(0.2)
    assert value["slide", "drive:linear:physics:stiffness"] == pytest.approx(200)
    assert value["slide", "mjc:springref"] == pytest.approx(0.1)
    assert value["slide", "newton:delaySteps"] == round(LATE / 0.002)


def real(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")


def run(code: str) -> str:
    """In a process of its own: these packages start compilers and graphics."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_mjlab_accepts_its_files(numbers, tmp_path):
    real("mjlab")
    paths, _ = exported(numbers, "mjlab", tmp_path)
    code = f"""
import runpy
made = runpy.run_path({str(paths["mjlab_actuators.py"])!r})
(pan, slide) = made["actuators"]()
print(pan.delay_min_lag, pan.stiffness, slide.viscous_damping, slide.frictionloss)
print(sorted(runpy.run_path({str(paths["mjlab_events.py"])!r})["EVENTS"]))
"""
    said = run(code).splitlines()
    assert said[-2] == f"{round(LATE / 0.002)} 20.0 2.0 1.5"
    assert said[-1] == str(["dof_armature_slide", "dof_frictionloss_pan", "mass_b_2"])


def test_newton_builds_the_arm_with_its_numbers(numbers, tmp_path):
    real("newton")
    paths, _ = exported(numbers, "newton", tmp_path)
    code = f"""
import runpy, numpy as np
b = runpy.run_path({str(paths["newton_arm.py"])!r})["build"]()
print([round(float(x), 6) for x in b.joint_friction], [round(float(x), 6) for x in b.joint_armature])
m = b.finalize(device="cpu")
print(len(m.actuators))
"""
    said = run(code).splitlines()
    assert "[0.2, 1.5] [0.05, 0.3]" in said


def test_a_model_with_a_load_is_exported_for_every_simulator(tmp_path):
    links = joint("j1", "revolute", "base", "a", "0 1 0") + joint("j2", "revolute", "a", "b", "0 1 0")
    robot = described(tmp_path, links, ("j1", "j2"), "b")
    load = {"m0": 2.0, "hx0": 0.1, "hy0": 0.0, "hz0": 0.0, "mass": 2.0, "inertia": 0.02}
    load |= {"moment_x": 0.1, "moment_y": 0.0, "moment_z": 0.0}
    own = (
        ModelEffect("payload", (), load),
        ModelEffect("stribeck", ("j1",), {"speed": 0.1, "shape": 1.0, "rise": 8.9}),
    )
    model = replace(model_of(robot, bodies(robot), known=True), effects=own)
    model.save(tmp_path / "model.json")
    out = tmp_path / "out"
    shown = CliRunner().invoke(app, ["export", str(tmp_path / "model.json"), "--for", "IsaacLab", "-o", str(out)])
    assert shown.exit_code == 0, shown.output
    could = "Isaac Lab could say it nearly, by static above dynamic friction, which is not written"
    assert f"stribeck of j1 is not in the files ({could}): up to " in shown.stderr
    assert (out / "isaaclab_3_0.py").is_file()
    masses = [float(part.split('"')[0]) for part in (out / "r.urdf").read_text().split('mass value="')[1:]]
    assert sum(masses) == pytest.approx(model.standard[0] + model.standard[10] + 2.0)


def test_wrong_names_say_what_there_is(numbers, tmp_path, fixed):
    with pytest.raises(
        InputError, match="--for gazebo: no such simulator; there are mjcf, isaaclab, mjlab, usd, newton, g"
    ):
        write_target(numbers, "gazebo", tmp_path, print)
    shown = CliRunner().invoke(app, ["export", str(fixed), "-o", str(tmp_path / "x")])
    assert shown.exit_code != 0
    assert "--for" in str(shown.exception)
    shown = CliRunner().invoke(app, ["export", str(fixed), "--for", "usd"])
    assert "name the folder to write to with -o DIR" in str(shown.exception)
