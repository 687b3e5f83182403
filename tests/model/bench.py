"""Small simulators of others, and logs of what they predict."""

from pathlib import Path

import numpy as np
import pytest

from agent.model.identified_model import IdentifiedModel
from agent.recording.mcap.log_file import STATES, LogFile

NAMES = ("pan", "lift", "slide")
RATE = 125.0
MJCF = """<mujoco model="bench">
  <compiler angle="degree"/>
  <option gravity="0.3 0 -9.7" density="1.2"/>
  <worldbody>
    <body name="table" pos="1 0 0"><geom type="box" size=".1 .1 .1"/></body>
    <body name="cup" pos="1 0 1"><freejoint/><inertial pos="0 0 0" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/></body>
    <body name="stand" euler="0 10 0" pos="0 0 0.2">
      <body name="turret" pos="0 0 0.1">
        <joint name="pan" axis="0 0 1" range="-170 170" armature="0.4" damping="3" frictionloss="2"/>
        <inertial pos="0.02 0.01 0.1" mass="6" fullinertia="0.08 0.07 0.05 0.004 0.002 0.001"/>
        <body name="boom" pos="0.1 0 0.2" euler="0 0 30">
          <joint name="lift" axis="0 1 0" pos="0 0 0.05" ref="20" armature="0.2" damping="1.5" frictionloss="1"
                 stiffness="12" springref="-15"/>
          <inertial pos="0.2 0 0" mass="4" diaginertia="0.02 0.06 0.07"/>
          <body name="counterweight" pos="-0.1 0 0" euler="20 0 0">
            <inertial pos="0 0 0.03" mass="1.5" diaginertia="0.003 0.002 0.001"/>
          </body>
          <body name="ram" pos="0.4 0 0">
            <joint name="slide" type="slide" axis="1 0 0.2" damping="20" frictionloss="5" armature="1"/>
            <inertial pos="0.1 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
            <body name="finger" pos="0.2 0.02 0">
              <joint name="finger" type="slide" axis="0 1 0"/>
              <inertial pos="0 0.01 0" mass="0.3" diaginertia="1e-4 1e-4 1e-4"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality/>
  <actuator><position joint="pan" kp="100"/></actuator>
</mujoco>
"""
URDF = """<robot name="bench"><link name="base"/>
<link name="a"><inertial><origin xyz="0.1 0 0"/><mass value="5"/>
<inertia ixx="0.05" iyy="0.06" izz="0.07" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="pan" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="3" effort="100"/><dynamics damping="1.5" friction="0.5"/></joint>
<link name="b"><inertial><origin xyz="0.2 0 0"/><mass value="3"/>
<inertia ixx="0.03" iyy="0.04" izz="0.05" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="lift" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.3 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="3" effort="100"/></joint></robot>
"""
ROBOT = """name: bench
urdf: arm.urdf
tip_frame: b
joints:
  - {name: pan, gear_ratio: 50, nominal_motor_torque: 0.5, max_velocity: 3, max_acceleration: 10}
  - {name: lift, gear_ratio: 80, nominal_motor_torque: 0.4, max_velocity: 3, max_acceleration: 10}
"""
BODY = '<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>'
CHAIN = (
    f'<body name="a"><joint name="pan" axis="0 0 1"/>{BODY}<body name="b" pos="0.3 0 0">'
    f'<joint name="lift" axis="0 1 0"/>{BODY}</body></body>'
)


def scene(bodies: str, more: str = "") -> str:
    return f"<mujoco><worldbody>{bodies}</worldbody>{more}</mujoco>"


def written(folder: Path, text: str, name: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def states(n: int, samples: int = 25) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return tuple(np.random.default_rng(1).uniform(-1, 1, (3, samples, n)))


def mujoco_torque(path: Path, names, q, qd, qdd) -> np.ndarray:
    """Of MuJoCo's inverse dynamics, joints found by name; friction is the sign of speed, the other joints stand."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.density = 0
    data = mujoco.MjData(model)
    at = [model.joint(name).qposadr[0] for name in names]
    dof = [model.joint(name).dofadr[0] for name in names]
    torque = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = model.qpos0, 0, 0
        data.qpos[at], data.qvel[dof], data.qacc[dof] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse[dof]
    return torque + np.sign(qd) * model.dof_frictionloss[dof]


def recorded(path: Path, model: IdentifiedModel, phase: float, added=lambda qd: 0 * qd) -> Path:
    """A log of what a model predicts, and something more, on 16 s of sines."""
    time = np.arange(int(16 * RATE)) / RATE
    n = model.robot.dof
    rates = np.array([[0.9, 2.3], [1.3, 2.9], [1.1, 3.1]])[:n]
    q, qd, qdd = np.zeros((3, len(time), n))
    for part, size in enumerate((0.6, 0.25)):
        w = rates[:, part]
        angle = np.outer(time, w) + phase * (1 + part) + np.arange(n)
        q, qd, qdd = q + size * np.sin(angle), qd + size * w * np.cos(angle), qdd - size * w**2 * np.sin(angle)
    torque = model.predict(q, qd, qdd, time) + added(qd)
    torque = torque + 0.005 * np.std(torque, axis=0) * np.random.default_rng(3).normal(size=torque.shape)
    file = LogFile(path, model.robot.joint_names, model.robot.name, "x", RATE)
    file.write_states(STATES, 100 + time, q, qd, torque)
    file.finish()
    file.close()
    return path
