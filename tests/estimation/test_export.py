"""From base parameters to bodies, and to files that other programs read."""

import json
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings, strategies as st
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core.errors import RejectedError
from agent.model import FrictionTerm, IdentifiedModel, ModelEffect, Reversal
from agent.model.standard_parameters import check_physical, full_parameters, possible_model, pseudo_inertia
from agent.robot import RobotDescription, load_robot, rigid_bodies
from agent.simulators.export import export_model

try:
    import mujoco
except ImportError:
    mujoco = None
needs_mujoco = pytest.mark.skipif(mujoco is None, reason="mujoco is missing: pip install calibration-agent[mujoco]")
WRIST = ((1, 0, 0, 0, 0, 0), (0, 1, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0), (0, 0, 0, 1, 0, 0), (0, 0, 0, 0, 1, 0))
COUPLED = (*(tuple(map(float, row)) for row in WRIST), (0.0, 0.0, 0.0, 0.0, 1.0, 1.0))


def bodies(robot: RobotDescription, seed: int = 0, spread: float = 0.1) -> np.ndarray:
    """(11 n,) physical parameters around the URDF's: each link scaled in mass and stretched."""
    from agent.robot.dynamics import Dynamics

    rng = np.random.default_rng(seed)
    links = Dynamics(robot).standard_parameters().reshape(-1, 10).copy()
    for block in links:
        segment = 1 + rng.uniform(-spread, spread)
        block *= np.array([1, *[segment] * 3, *[segment**2] * 6]) * (1 + rng.uniform(-spread, spread))
    rotors = np.array([joint.rotor_inertia or 1e-4 for joint in robot.joints])
    return np.append(links.ravel(), rotors * (1 + rng.uniform(-spread, spread, robot.dof)))


def model_of(robot: RobotDescription, standard: np.ndarray, known: bool) -> IdentifiedModel:
    """A model with these bodies; `known`: the fit found the bodies themselves, not just base parameters."""
    rigid = rigid_bodies(robot)
    terms, friction = [], []
    for axle in range(robot.dof):
        sign = Reversal("speed", 1e-3)
        terms += [FrictionTerm(axle, "coulomb", sign), FrictionTerm(axle, "viscous")]
        friction += [10.0 + axle, 5.0 + axle]
    base = rigid.projection @ standard
    parameters = len(base) + len(terms)
    n = robot.dof
    return IdentifiedModel(
        robot=robot,
        independent=rigid.independent,
        projection=rigid.projection,
        standard_names=rigid.standard_names,
        combinations=rigid.combinations,
        terms=tuple(terms),
        values=np.append(base, friction),
        covariance=np.eye(parameters),
        cutoff=30.0,
        order=8,
        method="consistent" if known else "weighted",
        weights=np.ones((2, n)),
        residual_rmse=np.ones(n),
        held_out_rmse=np.ones(n),
        condition_number=10.0,
        standard=standard if known else None,
    )


def states(robot: RobotDescription, count: int = 30) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    q = rng.uniform(lower, upper, (count, robot.dof))
    return q, rng.choice([-1, 1], q.shape) * rng.uniform(0.2, 1, q.shape) * robot.max_velocity, rng.normal(size=q.shape)


def by_pinocchio(urdf: Path, friction: Path, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(S, n) torque of an exported URDF with the rotors and gravity of its friction file."""
    read, drive = pin.buildModelFromUrdf(str(urdf)), json.loads(friction.read_text())
    assert tuple(read.names)[1:] == tuple(axle["name"] for axle in drive["axles"])
    read.gravity.linear = np.array(drive["gravity"])
    read.armature = np.array([axle["armature"] for axle in drive["axles"]])
    data, torque = read.createData(), np.empty(q.shape)
    for k, here in enumerate(q):
        # a continuous joint has two coordinates in Pinocchio
        parts = [[np.cos(x), np.sin(x)] if width == 2 else [x] for x, width in zip(here, read.nqs[1:], strict=False)]
        torque[k] = pin.rnea(read, data, np.concatenate(parts), qd[k], qdd[k])
    return torque


def by_mujoco(read, data, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """(S, n) torque of MuJoCo's inverse dynamics without constraints."""
    torque = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(read, data)
        torque[k] = data.qfrc_inverse - data.qfrc_constraint
    return torque


def friction_torque(model: IdentifiedModel, qd: np.ndarray) -> np.ndarray:
    speed = qd @ model.robot.coupling.T
    values = model.values[len(model.independent) :].reshape(-1, 2)
    return (values[:, 0] * np.sign(speed) + values[:, 1] * speed) @ model.robot.coupling


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), spread=st.floats(0.0, 0.4))
def test_finds_physical_bodies_with_the_given_base_parameters(seed: int, spread: float, ns16: RobotDescription) -> None:
    model = model_of(ns16, bodies(ns16, seed, spread), known=False)
    standard = full_parameters(model)
    check_physical(ns16, standard)
    np.testing.assert_allclose(model.projection @ standard, model.base_values, rtol=1e-11, atol=1e-11)


def test_keeps_the_urdf_bodies_if_their_base_parameters_agree(ns16: RobotDescription) -> None:
    standard = bodies(ns16, spread=0.0)
    np.testing.assert_allclose(full_parameters(model_of(ns16, standard, known=False)), standard, rtol=1e-6, atol=1e-7)


def test_refuses_base_parameters_of_no_physical_body(ns16: RobotDescription) -> None:
    model = model_of(ns16, bodies(ns16), known=False)
    values = model.values.copy()
    values[[k for k, name in enumerate(model.names) if name == "J6"]] = -1e-4
    with pytest.raises(RejectedError, match="consistent"):
        full_parameters(replace(model, values=values))


@pytest.mark.parametrize("fault", ["inertia", "rotor"])
def test_export_refuses_non_physical_bodies(ns16: RobotDescription, tmp_path: Path, fault: str) -> None:
    standard = bodies(ns16)
    standard[{"inertia": 39, "rotor": 62}[fault]] *= -1
    with pytest.raises(RejectedError, match="joint_4" if fault == "inertia" else "joint_3"):
        export_model(model_of(ns16, standard, known=True), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_pseudo_inertia_is_the_second_moment_of_a_density() -> None:
    rng = np.random.default_rng(0)
    points, masses = rng.normal(size=(20, 3)), rng.uniform(0.1, 1, 20)
    inertia = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for p, m in zip(points, masses, strict=True))
    order = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
    block = np.array([masses.sum(), *(masses @ points), *(inertia[i, j] for i, j in order)])
    homogeneous = np.column_stack([points, np.ones(20)])
    np.testing.assert_allclose(pseudo_inertia(block), homogeneous.T @ (masses[:, None] * homogeneous), atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_pinocchio_finds_the_torques_of_the_fit(ns16: RobotDescription, tmp_path: Path, known: bool) -> None:
    """With the friction in the URDF, and a table of the parameters."""
    model = model_of(ns16, bodies(ns16), known)
    urdf, _, friction, *others = export_model(model, tmp_path)
    torque, expected = by_pinocchio(urdf, friction, *states(ns16)), model.rigid.torque(*states(ns16), model.base_values)
    np.testing.assert_allclose(torque, expected, rtol=0, atol=1e-9)
    joints = {joint.get("name"): joint for joint in ElementTree.parse(urdf).getroot().iter("joint")}
    for k, name in enumerate(ns16.joint_names):
        (dynamics,) = joints[name].findall("dynamics")
        assert float(dynamics.get("friction")) == pytest.approx(10 + k)
        assert float(dynamics.get("damping")) == pytest.approx(5 + k)
    header, *rows = (tmp_path / "parameters.csv").read_text("utf-8").splitlines()
    assert header.startswith("parameter,value,")
    assert len(rows) > 40
    assert (tmp_path / "foxglove-layout.json") in others


def with_effects(model: IdentifiedModel) -> IdentifiedModel:
    """Everything that numbers of a file can say, and two effects that none can."""
    load = {"m0": 2.0, "hx0": 0.1, "hy0": -0.05, "hz0": 0.3, "mass": 2.0, "inertia": 0.02}
    load |= {"moment_x": 0.1, "moment_y": -0.05, "moment_z": 0.3}
    own = (
        ModelEffect("payload", (), load),
        ModelEffect(
            "friction_change",
            ("joint_2",),
            {"coulomb": 1.0, "coulomb_change": 4.0, "viscous": 1.0, "viscous_change": 3.0},
        ),
        ModelEffect("base_tilt", (), {"tilt_1": 0.003, "tilt_2": -0.002}),
        ModelEffect("encoder_offset", ("joint_3",), {"offset": 1e-5}),
        ModelEffect("gravity_spring", ("joint_2",), {"constant": 30.0, "stiffness": 50.0}),
        ModelEffect("stribeck", ("joint_1",), {"speed": 0.1, "shape": 1.0, "rise": 8.9}),
        ModelEffect("torque_offset", ("joint_4",), {"offset": 2.0}),
    )
    return replace(model, effects=own)


@needs_mujoco
@pytest.mark.parametrize("known", [True, False])
def test_a_load_and_other_effects_of_the_model_are_in_the_files(ns16: RobotDescription, tmp_path: Path, known: bool):
    model = with_effects(model_of(ns16, bodies(ns16), known))
    model.save(tmp_path / "model.json")
    shown = CliRunner().invoke(app, ["export", str(tmp_path / "model.json"), "-o", str(tmp_path / "out")])
    assert shown.exit_code == 0, shown.output
    read = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / f"{ns16.name}.xml"))
    read.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    q, qd, qdd = states(ns16)
    fast = np.sign(qd) * np.maximum(np.abs(qd), 1.0)  # where only the line of friction is left of Coulomb and Stribeck
    torque = by_mujoco(read, mujoco.MjData(read), q, fast, qdd) + read.dof_frictionloss * np.sign(fast)
    expected = replace(model, effects=model.effects[:5]).predict(q, fast, qdd, np.arange(len(q)) * 0.01)
    np.testing.assert_allclose(torque, expected, rtol=0, atol=2e-4 * np.abs(expected).max())  # a tilt
    root = ElementTree.parse(tmp_path / "out" / f"{ns16.name}.sdf").getroot()
    assert float(next(root.iter("spring_stiffness")).text) == 50.0
    said = shown.stderr
    assert re.search(r"files do not have: stribeck of joint_1 \(up to \d\S* N·m on joint_1\)", said)
    assert "torque_offset of joint_4 (up to 2 N·m on joint_4, of what the robot measures, not of how it moves)" in said
    assert "the URDF has no springs: that of joint_2" in said
    assert re.search(r"URDF and SDF have no rotor inertia \(up to \d", said)
    assert "payload" not in said


def test_other_friction_forms_are_exported_as_a_line_fit(ns16: RobotDescription, tmp_path: Path) -> None:
    model = model_of(ns16, bodies(ns16), known=True)
    terms = (*model.terms, FrictionTerm(1, "quadratic"))
    parameters = len(model.values) + 1
    model = replace(model, terms=terms, values=np.append(model.values, -1.5), covariance=np.eye(parameters))
    said: list[str] = []
    axle = json.loads(export_model(model, tmp_path, said.append)[2].read_text())["axles"][1]
    speed = np.linspace(0, ns16.max_velocity[1], 20)
    curve = 11 + 6 * speed - 1.5 * speed**2
    assert np.abs(axle["friction"] + axle["damping"] * speed - curve).max() < 0.12 * curve.max()
    assert [term["form"] for term in axle["terms"]] == ["coulomb", "viscous", "quadratic"]
    assert any(re.search(r"what friction differs by from the line .* \(up to .* on joint_2", text) for text in said)


def test_the_line_of_friction_is_laid_over_the_speeds_of_the_fit(ns16: RobotDescription, tmp_path: Path) -> None:
    """A curve is no better known beyond them, and a local model would lose its own level of friction to it."""
    model = model_of(ns16, bodies(ns16), known=True)
    terms = (*model.terms, FrictionTerm(1, "quadratic"))
    seen = {key: [value] * 6 for key, value in (("lowest", -1.0), ("highest", 1.0), ("fastest", 0.2))}
    local = replace(
        model,
        terms=terms,
        values=np.append(model.values, 4.0),
        covariance=np.zeros((len(model.values) + 1,) * 2),
        provenance={**model.provenance, "range": seen},
    )
    export_model(local, tmp_path)
    axle = json.loads((tmp_path / "friction.json").read_text())["axles"][1]
    speed = np.linspace(0.02, 0.2, 10)  # the model has 11 + 6 w + 4 w²
    assert axle["friction"] + axle["damping"] * speed == pytest.approx(11 + 6 * speed + 4 * speed**2, abs=0.05)


def test_bodies_fixed_to_a_link_become_part_of_it(tmp_path: Path) -> None:
    urdf = """<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0.2 0 0"/><mass value="4"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <link name="plate"><inertial><mass value="2"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>
    </inertial></link><link name="finger"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
    <joint name="bolts" type="fixed"><parent link="arm"/><child link="plate"/>
    <origin xyz="0.5 0 0" rpy="0 1 0"/></joint>
    <joint name="grip" type="prismatic"><parent link="plate"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.1" velocity="1" effort="1"/></joint></robot>"""
    (tmp_path / "r.urdf").write_text(urdf)
    (tmp_path / "robot.yaml").write_text(
        "name: r\nurdf: r.urdf\ntip_frame: plate\njoints: [{name: j, max_velocity: 2, max_acceleration: 5}]\n"
    )
    robot = load_robot(tmp_path)
    model = model_of(robot, bodies(robot, spread=0.0), known=True)
    written, *_ = export_model(model, tmp_path / "out")
    read = pin.buildModelFromUrdf(str(written))
    assert read.nv == 1
    assert read.inertias[1].mass == pytest.approx(7.0)
    assert [link.get("name") for link in ElementTree.parse(written).getroot().iter("link") if len(link)] == ["arm"]


@needs_mujoco
@pytest.mark.parametrize("coupled", [False, True])
def test_mujoco_finds_the_torques_of_the_fit(ns16: RobotDescription, tmp_path: Path, coupled: bool) -> None:
    robot = replace(ns16, motor_coupling=COUPLED) if coupled else ns16
    model = model_of(robot, bodies(robot), known=True)
    read = mujoco.MjModel.from_xml_path(str(export_model(model, tmp_path)[1]))
    read.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    q, qd, qdd = states(robot)
    coulomb = np.array([10.0 + axle for axle in range(robot.dof)]) * np.sign(qd @ robot.coupling.T) @ robot.coupling
    expected = model.rigid.torque(q, qd, qdd, model.base_values) + friction_torque(model, qd) - coulomb
    np.testing.assert_allclose(by_mujoco(read, mujoco.MjData(read), q, qd, qdd), expected, rtol=0, atol=1e-9)


@needs_mujoco
def test_mujoco_reads_the_urdf_too(ns16: RobotDescription, tmp_path: Path) -> None:
    model = model_of(ns16, bodies(ns16), known=True)
    urdf, _, friction, *_ = export_model(model, tmp_path)
    read = mujoco.MjModel.from_xml_path(str(urdf))
    assert read.opt.gravity[2] == ns16.gravity[2]
    read.dof_armature[:] = [axle["armature"] for axle in json.loads(friction.read_text())["axles"]]
    np.testing.assert_allclose(read.dof_frictionloss, [10.0 + k for k in range(6)])
    read.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
    q, qd, qdd = states(ns16)
    expected = model.rigid.torque(q, 0 * qd, qdd, model.base_values)
    np.testing.assert_allclose(by_mujoco(read, mujoco.MjData(read), q, 0 * qd, qdd), expected, rtol=0, atol=1e-9)


BODY = (
    '<inertial><origin xyz="0.1 0.02 0.05" rpy="0.1 0.2 0.3"/><mass value="1"/>'
    '<inertia ixx="0.02" iyy="0.03" izz="0.025" ixy="0.001" ixz="0" iyz="0"/></inertial>'
)


def joint(
    name: str, kind: str, parent: str, child: str, axis: str = "0 0 1", rpy: str = "0 0 0", rest: str = ""
) -> str:
    limit = "" if kind in ("fixed", "continuous") else '<limit lower="-2" upper="2" velocity="2" effort="50"/>'
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.1 0 0.2" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}{rest}</joint>'
        f'<link name="{child}">{BODY}</link>'
    )


ARM = (
    joint("j1", "revolute", "base", "a")
    + joint("j2", "revolute", "a", "b", "0 1 0", "0.4 0.1 0")
    + joint("j3", "continuous", "b", "c", "0.6 0 0.8")
)
#: Content of URDFs of public arms: elements of the root, joints of the description, tip frame.
DESCRIPTIONS = {
    "joints named again by transmissions": (
        ARM + '<transmission name="t"><joint name="j1"><x/></joint></transmission><gazebo reference="a"/>',
        ("j1", "j2", "j3"),
        "c",
    ),
    "links called like joints": (
        joint("a", "revolute", "base", "b", "0 1 0") + joint("b", "prismatic", "b", "a", "1 0 0"),
        ("a", "b"),
        "a",
    ),
    "frames fixed to base and flange": (
        joint("bolts", "fixed", "base", "plinth", rpy="0.3 0.2 0.1")
        + joint("j1", "revolute", "plinth", "a", "0 1 0")
        + joint("plate", "fixed", "a", "plate", rpy="1 0 0")
        + joint("j2", "revolute", "plate", "b", "1 0 0")
        + joint("flange", "fixed", "b", "tool")
        + joint("view", "fixed", "base", "camera"),
        ("j1", "j2"),
        "tool",
    ),
    "a subset of the joints": (ARM, ("j1", "j3"), "c"),
    "a tip frame in mid-chain": (ARM, ("j1", "j2"), "b"),
    "a joint as tip frame": (ARM, ("j1", "j2", "j3"), "j3"),
    "another branch, with a mimic joint": (
        ARM
        + joint("f1", "prismatic", "c", "finger", "1 0 0")
        + joint("f2", "prismatic", "c", "thumb", "1 0 0", rest='<mimic joint="f1" multiplier="-1"/>'),
        ("j1", "j2", "j3"),
        "c",
    ),
    "pi with few digits": (ARM.replace("0.4 0.1 0", "-1.5708 0 0"), ("j1", "j2", "j3"), "c"),
    "axes not of unit length": (joint("j1", "revolute", "base", "a", "0 2 0"), ("j1",), "a"),
}


def described(folder: Path, elements: str, joints: tuple[str, ...], tip: str) -> RobotDescription:
    (folder / "r.urdf").write_text(f'<robot name="r"><link name="base"/>{elements}</robot>')
    rows = "".join(f"  - {{name: {j}, gear_ratio: 50, max_velocity: 2, max_acceleration: 5}}\n" for j in joints)
    (folder / "robot.yaml").write_text(f"name: r\nurdf: r.urdf\ntip_frame: {tip}\njoints:\n{rows}")
    return load_robot(folder)


@pytest.mark.parametrize("kind", DESCRIPTIONS)
def test_every_description_is_exported_and_read_back(tmp_path: Path, kind: str) -> None:
    robot = described(tmp_path, *DESCRIPTIONS[kind])
    model = model_of(robot, bodies(robot, spread=0.1), known=True)
    urdf, _, friction, *_ = export_model(model, tmp_path / "out")
    assert [axle["name"] for axle in json.loads(friction.read_text())["axles"]] == list(robot.joint_names)
    torque, motion = by_pinocchio(urdf, friction, *states(robot)), states(robot)
    left_out = 1e-4 if kind == "pi with few digits" else 0.0  # by base parameters
    np.testing.assert_allclose(torque, model.rigid.torque(*motion, model.base_values), rtol=0, atol=1e-9 + left_out)


def test_the_sdf_has_the_torques_of_the_bodies(ns16, tmp_path):
    """Read by hand into another library: joints and links with the poses of the SDF."""
    standard = bodies(ns16)
    export_model(model_of(ns16, standard, known=True), tmp_path)
    root = ElementTree.parse(tmp_path / f"{ns16.name}.sdf").getroot()
    links = {link.get("name"): link for link in root.iter("link")}

    def numbers(element, path):
        return np.array(element.find(path).text.split(), dtype=float)

    def frame(link):
        pose = numbers(link, "pose")
        return pin.SE3(pin.rpy.rpyToMatrix(*pose[3:]), pose[:3])

    read, parent, before = pin.Model(), 0, pin.SE3.Identity()
    for joint in root.iter("joint"):
        link = links[joint.find("child").text]
        turning = pin.JointModelRevoluteUnaligned(numbers(joint, "axis/xyz"))
        parent = read.addJoint(parent, turning, before.actInv(frame(link)), joint.get("name"))
        before = frame(link)
        i = {e.tag: float(e.text) for e in link.find("inertial/inertia")}
        tensor = np.array(
            [[i["ixx"], i["ixy"], i["ixz"]], [i["ixy"], i["iyy"], i["iyz"]], [i["ixz"], i["iyz"], i["izz"]]]
        )
        body = pin.Inertia(float(link.find("inertial/mass").text), numbers(link, "inertial/pose")[:3], tensor)
        read.appendBodyToJoint(parent, body, pin.SE3.Identity())
    read.gravity.linear = np.array(ns16.gravity)
    data = read.createData()
    without_rotors = standard.copy()
    without_rotors[-ns16.dof :] = 0.0
    rigid = rigid_bodies(ns16)
    q, qd, qdd = states(ns16)
    expected = rigid.torque(q, qd, qdd, rigid.projection @ without_rotors)
    torque = np.array([pin.rnea(read, data, *state) for state in zip(q, qd, qdd, strict=True)])
    np.testing.assert_allclose(torque, expected, atol=1e-7 * np.abs(expected).max())


def test_exports_the_table_of_a_model_without_physical_links(ns16, tmp_path):
    standard = bodies(ns16)
    standard[39] *= -1
    model_of(ns16, standard, known=True).save(tmp_path / "model.json")
    out = tmp_path / "out"
    found = CliRunner().invoke(app, ["export", str(tmp_path / "model.json"), "-o", str(out), "--for", "csv"])
    assert (found.exit_code, found.output) == (0, f"{out / 'parameters.csv'}\n")
    assert [path.name for path in out.iterdir()] == ["parameters.csv"]


def test_a_non_physical_fit_is_exported_as_the_nearest_physical_one(ns16: RobotDescription, tmp_path: Path):
    model = model_of(ns16, bodies(ns16), known=False)
    values = model.values.copy()
    rotor = model.names.index("J6")
    values[rotor] = -1e-4  # a little below zero, and known to much less
    deviations = np.full(len(values), 1e-3)
    deviations[rotor] = 1e-4
    impossible = replace(model, values=values, covariance=np.diag(deviations**2))
    impossible.save(tmp_path / "model.json")
    found, said = possible_model(impossible)
    check_physical(ns16, full_parameters(found))
    apart = np.abs(found.values - impossible.values) / deviations
    assert np.max(apart) == pytest.approx(apart[rotor]), "what has to move moves most"
    assert apart[rotor] < 2
    assert np.sum(apart**2) < 1.2 * (1e-4 / deviations[rotor]) ** 2 + 0.5, "no further than it has to"
    shown = CliRunner().invoke(app, ["export", str(tmp_path / "model.json"), "-o", str(tmp_path / "out")])
    assert shown.exit_code == 0, shown.output
    assert said.startswith("no bodies that could exist have exactly the parameters")
    assert said in shown.output
    assert (tmp_path / "out" / f"{ns16.name}.urdf").exists()
    assert possible_model(model) == (model, "")
