"""A minute of set-points for an arm under position servos: inside its limits, with what tells its numbers apart."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core import InputError
from agent.excitation import plan_set_points
from agent.excitation.set_point_plan import CHIRP, REVERSALS, STEPS, SetPointLimits, excitation
from agent.recording.tables.table_files import read_table
from agent.simulators import load_arm, load_simulator

pytest.importorskip("mujoco")
RATE = 100.0
ARM = """<mujoco model="hobby"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
  <default><joint armature="0.03" damping="0.3" frictionloss="0.05"/>
    <position kp="20" kv="0.5" forcerange="-3 3"/></default>
  <worldbody>{floor}<body name="upper"><joint name="lift" axis="0 1 0" range="-1.8 1.2"/>
    <inertial pos="0.12 0 0" mass="0.25" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="fore" pos="0.2 0 0"><joint name="gripper" axis="0 1 0" range="0 1.6"/>
      <inertial pos="0.1 0 0" mass="0.15" diaginertia="5e-4 5e-4 5e-4"/>
      <geom name="tip" size="0.02" pos="0.2 0 0"/></body></body></worldbody>
  <actuator><position joint="lift"/><position joint="gripper"/></actuator></mujoco>
"""
FLOOR = '<geom type="plane" size="1 1 0.1" pos="0 0 {height}"/>'


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.xml"
    path.write_text(text, encoding="utf-8")
    return path


def arm_of(path: Path):
    return load_simulator(path, None, load_arm(path).joint_names)


@given(
    low=st.lists(st.floats(-3, -0.2), min_size=1, max_size=7),
    speed=st.floats(0.05, 2.0),
    place=st.floats(0.1, 0.9),
    share=st.floats(0.1, 1.0),
)
@settings(max_examples=25, deadline=None)
def test_set_points_keep_ranges_and_speeds_and_end_where_they_start(low, speed, place, share):
    low = np.array(low)
    high = low + 0.3 + np.abs(low)
    limits = SetPointLimits(low, high, low + place * (high - low), np.full(len(low), speed))
    for motion in excitation(limits, RATE, share):
        assert np.all(motion.set_points >= limits.low - 1e-9)
        assert np.all(motion.set_points <= limits.high + 1e-9)
        fastest = np.abs(np.diff(motion.set_points, axis=0)).max(axis=0) * RATE
        assert np.all(fastest <= 1.6 * speed + 0.21)  # parts that add up; reversals take 0.2 rad/s whatever the speed
        np.testing.assert_allclose(motion.set_points[[0, -1]], np.stack([limits.start] * 2), atol=1e-9)
        turns = np.diff(np.sign(np.diff(motion.set_points, axis=0)), axis=0) != 0
        assert np.all(turns.sum(axis=0) >= 8)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return plan_set_points(arm_of(written(tmp_path_factory.mktemp("arm"), ARM.format(floor=""))), RATE)


def test_both_motions_have_every_kind_and_go_different_ways(whole):
    plan = whole
    first, second = plan.motions
    assert first.kinds == second.kinds == (STEPS, CHIRP, REVERSALS)
    away = [motion.set_points - plan.limits.start for motion in plan.motions]
    assert np.all(np.sum(away[0][:1000] * away[1][:1000], axis=0) < 0)
    assert sum(motion.time[-1] for motion in plan.motions) == pytest.approx(60, abs=0.1)
    assert np.all(plan.torque < 1)


def test_a_motion_gets_smaller_until_nothing_touches(whole, tmp_path):
    lowest = whole.limits.start  # ground a little below the lowest point of small motions only
    tip = -0.2 * np.sin(-lowest[0]) - 0.2 * np.sin(-lowest[0] - lowest[1])
    near = FLOOR.format(height=round(-abs(tip) - 0.13, 3))
    small = plan_set_points(arm_of(written(tmp_path, ARM.format(floor=near))), RATE)
    assert small.share < whole.share
    touching = FLOOR.format(height=round(-abs(tip) - 0.021, 3))
    with pytest.raises(InputError, match="touches"):
        plan_set_points(arm_of(written(tmp_path, ARM.format(floor=touching))), RATE)


def test_the_command_writes_tables_and_a_dataset_to_replay(tmp_path):
    path = written(tmp_path, ARM.format(floor=""))
    found = CliRunner().invoke(app, ["plan", str(path), "-o", str(tmp_path / "plan"), "--json"])
    assert found.exit_code == 0, found.output
    plan = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert plan["joints"].keys() == {"lift", "gripper"}
    table = read_table(tmp_path / "plan" / "motion_1.csv")
    frames = read_table(tmp_path / "plan" / "lerobot" / "data" / "chunk-000" / "file-000.parquet")
    info = json.loads((tmp_path / "plan" / "lerobot" / "meta" / "info.json").read_text())
    assert info["features"]["action"]["names"] == ["lift.pos", "gripper.pos"]
    lift, gripper = (frames.columns[name] for name in frames.matrix("action"))
    first = frames.columns["episode_index"] == 0
    at = frames.columns["timestamp"][first]
    np.testing.assert_allclose(
        np.radians(lift[first]), np.interp(at, table.columns["time"], table.columns["lift"]), atol=0.04
    )
    np.testing.assert_allclose(
        gripper[first] * 0.016, np.interp(at, table.columns["time"], table.columns["gripper"]), atol=0.04
    )
    again = CliRunner().invoke(app, ["plan", str(path), "-o", str(tmp_path / "plan")])
    assert isinstance(again.exception, InputError)
    assert "holds a plan already" in str(again.exception)


def test_an_arm_without_servos_is_refused(tmp_path):
    bare = ARM.format(floor="").replace('<position joint="lift"/>', '<motor joint="lift"/>')
    found = CliRunner().invoke(app, ["plan", str(written(tmp_path, bare)), "-o", str(tmp_path / "plan")])
    assert isinstance(found.exception, InputError)
    assert "position actuator" in str(found.exception)
