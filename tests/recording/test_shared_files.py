"""Files that other people's programs wrote give what is right (data beside the checkout)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages

from agent.core import InputError
from agent.estimation import estimate
from agent.motion import job_text, parse_program
from agent.motion.program import Move
from agent.recording import import_log, read_log
from agent.robot import load_robot

UR10 = load_robot(Path(__file__).resolve().parents[2] / "recipes/examples/ur10/robot.yaml")


@pytest.fixture
def files(shared_data) -> Path:
    return shared_data / "files-dev"


@pytest.fixture
def healthy(files) -> np.ndarray:
    return read_log(files / "lib/base1.mcap", UR10).position


@pytest.fixture
def imported(tmp_path: Path):
    def run(table: Path, mapping: str, robot=None):
        (tmp_path / "map.yaml").write_text(mapping)
        robot = robot or load_robot(table.parent / "robot.yaml")
        import_log(robot, tmp_path / "map.yaml", [table], tmp_path / "out.mcap")
        return read_log(tmp_path / "out.mcap", robot)

    return run


def test_every_log_of_the_other_simulation_is_read_whole(shared_data):
    robot = load_robot(shared_data / "gap-dev")
    paths = sorted((shared_data / "gap-dev").glob("**/*.mcap"))
    assert len(paths) > 10
    for path in paths:
        log = read_log(path, robot)
        assert log.joint_names == robot.joint_names
        assert (log.sample_rate, log.cycle_starts, log.repairs) == (500.0, (0.0, 10.0), ())
        assert log.segments == ((0, len(log.t)),)
        for values in (log.position, log.velocity, log.effort, log.reference_position, log.planned_position):
            assert np.isfinite(values).all()


def test_numbers_are_those_of_the_ros_reader(shared_data):
    path = shared_data / "gap-dev/case_02/logs/slow.mcap"
    log = read_log(path)
    states = [m.ros_msg for m in read_ros2_messages(str(path), topics=["/joint_states"])]
    for name in ("position", "velocity", "effort"):
        np.testing.assert_array_equal(getattr(log, name), [getattr(m, name) for m in states])
    first = states[0].header.stamp
    assert log.stamp == pytest.approx(first.sec + 1e-9 * first.nanosec)


@pytest.mark.parametrize("name", ["B_db3msg", "B_msgzstd", "B_msgzstd/B_msgzstd_0.mcap", "B_db3msg/B_db3msg_0.db3"])
def test_bags_compressed_by_message_are_read(files, healthy, name):
    log = read_log(files / "04-message-compressed-bag" / name, UR10)
    np.testing.assert_array_equal(log.position, healthy)
    assert log.effort is not None


def test_of_two_topics_one_is_named(files):
    path = files / "06-two-joint-state-topics/E2_two_topics.mcap"
    with pytest.raises(InputError, match=r"/left/joint_states \(shoulder_pan.*/right/joint_states.*--topic"):
        read_log(path, UR10)
    left, right = (read_log(path, UR10, f"/{side}/joint_states") for side in ("left", "right"))
    assert len(left.t) == len(right.t) == 2500
    assert np.abs(left.position - right.position).max() > 0.1


@pytest.mark.parametrize(
    ("table", "mapping", "effort"),
    [
        ("09-trailing-empty-columns/k_trail.csv", "k1.yaml", 0.99875),
        ("09-trailing-empty-columns/k_trail.csv", "k2.yaml", 0.99875),
        ("10-drive-trace-preamble/k_servo.csv", "k3.yaml", 0.149938),
        ("10-drive-trace-preamble/k_servo.csv", "k4.yaml", 0.149938),
    ],
)
def test_empty_columns_at_the_end_and_a_preamble_are_ignored(files, imported, table, mapping, effort):
    log = imported(files / table, (files / table).with_name(mapping).read_text(encoding="utf-8"))
    assert (len(log.t), log.t[1], log.position[1, 0], log.effort[1, 0]) == (200, 0.002, 0.033327, effort)


@pytest.mark.parametrize(("table", "rows"), [("c_secns.csv", 199), ("c_secns_long.csv", 2500)])
def test_seconds_and_nanoseconds_are_one_time(files, imported, table, rows):
    folder = files / "12-sec-and-nanosec"
    mapping = (folder / "c_secns.yaml").read_text(encoding="utf-8")
    log = imported(folder / table, mapping.replace("  column: sec\n  unit: s\n", "  columns: [sec, nanosec]\n"), UR10)
    assert len(log.t) == rows
    assert log.sample_rate == pytest.approx(125, rel=1e-6)
    with pytest.raises(InputError, match=r"whole seconds.*columns: \[sec, nanosec\]"):
        imported(folder / table, mapping, UR10)


def test_the_joint_without_torque_is_named(files):
    log = read_log(files / "14-one-joint-without-effort/H_one_nan.mcap", UR10)
    with pytest.raises(InputError, match=r"no torque \(effort\) of wrist_3_joint was recorded"):
        estimate(UR10, [log])


def test_an_arm_over_two_messages_is_joined(files, healthy):
    log = read_log(files / "15-arm-over-two-messages/X_half.mcap", UR10)
    assert len(log.t) == 2499
    np.testing.assert_allclose(log.position, healthy[1:], atol=1e-3)
    with pytest.raises(InputError, match=r"left_shoulder_pan_joint.*right_wrist_3_joint"):
        read_log(files / "15-arm-over-two-messages/E_two_prefix.mcap", UR10)


@pytest.mark.parametrize(("name", "said"), [("xacro", r"xacro xacro\.urdf > arm\.urdf"), ("sdf", "an SDF")])
def test_what_is_no_urdf_yet_is_named(files, name, said):
    with pytest.raises(InputError, match=said):
        load_robot(files / "18-xacro-and-sdf" / f"{name}.yaml")


@pytest.mark.parametrize(("name", "moves", "word", "count"), [("a", 5, "WITH", 2), ("c", 3, "$FLY_DIST", 1)])
def test_jobs_of_generators_are_read_for_their_moves(files, name, moves, word, count):
    robot = load_robot("comau_ns16")
    kept, passed = job_text((files / f"19-pdl2/{name}.pdl").read_text(encoding="utf-8"), name, robot)
    assert sum(isinstance(step, Move) for step in parse_program(kept, name, robot).run()) == moves
    assert passed[word] == count
