"""Measured position-controlled servos whose torque nobody knows: the gap in motion shrinks on motion held out."""

from dataclasses import replace

import numpy as np
import pytest

from agent.core.console import Console
from agent.pipeline.gap.diagnose import GapQuestion, diagnose_files
from agent.recording import read_log
from agent.recording.mcap.log_file import write_log

mujoco = pytest.importorskip("mujoco")
pytestmark = pytest.mark.verify
PENDULUM = """<mujoco><worldbody><body>
  <joint name="joint_1" axis="0 1 0" armature="0.004" damping="0.01" frictionloss="0.02"/>
  <inertial pos="0 0 -0.1" mass="0.49" diaginertia="2e-4 2e-4 2e-4"/></body></worldbody>
  <actuator><position joint="joint_1" kp="1.0766" forcerange="-0.93 0.93"/></actuator></mujoco>
"""


def drifts(folder, model, logs, measured, what, factor):
    """Diagnose logs without their torque, and note the position error of the worst joint after 1 s."""
    bare = [folder / log.name for log in logs]
    for path, log in zip(bare, map(read_log, logs), strict=True):
        write_log(path, replace(log, effort=None))
    result = diagnose_files(None, bare, GapQuestion(model), Console(-1))
    assert result["torque_of"] == "servos"
    at = result["forward"]["horizon_s"].index(1.0)
    before, after = (float(np.max(result["forward"][side][at])) for side in ("before", "after"))
    figure = f"{before:.3g} rad, corrected {after:.3g}"
    measured(f"{what}, no torque: drift after 1 s", figure, "", f"{factor} times", after < factor * before)
    assert after < factor * before
    return result


def test_diagnoses_a_servo_with_a_pendulum(shared_data, tmp_path, measured):
    model = tmp_path / "pendulum.xml"
    model.write_text(PENDULUM, encoding="utf-8")
    source = shared_data / "real-dev/bam_xl330"
    logs = [source / f"kp400_{name}.mcap" for name in ("sin_sin", "sin_time_square", "up_and_down")]
    drifts(tmp_path, model, logs, measured, "XL330 with a pendulum", 0.8)


def test_diagnoses_an_so101_arm(shared_data, tmp_path, measured):
    source = shared_data / "real-dev/so101"
    spec = mujoco.MjSpec.from_file(str(source / "so101.urdf"))
    for joint in spec.joints:
        joint.damping, joint.armature, joint.frictionloss = (0.6 * np.eye(len(joint.damping))[0], 0.028, 0.052)
        servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=17.8)
        servo.forcerange, servo.forcelimited = (-3.35, 3.35), True
    spec.compile()
    (tmp_path / "so101.xml").write_text(spec.to_xml(), encoding="utf-8")
    logs = [source / f"{name}.mcap" for name in ("custom_motion", "multisine", "friction_gravity")]
    drifts(tmp_path, tmp_path / "so101.xml", logs, measured, "SO-101", 0.8)
