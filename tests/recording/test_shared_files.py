"""Small files from common tools are read correctly (data next to the checkout)."""

from pathlib import Path

import numpy as np
import pytest

from agent.core import InputError
from agent.estimation import estimate
from agent.motion.pdl2 import parse_program
from agent.motion.pdl2.reduced_job import job_text
from agent.motion.program import Move
from agent.recording import import_log, read_log
from agent.robot import load_robot

FILES = Path(__file__).resolve().parents[3] / "shared/data/files-dev"
UR10 = load_robot(Path(__file__).resolve().parents[2] / "recipes/examples/ur10/robot.yaml")
pytestmark = pytest.mark.skipif(not FILES.is_dir(), reason="the files are not here")


def _healthy() -> np.ndarray:
    return read_log(FILES / "lib/base1.mcap", UR10).position


@pytest.mark.parametrize("name", ["B_db3msg", "B_msgzstd", "B_msgzstd/B_msgzstd_0.mcap", "B_db3msg/B_db3msg_0.db3"])
def test_bags_compressed_by_message_are_read(name):
    log = read_log(FILES / "04-message-compressed-bag" / name, UR10)
    np.testing.assert_array_equal(log.position, _healthy())
    assert log.effort is not None


def test_asks_which_of_two_topics_to_read():
    path = FILES / "06-two-joint-state-topics/E2_two_topics.mcap"
    with pytest.raises(InputError, match=r"/left/joint_states \(shoulder_pan.*/right/joint_states.*--topic"):
        read_log(path, UR10)
    left, right = (read_log(path, UR10, f"/{side}/joint_states") for side in ("left", "right"))
    assert len(left.t) == len(right.t) == 2500
    assert np.abs(left.position - right.position).max() > 0.1


def _imported(folder: str, table: str, mapping: str | Path, tmp_path: Path, robot=None):
    if isinstance(mapping, str):
        (tmp_path / "map.yaml").write_text(mapping)
        mapping = tmp_path / "map.yaml"
    robot = robot or load_robot(FILES / folder / "robot.yaml")
    notes = import_log(robot, mapping, [FILES / folder / table], tmp_path / "out.mcap")
    return read_log(tmp_path / "out.mcap", robot), notes


@pytest.mark.parametrize("mapping", ["k1.yaml", "k2.yaml"])
def test_empty_columns_at_the_end_are_ignored(tmp_path, mapping):
    folder = "09-trailing-empty-columns"
    log, _ = _imported(folder, "k_trail.csv", FILES / folder / mapping, tmp_path)
    assert (len(log.t), log.position[1, 0], log.effort[1, 0]) == (200, 0.033327, 0.99875)


@pytest.mark.parametrize("mapping", ["k3.yaml", "k4.yaml"])
def test_a_preamble_is_not_the_table(tmp_path, mapping):
    folder = "10-drive-trace-preamble"
    log, _ = _imported(folder, "k_servo.csv", FILES / folder / mapping, tmp_path)
    assert (len(log.t), log.t[1], log.position[1, 0], log.effort[1, 0]) == (200, 0.002, 0.033327, 0.149938)


@pytest.mark.parametrize(("table", "rows"), [("c_secns.csv", 199), ("c_secns_long.csv", 2500)])
def test_seconds_and_nanoseconds_are_one_time(tmp_path, table, rows):
    folder = "12-sec-and-nanosec"
    mapping = (FILES / folder / "c_secns.yaml").read_text(encoding="utf-8")
    both = mapping.replace("  column: sec\n  unit: s\n", "  columns: [sec, nanosec]\n")
    log, _ = _imported(folder, table, both, tmp_path, UR10)
    assert len(log.t) == rows
    assert log.sample_rate == pytest.approx(125, rel=1e-6)
    with pytest.raises(InputError, match=r"whole seconds.*columns: \[sec, nanosec\]"):
        _imported(folder, table, mapping, tmp_path, UR10)


def test_the_joint_without_torque_is_named():
    log = read_log(FILES / "14-one-joint-without-effort/H_one_nan.mcap", UR10)
    with pytest.raises(InputError, match=r"no torque \(effort\) of wrist_3_joint was recorded"):
        estimate(UR10, [log])


def test_an_arm_over_two_messages_is_joined():
    log = read_log(FILES / "15-arm-over-two-messages/X_half.mcap", UR10)
    assert len(log.t) == 2499
    np.testing.assert_allclose(log.position, _healthy()[1:], atol=1e-3)
    with pytest.raises(InputError, match=r"left_shoulder_pan_joint.*right_wrist_3_joint"):
        read_log(FILES / "15-arm-over-two-messages/E_two_prefix.mcap", UR10)


@pytest.mark.parametrize(("name", "said"), [("xacro", "xacro xacro.urdf > arm.urdf"), ("sdf", "an SDF")])
def test_names_the_conversion_of_a_xacro_file(name, said):
    with pytest.raises(InputError, match=said.replace(".", r"\.")):
        load_robot(FILES / "18-xacro-and-sdf" / f"{name}.yaml")


@pytest.mark.parametrize(("name", "moves", "word", "count"), [("a", 5, "WITH", 2), ("c", 3, "$FLY_DIST", 1)])
def test_jobs_of_generators_are_read_for_their_moves(name, moves, word, count):
    robot = load_robot("comau_ns16")
    kept, passed = job_text((FILES / f"19-pdl2/{name}.pdl").read_text(encoding="utf-8"), name, robot)
    assert sum(isinstance(step, Move) for step in parse_program(kept, name, robot).run()) == moves
    assert passed[word] == count
