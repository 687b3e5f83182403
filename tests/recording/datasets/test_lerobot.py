"""LeRobot datasets: every episode, joints by name, units from the step of the values."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from agent.core import InputError
from agent.recording import read_log, read_recording
from agent.recording.mcap.log_file import write_log
from tests.recording.datasets.recordings import SO101, arm, motion, percent, ticks, write_lerobot

RANGES = (2549, 2303, 2205, 2287, 3835, 1484)
SHAPES = {
    "v2.1": {"motors": [f"main_{name}" for name in SO101]},
    "v3.0": [f"{name}.pos" for name in SO101],
    "v2.0": [[*SO101]],
}


def drawn(*seeds: int, joints: int = 6, rate: float = 30.0):
    return [motion(300, joints, rate, seed) for seed in seeds]


def in_degrees(values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.degrees(ticks(values[:, :-1])), percent(ticks(values), RANGES)[:, -1:]])


def in_percent(values: np.ndarray) -> np.ndarray:
    return percent(ticks(values), RANGES)


@pytest.mark.parametrize("version", SHAPES)
@pytest.mark.parametrize(("unit", "written"), [("deg", in_degrees), ("percent", in_percent)])
def test_reads_every_episode_by_the_names_of_its_joints(tmp_path: Path, version, unit, written):
    true = drawn(1, 2, 3)
    folder = write_lerobot(
        tmp_path / "set", [(written(q), written(r)) for q, r in true], names=SHAPES[version], version=version
    )
    order = [3, 0, 5, 1, 2, 4]
    logs, notes = read_recording(folder, arm([SO101[k] for k in order]))
    assert [log.name for log in logs] == ["episode_000000", "episode_000001", "episode_000002"]
    for log, (position, command) in zip(logs, true, strict=True):
        np.testing.assert_allclose(log.position, ticks(position)[:, order], atol=2e-5)
        np.testing.assert_allclose(log.reference_position, ticks(command)[:, order], atol=2e-5)
        np.testing.assert_allclose(log.t, np.arange(300) / 30, atol=1e-9)
        assert log.sample_rate == 30
        assert log.effort is None
        assert log.metadata["command_hold"] == "held"
        assert log.metadata["stamps"] == "frame_number"
        assert log.metadata["motion"] == log.name
        assert log.metadata["units"].startswith(unit)
    assert any(f"are in {unit}" in note for note in notes)


@pytest.mark.parametrize(("unit", "factor"), [("deg", 180 / np.pi), ("rad", 1.0)])
def test_an_encoder_that_is_finer_than_percent_of_a_turn_is_no_percent(tmp_path: Path, unit, factor):
    step = 2 * np.pi / 2**16
    true = [(np.round(q / step) * step, np.round(r / step) * step) for q, r in drawn(6)]
    written = [(factor * q, factor * r) for q, r in true]
    folder = write_lerobot(tmp_path / "set", written, robot_type="openarm_follower" if unit == "deg" else "other")
    (log,), _ = read_recording(folder, arm(SO101))
    np.testing.assert_allclose(log.position, true[0][0], atol=2e-5)
    assert log.metadata["units"].startswith(unit)


def test_what_a_recorder_does_is_kept_in_a_log(tmp_path: Path):
    folder = write_lerobot(tmp_path / "set", [(in_degrees(q), in_degrees(r)) for q, r in drawn(4)])
    (log,), _ = read_recording(folder, arm(SO101))
    write_log(tmp_path / "log.mcap", log)
    again = read_log(tmp_path / "log.mcap")
    assert {key: again.metadata[key] for key in ("motion", "command_hold", "stamps", "units")} == {
        key: log.metadata[key] for key in ("motion", "command_hold", "stamps", "units")
    }


def test_takes_rad_without_a_step_as_rad(tmp_path: Path):
    true = drawn(5, joints=3)
    folder = write_lerobot(tmp_path / "set", true, names=["joint_1", "joint_2", "joint_3"])
    (log,), notes = read_recording(folder, arm(["joint_1", "joint_2", "joint_3"]))
    np.testing.assert_allclose(log.position, true[0][0], atol=1e-6)
    assert "command_hold" not in log.metadata
    assert any("are in rad" in note for note in notes)


def test_a_dataset_of_two_arms_is_read_one_arm_at_a_time(tmp_path: Path):
    names = [f"{side}_{name}" for side in ("left", "right") for name in SO101]
    (left, right), (sent_left, sent_right) = zip(*drawn(6, 7), strict=True)
    states, actions = (np.hstack([*map(in_degrees, pair)]) for pair in ((left, right), (sent_left, sent_right)))
    folder = write_lerobot(tmp_path / "set", [(states, actions)], names=names)
    with pytest.raises(InputError, match="--topic left or --topic right"):
        read_recording(folder, arm(SO101))
    (log,), _ = read_recording(folder, arm(SO101), "right")
    np.testing.assert_allclose(log.position, ticks(right), atol=2e-5)
    (named,), _ = read_recording(folder, arm([f"left_{name}" for name in SO101]))
    np.testing.assert_allclose(named.position, ticks(left), atol=2e-5)


def test_short_episodes_and_other_columns_are_left_out(tmp_path: Path):
    (long,) = drawn(8)
    names = [*(f"arm_{name}.pos" for name in SO101), "x.vel"]
    whole = [np.column_stack([in_degrees(values), values[:, :1]]) for values in long]
    shorter = [[values[:frames] for values in whole] for frames in (3, 1)]
    folder = write_lerobot(tmp_path / "set", [whole, *shorter], names=names, version="v2.1")
    (log,), notes = read_recording(folder, arm(SO101))
    np.testing.assert_allclose(log.position, ticks(long[0]), atol=2e-5)
    assert "2 episodes of less than 10 frames left out" in notes


def test_a_gripper_that_stands_still_is_left_out(tmp_path: Path):
    (long,) = drawn(9)
    still = [np.column_stack([in_degrees(values)[:, :5], np.full(300, 20.0)]) for values in long]
    folder = write_lerobot(tmp_path / "set", [still])
    (log,), notes = read_recording(folder, arm(SO101[:5]))
    assert log.joint_names == SO101[:5]
    assert any(note.startswith("gripper is left out") for note in notes)


def test_missing_frames_are_a_gap(tmp_path: Path):
    (long,) = drawn(10)
    folder = write_lerobot(tmp_path / "set", [[in_degrees(values) for values in long]])
    file = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(pa.concat_tables([table.slice(0, 100), table.slice(140)]), file)
    (log,), _ = read_recording(folder, arm(SO101))
    assert log.segments == ((0, 100), (100, 260))
    assert log.t[100] == pytest.approx(140 / 30)


def test_names_in_a_mapping_to_their_numbers_are_taken_by_number(tmp_path: Path):
    (true,) = drawn(11)
    names = {name: SO101.index(name) for name in sorted(SO101)}
    folder = write_lerobot(tmp_path / "set", [[in_degrees(values) for values in true]], names=names)
    (log,), _ = read_recording(folder, arm(SO101))
    np.testing.assert_allclose(log.position, ticks(true[0]), atol=2e-5)


def test_names_in_a_list_for_each_arm_are_of_that_arm(tmp_path: Path):
    right, left = drawn(12, 13)
    both = [np.hstack([in_degrees(one), in_degrees(other)]) for one, other in zip(right, left, strict=True)]
    folder = write_lerobot(tmp_path / "set", [both], names={"right_arm": [*SO101], "left": [*SO101]})
    (log,), _ = read_recording(folder, arm(SO101), "left")
    np.testing.assert_allclose(log.position, ticks(left[0]), atol=2e-5)


@pytest.mark.parametrize(("unit", "seconds"), [(1, "float32"), (1e9, "int64")])
def test_timestamps_of_a_clock_count_where_they_differ_from_the_numbers_of_frames(tmp_path: Path, unit, seconds):
    (true,) = drawn(14, rate=20.0)
    folder = write_lerobot(tmp_path / "set", [[in_degrees(values) for values in true]], fps=30)
    clock = np.arange(300) / 20
    clock[100:] += 0.5
    file = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    stamps = pa.array((clock * unit).astype(seconds))
    parquet.write_table(table.set_column(table.schema.get_field_index("timestamp"), "timestamp", stamps), file)
    (log,), notes = read_recording(folder, arm(SO101))
    np.testing.assert_allclose(log.t, clock, atol=2e-6)
    assert log.segments == ((0, 100), (100, 300))
    assert log.sample_rate == pytest.approx(20, rel=1e-3)
    assert "stamps" not in log.metadata
    assert any("timestamps differ from frame_index at 30 Hz by up to 5.48 s" in note for note in notes)


def test_a_frame_without_a_number_is_dropped(tmp_path: Path):
    (true,) = drawn(15)
    states, actions = map(in_degrees, true)
    states[50, 2] = np.nan
    (log,), _ = read_recording(write_lerobot(tmp_path / "set", [(states, actions)]), arm(SO101))
    np.testing.assert_allclose(log.reference_position, np.delete(ticks(true[1]), 50, 0), atol=2e-5)


def test_joints_counted_from_0_are_none_of_joints_counted_from_1(tmp_path: Path):
    from_0, from_1 = ([f"joint_{k + start}" for k in range(7 - start)] for start in (0, 1))
    folder = write_lerobot(tmp_path / "set", drawn(16, joints=7), names=from_0)
    with pytest.raises(InputError, match=r"its joints are joint_0, .*those of arm are joint_1, "):
        read_recording(folder, arm(from_1))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda q: np.hstack([q, q[:, :1]]), "has 7 columns of numbers, and meta/info.json names 6"),
        (lambda q: np.round(np.degrees(q), 1), "unit of the positions cannot be told: they go to 63, and their steps"),
        (lambda q: np.degrees(q / 20), "j0 goes from .*, its range from -1 to 1 .*further than the range is wide"),
    ],
)
def test_numbers_that_are_not_what_the_names_or_the_arm_say_are_refused(tmp_path: Path, change, reason):
    (true,) = drawn(17)
    names = [f"j{k}" for k in range(6)]
    narrow = arm(names)
    narrow = replace(narrow, joints=tuple(replace(joint, lower=-1.0, upper=1.0) for joint in narrow.joints))
    folder = write_lerobot(tmp_path / "set", [[change(values) for values in true]], names=names)
    with pytest.raises(InputError, match=reason):
        read_recording(folder, narrow)


@pytest.mark.parametrize(("largest", "said"), [(1.0, True), (0.98, False), (1.02, False)])
def test_commands_that_look_normalised_are_said(tmp_path: Path, largest, said):
    ((states, actions),) = drawn(19)
    path = tmp_path / "log.csv"
    scale = largest / np.abs(actions[:, :2]).max(axis=0)
    rows = np.column_stack([np.arange(len(states)) / 30, 0.9 * scale * states[:, :2], scale * actions[:, :2]])
    np.savetxt(path, rows, "%.7g", ",", header="time,q1,q2,cmd1,cmd2", comments="")
    _, notes = read_recording(path, arm(SO101[:2]))
    assert any("look normalised" in note for note in notes) == said


def test_joints_that_leave_the_ranges_of_the_arm_are_said(tmp_path: Path):
    folder = write_lerobot(tmp_path / "set", [[in_degrees(values) for values in drawn(18)[0]]])
    tight = arm(SO101)
    tight = replace(tight, joints=tuple(replace(joint, upper=1.0) for joint in tight.joints))
    _, notes = read_recording(folder, tight)
    assert any("zero or sign may not be those of the model: shoulder_pan goes from" in note for note in notes)
