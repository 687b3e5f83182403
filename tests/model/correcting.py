"""A small arm as both files, written back corrected."""

import functools
import tempfile
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.model.rigid_friction import ModelEffect
from agent.simulators import FittedChange, Released, correct, load_simulator
from tests.model.bench import written

NAMES = ("pan", "lift", "turn")
PATHS = ("mjcf", "urdf")
RATE = 500.0
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


def simulator(folder: Path, kind: str):
    """What `kind` of file describes, in a folder; it is read once only."""
    path = _arm_file(folder, kind)
    given = _read(kind)
    return replace(given, arm=replace(given.arm, path=path))


def _arm_file(folder: Path, kind: str) -> Path:
    if kind == "urdf":
        return written(folder, URDF, "arm.urdf")
    pytest.importorskip("mujoco")
    written(folder, BOOM, "boom.xml")
    return written(folder, MJCF, "arm.xml")


@functools.cache
def _read(kind: str):
    with tempfile.TemporaryDirectory() as folder:
        return load_simulator(_arm_file(Path(folder), kind), None, NAMES)


def corrected(given, effects=(), links=(), rotors=(), friction=(), change=None, unexplained=1.0):
    released = Released(*({k: "because" for k in joints} for joints in (links, rotors, friction)))
    change = np.zeros(len(given.model.values)) if change is None else change
    weight = 1e4 * np.eye(len(given.model.independent))
    return correct(given, FittedChange(change, weight, unexplained, np.ones(3)), effects, released, {})


def motion(seconds: float = 0.6):
    """(S, 3) smooth motion that turns back."""
    time = np.arange(int(seconds * RATE)) / RATE
    w, phase = np.array([5.0, 7.0, 11.0]), np.array([0.3, 1.0, 2.0])
    angle = np.outer(time, w) + phase
    return time, 0.5 * np.sin(angle), 0.5 * w * np.cos(angle), -0.5 * w**2 * np.sin(angle)


def torque_of_file(path: Path, module, q, qd, qdd):
    """(S, 3) of MuJoCo, or of Pinocchio, from the file and the effects, and of the bodies alone what these need."""
    model = _bodies(path)
    masses = np.array([model.rigid.dynamics.mass_matrix(row) for row in q])
    slopes = model.rigid.dynamics.torque_slope(q, qd, qdd)
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
    added = np.array([effects.torque(*row) for row in zip(q, qd, qdd, load, masses, slopes, strict=True)])
    total = plain + friction * np.tanh(qd / module.REVERSAL) + added
    return np.array([effects.reading(row) for row in total])


@functools.cache
def _model_of(files: tuple[tuple[str, str], ...], name: str):
    with tempfile.TemporaryDirectory() as folder:
        for other, content in files:
            written(Path(folder), content, other)
        return load_simulator(Path(folder) / name, None, NAMES).model


def _bodies(path: Path):
    """The model in a file, for mass matrices only; files of the same content are read once."""
    files = sorted(path.parent.glob(f"*{path.suffix}"))
    return _model_of(tuple((one.name, one.read_text(encoding="utf-8")) for one in files), path.name)


def entry(effect, *joints, **parameters):
    return ModelEffect(effect, joints, {name: float(value) for name, value in parameters.items()})


def moved(given, links=(), rotors=()):
    """A change of the model's parameters that makes links heavier by a third and rotors by a tenth of their joint's."""
    model = given.model
    standard = np.zeros(len(model.standard))
    for k in links:
        standard[10 * k : 10 * k + 10] = model.standard[10 * k : 10 * k + 10] / 3
    for k in rotors:
        standard[30 + k] = 0.05
    return np.append(model.projection @ standard, [0.3, 0.2] * 3)
