"""A simulator written back corrected: the same file with other numbers, and the effects beside it."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.model.rigid_friction import ModelEffect
from agent.model.simulators import load_simulator
from agent.model.simulators.corrected_file import write_corrected
from agent.model.simulators.correction import Released, correct
from agent.model.simulators.xml_text import XmlText
from agent.robot import ParameterLayout

NAMES = ("pan", "lift", "turn")
MJCF = """<?xml version="1.0"?>
<!-- the arm of the bench -->
<mujoco model="bench">
  <compiler angle="degree"/>
  <default>
    <joint damping="1.5"/>
    <default class="big"><joint frictionloss="2" armature="0.4"/></default>
  </default>
  <worldbody>
    <light pos="0 0 3"/>
    <body name="turret" pos="0 0 0.1">
      <joint name="pan" class="big" axis="0 0 1"   range="-170 170" />   <!-- loose -->
      <inertial pos="0.02 0.01 0.1" mass="6" quat="0.9 0.1 0 0" diaginertia="0.08 0.07 0.05"/>
      <include file="boom.xml"/>
    </body>
  </worldbody>
  <actuator><position name='p1' joint="pan" kp="100"/></actuator>
</mujoco>
"""
BOOM = """<mujocoinclude>
<body name="boom" pos="0.1 0 0.2" euler="0 0 30">
  <joint name="lift" axis="0 1 0" ref="20" armature="0.2" frictionloss="1" stiffness="3" springref="-10"/>
  <inertial pos="0.2 0 0" mass="4" diaginertia="0.02 0.06 0.07"/>
  <body name="counterweight" pos="-0.1 0 0" euler="20 0 0"><geom size="0.05" mass="1.5"/></body>
  <body name="hand" pos="0.4 0 0">
    <joint name="turn" axis="1 0 0" armature="0.1"/>
    <geom type="box" size="0.05 0.02 0.03" pos="0.1 0.02 0.05" mass="1.2"/>
  </body>
</body>
</mujocoinclude>
"""
URDF = """<robot name="bench"><!-- from the maker --><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 0 0" rpy="0 0 0.3"/><mass value="5"/>
<inertia ixx="0.05" iyy="0.06" izz="0.07" ixy="0" ixz="0.001" iyz="0"/></inertial></link>
<joint name="pan" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="3" effort="100"/><dynamics damping="1.5" friction="0.5"/></joint>
<link name="b"/><link name="weight"><inertial><origin xyz="0.2 0 0"/><mass value="3"/>
<inertia ixx="0.03" iyy="0.04" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="held" type="fixed"><parent link="b"/><child link="weight"/><origin xyz="0.1 0 0" rpy="0.2 0 0"/></joint>
<joint name="lift" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="3" effort="100"/></joint>
<link name="c"><inertial><origin xyz="0.1 0 0.02"/><mass value="1"/>
<inertia ixx="0.003" iyy="0.004" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="turn" type="continuous"><parent link="weight"/><child link="c"/><origin xyz="0.3 0 0"/>
<axis xyz="1 0 0"/></joint></robot>
"""
PATHS = ("mjcf", "urdf")


def simulator(folder: Path, kind: str):
    if kind == "urdf":
        path = folder / "arm.urdf"
        path.write_text(URDF, encoding="utf-8")
    else:
        pytest.importorskip("mujoco")
        path = folder / "arm.xml"
        path.write_text(MJCF, encoding="utf-8")
        (folder / "boom.xml").write_text(BOOM, encoding="utf-8")
    return load_simulator(path, None, NAMES)


def corrected(given, effects=(), links=(), rotors=(), friction=(), change=None):
    released = Released(*({k: "because" for k in joints} for joints in (links, rotors, friction)))
    change = np.zeros(len(given.model.values)) if change is None else change
    weight = 1e4 * np.eye(len(given.model.independent))
    return correct(given, change, weight, np.ones(3), effects, released, {})


def loaded(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RATE = 500.0


def motion(seconds: float = 1.0):
    """(S, 3) smooth motion that turns back."""
    time = np.arange(int(seconds * RATE)) / RATE
    w, phase = np.array([5.0, 7.0, 11.0]), np.array([0.3, 1.0, 2.0])
    angle = np.outer(time, w) + phase
    return time, 0.5 * np.sin(angle), 0.5 * w * np.cos(angle), -0.5 * w**2 * np.sin(angle)


def torque_of_file(path: Path, module, q, qd, qdd):
    """(S, 3) of MuJoCo, or of Pinocchio, from the file and the effects, and of the bodies alone what these need."""
    model = load_simulator(path, None, NAMES).model  # for mass matrices only
    masses = np.array([model.rigid.dynamics.mass_matrix(row) for row in q])
    if path.suffix == ".urdf":
        import pinocchio as pin

        arm = pin.buildModelFromXML(path.read_text(encoding="utf-8"))
        arm.gravity.linear = np.array(model.robot.gravity)
        data = arm.createData()
        order = [arm.joints[arm.getJointId(name)].idx_v for name in NAMES]
        full = [np.append(row[:2], [np.cos(row[2]), np.sin(row[2])]) for row in q]
        load = np.array([pin.rnea(arm, data, a, b, c) for a, b, c in zip(full, qd, qdd, strict=True)])[:, order]
        root = ElementTree.parse(path).getroot()
        own = [root.find(f"joint[@name='{name}']/dynamics") for name in NAMES]
        friction, damping = (
            np.array([0.0 if e is None else float(e.get(key)) for e in own]) for key in ("friction", "damping")
        )
        plain = load + damping * qd
    else:
        import mujoco

        arm = mujoco.MjModel.from_xml_path(str(path))
        arm.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        data = mujoco.MjData(arm)
        plain = np.empty(q.shape)
        for k in range(len(q)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
            mujoco.mj_inverse(arm, data)
            plain[k] = data.qfrc_inverse
        friction = arm.dof_frictionloss
        spring = arm.jnt_stiffness * (q - arm.qpos_spring)
        load = plain - arm.dof_armature * qdd - arm.dof_damping * qd - spring
    effects = module.Effects(dt=1 / RATE)
    added = np.array([effects.torque(*row) for row in zip(q, qd, qdd, load, masses, strict=True)])
    total = plain + friction * np.tanh(qd / module.REVERSAL) + added
    return np.array([effects.reading(row) for row in total])


def entry(effect, *joints, **parameters):
    return ModelEffect(effect, joints, {name: float(value) for name, value in parameters.items()})


CASES = {
    "friction": entry("friction_change", "lift", coulomb_change=0.7, viscous_change=0.2),
    "payload": entry(
        "payload", m0=1, hx0=0.1, hy0=0, hz0=0.05, mass=1, moment_x=0.1, moment_y=0, moment_z=0.05, inertia=0.004
    ),
    "base_tilt": entry("base_tilt", tilt_1=0.05, tilt_2=-0.03),
    "encoder_offset": entry("encoder_offset", "lift", offset=0.04),
    "spring": entry("dress_pack", "lift", constant=0.4, stiffness=2.5),
    "stribeck": entry("stribeck", "pan", speed=0.2, shape=2, rise=1.5),
    "asymmetric_friction": entry(
        "asymmetric_friction", "lift", coulomb=1, viscous=1, coulomb_asymmetry=0.3, viscous_asymmetry=0.1
    ),
    "load_dependent_friction": entry("load_dependent_friction", "lift", coefficient=0.08),
    "load_dependent_friction, another power": entry(
        "load_dependent_friction", "lift", power=2, load=20, coefficient=0.08
    ),
    "load_dependent_friction, sheared": entry(
        "load_dependent_friction", "lift", sheared=1, coefficient=0.05, sheared_coefficient=0.1
    ),
    "load_dependent_friction, driven": entry(
        "load_dependent_friction", "lift", driven=1, coefficient=0.1, driven_coefficient=0.04
    ),
    "shear": entry("viscous_nonlinearity", "pan", speed=0.3, bend=0.8, viscous_change=-0.2),
    "power": entry("viscous_nonlinearity", "pan", power=3, bend=0.1, viscous_change=0.1),
    "thermal_friction": entry(
        "thermal_friction",
        "pan",
        time_constant=0.6,
        coulomb_change=0.2,
        coulomb_drift=1,
        viscous_change=0,
        viscous_drift=0.1,
    ),
    "warming by the way gone": entry(
        "thermal_friction", "pan", way=0.8, coulomb_change=0.2, coulomb_drift=1, viscous_change=0, viscous_drift=0.1
    ),
    "presliding": entry("presliding", "lift", travel=0.02, level=1.2),
    "torque_ripple": entry(
        "torque_ripple", "turn", order=40, harmonics=2, cosine_1=0.2, sine_1=0.1, cosine_2=0, sine_2=0.05
    ),
    "gravity_spring": entry("gravity_spring", "lift", harmonics=1, cosine_1=2, sine_1=-1),
    "hose": entry(
        "dress_pack",
        "lift",
        low=-0.4,
        high=0.45,
        travel=0.03,
        hysteresis=0.5,
        **{f"torque_{k}": v for k, v in enumerate((0.1, 0.4, 0.2, -0.3, -0.5, -1.5))},
    ),
    "hose that hardens": entry(
        "dress_pack", "lift", middle=0.1, reach=0.4, constant=0.2, stiffness=0.8, quadratic=-0.6, cubic=3
    ),
    "wrist_coupling": entry("wrist_coupling", "lift", "turn", ratio=0.3, rotor=0.1, share=1.1),
    "wrist_coupling, free": entry(
        "wrist_coupling",
        "lift",
        "turn",
        ratio=-0.4,
        free=1,
        axle_side=1,
        rotor=0.1,
        viscous=0.3,
        coulomb=0.2,
        transmission=-0.9,
    ),
    "wrist_coupling, rubbing besides": entry(
        "wrist_coupling",
        "lift",
        "turn",
        ratio=1.3,
        besides=1,
        turning=1,
        rotor=0.1,
        share=0.9,
        viscous=0.3,
        coulomb=0.2,
    ),
    "wrist_coupling, a shaft besides": entry(
        "wrist_coupling", "lift", "turn", ratio=-0.7, besides=1, shaft=1, inertia=0.05, viscous=0.3, coulomb=0.2
    ),
    "torque_constant": entry("torque_constant", "pan", scale_error=0.07),
    "torque_offset": entry("torque_offset", "turn", offset=0.3),
}
TWO_MASS = {
    "joint_elasticity": entry("joint_elasticity", "turn", stiffness=60, damping=0.05, share=1),
    "backlash": entry("backlash", "turn", stiffness=60, damping=0.1, gap=0.01, share=1),
}


@pytest.mark.parametrize("kind", PATHS)
@pytest.mark.parametrize("what", [*CASES, *TWO_MASS])
def test_the_file_and_its_effects_give_the_torque_of_our_model(what, kind, tmp_path):
    given = simulator(tmp_path, kind)
    found = corrected(given, [{**CASES, **TWO_MASS}[what]])
    if what in TWO_MASS:  # our prediction damps by the mean inertia along the motion
        mass = [found.model.rigid.dynamics.mass_matrix(row) for row in motion()[1]]
        found = replace(found, inertia=np.mean([np.diag(matrix) for matrix in mass], axis=0))
    out = tmp_path / f"fixed{given.arm.path.suffix}"
    written = write_corrected(given, found, out)
    time, q, qd, qdd = motion()
    expected = found.model.predict(q, qd, qdd, time)
    code = [path for path in written if path.suffix == ".py"]
    module = (
        loaded(code[0])
        if code
        else loaded(
            write_corrected(given, corrected(given, [CASES["torque_offset"]]), tmp_path / f"no{out.suffix}")[-1]
        )
    )
    if not code:
        module.EFFECTS = ()
    torque = torque_of_file(out, module, q, qd, qdd)
    plain = given.model.predict(q, qd, qdd, time)
    assert np.abs(expected - plain).max() > 1e-3 * np.abs(plain).max()
    # mass matrices are interpolated in our prediction of two masses, and teeth may meet a step earlier
    tolerance = {"joint_elasticity": 1e-3, "backlash": 1e-2}.get(what, 1e-6)
    assert np.abs(torque - expected).max() < tolerance * np.abs(expected).max()


def moved(given, links=(), rotors=()):
    """A change of the model's parameters that makes links heavier by a third and rotors by a tenth of their joint's."""
    model = given.model
    standard = np.zeros(len(model.standard))
    for k in links:
        standard[10 * k : 10 * k + 10] = model.standard[10 * k : 10 * k + 10] / 3
    for k in rotors:
        standard[30 + k] = 0.05
    return np.append(model.projection @ standard, [0.3, 0.2] * 3)


@pytest.mark.parametrize("kind", PATHS)
def test_only_what_was_released_changes_and_every_change_is_said(kind, tmp_path):
    given = simulator(tmp_path, kind)
    change = moved(given, links=[1], rotors=[0])
    found = corrected(given, [CASES["stribeck"]], links=[1], rotors=[0], friction=[2], change=change)
    out = tmp_path / f"fixed{given.arm.path.suffix}"
    written = write_corrected(given, found, out)
    time, q, qd, qdd = motion()
    torque = torque_of_file(out, loaded(written[-1]), q, qd, qdd)
    expected = found.model.predict(q, qd, qdd, time)
    assert np.abs(torque - expected).max() < 1e-6 * np.abs(expected).max()
    wanted = given.model.predict(q, qd, qdd, time) + given.model.rigid.torque(
        q, qd, qdd, change[: len(given.model.independent)]
    )
    rest = expected - wanted
    assert np.abs(rest[:, 1]).max() < 1e-3 * np.abs(expected).max()  # bodies as the fit had them, no friction
    document = json.loads((tmp_path / "fixed.changes.json").read_text())
    assert {(c["element"], c["attribute"]) for c in document["changes"]} >= {
        ("joint turn", "frictionloss"),
        ("joint turn", "damping"),
    }
    assert {c["element"].split()[1] for c in document["changes"]} == (
        {"pan", "turn", "boom"} if kind == "mjcf" else {"turn", "weight"}
    )
    assert all(c["reason"] == "because" and c["old"] != c["new"] for c in document["changes"])
    assert document["effects"][0]["effect"] == "stribeck"


def test_the_text_of_an_mjcf_stays_as_it_was(tmp_path):
    given = simulator(tmp_path, "mjcf")
    found = corrected(given, friction=[0], change=moved(given))
    out = tmp_path / "fixed.xml"
    written = write_corrected(given, found, out)
    assert [path.name for path in written] == ["fixed.xml", "fixed.changes.json"]
    joint = '<joint name="pan" class="big" axis="0 0 1"   range="-170 170" />'
    new = joint.replace(" />", ' frictionloss="2.3" damping="1.7" />')
    assert out.read_text() == MJCF.replace(joint, new)


def test_an_include_that_changes_is_written_beside_the_file(tmp_path):
    given = simulator(tmp_path, "mjcf")
    found = corrected(given, links=[2], change=moved(given, links=[2]))
    files = {path.name: path.read_text() for path in write_corrected(given, found, tmp_path / "fixed.xml")}
    assert set(files) == {"fixed.xml", "fixed_boom.xml", "fixed.changes.json"}
    assert files["fixed.xml"] == MJCF.replace('"boom.xml"', '"fixed_boom.xml"')
    assert files["fixed_boom.xml"].count("<inertial") == 2
    assert (tmp_path / "boom.xml").read_text() == BOOM


def test_a_urdf_keeps_its_text_too(tmp_path):
    given = simulator(tmp_path, "urdf")
    found = corrected(given, friction=[0, 1], change=moved(given))
    write_corrected(given, found, tmp_path / "fixed.urdf")
    text = URDF.replace('damping="1.5" friction="0.5"', 'damping="1.7" friction="0.8"')
    first = '<joint name="lift" type="revolute">'
    text = text.replace(first, f'{first}\n  <dynamics damping="0.2" friction="0.3"/>')
    assert (tmp_path / "fixed.urdf").read_text() == text


def test_from_another_folder_meshes_are_found_where_they_are(tmp_path):
    import mujoco

    given = simulator(tmp_path, "mjcf")
    (tmp_path / "parts").mkdir()
    cube = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
    (tmp_path / "parts" / "cube.obj").write_text(cube)
    mesh = '<asset><mesh name="cube" file="cube.obj" scale=".1 .1 .1"/></asset>'
    text = MJCF.replace('angle="degree"', 'angle="degree" meshdir="parts"').replace("<default>", f"{mesh}<default>", 1)
    (tmp_path / "arm.xml").write_text(text)
    given = load_simulator(tmp_path / "arm.xml", None, NAMES)
    (tmp_path / "out").mkdir()
    write_corrected(given, corrected(given, friction=[0], change=moved(given)), tmp_path / "out" / "fixed.xml")
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "fixed.xml")).dof_frictionloss[0] == 2.3


def test_bodies_that_could_not_exist_are_not_written(tmp_path):
    given = simulator(tmp_path, "urdf")
    lighter = -4 * moved(given, links=[2])
    found = corrected(given, links=[2], change=lighter)
    assert "could not exist" in " ".join(found.notes)
    write_corrected(given, found, tmp_path / "fixed.urdf")
    assert "could not exist" in (tmp_path / "fixed.changes.json").read_text()
    mass = float(re.search(r'"c".*?mass value="([^"]*)"', (tmp_path / "fixed.urdf").read_text(), re.S)[1])
    assert 0 < mass < 0.5


def test_the_effects_need_numpy_alone_and_take_many_arms_at_once(tmp_path):
    given = simulator(tmp_path, "urdf")
    effects = [entry for name, entry in CASES.items() if name not in ("payload", "base_tilt", "encoder_offset")]
    path = write_corrected(given, corrected(given, [*effects, *TWO_MASS.values()]), tmp_path / "fixed.urdf")[-1]
    text = path.read_text()
    assert set(re.findall(r"^(?:import|from) (\w+)", text, re.M)) == {"__future__", "numpy", "typing"}
    module = loaded(path)
    many, one = module.Effects((4, 2), dt=0.01), module.Effects(dt=0.01)
    rng = np.random.default_rng(0)
    for q, qd, qdd, load in rng.uniform(-1, 1, (20, 4, 4, 2, 3)):
        both = many.torque(q, qd, qdd, load)
        np.testing.assert_allclose(both[1, 0], one.torque(q[1, 0], qd[1, 0], qdd[1, 0], load[1, 0]), atol=1e-12)
        assert many.reading(both).shape == (4, 2, 3)
    subprocess.run(
        [sys.executable, "-I", "-c", "import runpy, sys; runpy.run_path(sys.argv[1])", str(path)], check=True
    )


def test_mujoco_takes_the_effects_as_passive_forces(tmp_path):
    import mujoco

    given = simulator(tmp_path, "mjcf")
    written = write_corrected(given, corrected(given, [CASES["gravity_spring"]]), tmp_path / "fixed.xml")
    module = loaded(written[-1])
    model = mujoco.MjModel.from_xml_path(str(written[0]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    before = data.qfrc_passive.copy()
    try:
        module.install(mujoco, model)
        mujoco.mj_forward(model, data)
        q = data.qpos[1]
        assert (data.qfrc_passive - before)[1] == pytest.approx(-(2 * np.cos(q) - np.sin(q)))
        mujoco.mj_step(model, data, 50)
        assert np.all(np.isfinite(data.qpos))
    finally:
        mujoco.set_mjcb_passive(None)


def test_what_cannot_be_changed_in_place_is_refused_and_nothing_is_written(tmp_path):
    given = simulator(tmp_path, "mjcf")
    (tmp_path / "arm.xml").write_text(MJCF.replace('angle="degree"', 'angle="degree" boundmass="5"'))
    given = load_simulator(tmp_path / "arm.xml", None, NAMES)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(Exception, match=r"nothing was written.*differ by"):
        write_corrected(given, corrected(given, links=[2], change=-moved(given, links=[2])), tmp_path / "fixed.xml")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize("text", ['<a b=\'1\' c="x > y"><!-- b="2" --><d/>\n  <e  /></a>', "<a>\n  <b x = '1'/>\n</a>"])
def test_xml_text(text):
    xml = XmlText(text.encode())
    assert xml.changed() == text.encode()
    first = xml.root.children[0]
    first.set("new", 'a"<b')
    first.inserted.append("<in/>")
    again = XmlText(xml.changed()).root.children[0]
    assert again.get("new") == 'a"<b'
    assert [tag.name for tag in again.children] == ["in"]
    first.set("new", None)
    first.inserted.clear()
    with pytest.raises(ValueError, match="UTF-8"):
        XmlText(text.encode("utf-16"))


def test_a_format_that_the_simulator_does_not_have_is_refused(tmp_path):
    from agent.pipeline.corrected_simulator import check_simulator_out

    simulator(tmp_path, "urdf")
    with pytest.raises(InputError, match="here it is a URDF"):
        check_simulator_out(tmp_path / "arm.urdf", tmp_path / "fixed.xml", [])
    with pytest.raises(InputError, match="a model file"):
        check_simulator_out(tmp_path / "model.json", tmp_path / "fixed.urdf", [])
    code = tmp_path / "fixed_effects.py"
    code.write_text("")
    with pytest.raises(InputError, match="fixed_effects"):
        check_simulator_out(tmp_path / "arm.urdf", tmp_path / "fixed.urdf", [code])


@pytest.mark.parametrize("kind", PATHS)
def test_a_rotor_found_as_a_link_becomes_armature_and_no_link_of_tons(tmp_path, kind):
    given = simulator(tmp_path, kind)
    layout = ParameterLayout.of(given.model.robot)
    change = np.zeros(len(given.model.values))
    change[: len(given.model.independent)] = 2.0 * given.model.projection[:, layout.rotors][:, 1]
    found = corrected(given, links=(1,), change=change)
    assert found.arm.carrying[1].own[0] < 3 * given.arm.carrying[1].own[0]
    q, qd, qdd = np.random.default_rng(2).uniform(-1, 1, (3, 20, 3))
    time = np.arange(20.0)
    gained = found.model.predict(q, qd, qdd, time) - given.model.predict(q, qd, qdd, time)
    np.testing.assert_allclose(gained[:, 1], 2.0 * qdd[:, 1], atol=0.05)
    assert found.arm.armature[1] == pytest.approx(given.arm.armature[1] + 2.0, abs=0.2)
