"""Recordings of a robot maker's own recorders, whose columns are known."""

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from agent.core import InputError
from agent.recording import import_log, read_log
from agent.robot import RobotDescription, load_robot

EXAMPLES = Path(__file__).resolve().parents[2] / "recipes/examples"
RECORDINGS = Path(__file__).resolve().parents[3] / "shared/data/ur-recordings"
WITH_CONSTANTS, WITHOUT = EXAMPLES / "ur10e/robot.yaml", EXAMPLES / "ur10/robot.yaml"
T = 812.004 + np.arange(500) * 0.002
Q = np.column_stack([0.3 * (k + 1) * np.sin(2 * (T - T[0]) + k) for k in range(6)])
CURRENT = np.column_stack([np.cos((k + 1) * (T - T[0])) for k in range(6)])


def _write(
    path: Path, separator: str, state: np.ndarray, left_out: str = "", repeats: bool = False, **more: np.ndarray
) -> Path:
    names, columns = ["timestamp"], [T]
    own = {"target_q": Q + 0.01, "actual_q": Q, "actual_qd": Q, "actual_current": CURRENT, **more}
    for name, values in own.items():
        if name != left_out:
            names += [f"{name}_{k}" for k in range(6)]
            columns += [*values.T]
    if left_out != "runtime_state":
        names.append("runtime_state")
        columns.append(state)
    rows = [separator.join(f"{value:.6f}" for value in row) for row in np.column_stack(columns)]
    if repeats:
        rows = [line for k, row in enumerate(rows) for line in [row] * (1 + (k % 5 == 0))]
    end = "\r\n" if separator == " " else "\n"
    path.write_bytes((separator.join(names) + end + end.join(rows) + end).encode())
    return path


def _topics(path: Path) -> dict[str, int]:
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    counts = summary.statistics.channel_message_counts
    return {channel.topic: counts[number] for number, channel in summary.channels.items() if number in counts}


@pytest.fixture
def taken(tmp_path: Path):
    def run(table: Path, robot: Path = WITH_CONSTANTS, preset: str = "ur-rtde"):
        description: RobotDescription = load_robot(robot)
        notes = import_log(description, preset, [table], tmp_path / "out.mcap")
        return read_log(tmp_path / "out.mcap", description), "\n".join(notes), _topics(tmp_path / "out.mcap")

    return run


@pytest.mark.parametrize("robot", [WITH_CONSTANTS, WITHOUT])
def test_constants_of_the_recording_win_over_those_of_the_description(taken, tmp_path, robot):
    """Those of a wrist by 2.1; of a joint without proportion, that of the description."""
    own = np.array([11.976, 11.976, 9.839, 10.764, 10.764, 22.6])
    moment = CURRENT * own
    if robot == WITH_CONSTANTS:
        moment = np.column_stack([moment[:, :4], Q[:, 4], moment[:, 5]])
    table = _write(tmp_path / "rec.csv", ",", np.full(500, 2), target_current=CURRENT, target_moment=moment)
    log, notes, _ = taken(table, robot)
    gears = load_robot(robot).gear_ratios
    np.testing.assert_allclose(log.effort, CURRENT * own, rtol=1e-4, atol=1e-3 * np.abs(gears).max())
    said = "torque constants [N·m/A] by target_moment over target_current of this file"
    assert (said in notes) == (robot == WITH_CONSTANTS)
    if robot == WITH_CONSTANTS:
        assert notes.partition(said)[2].splitlines()[0].endswith("description: joint_6 22.6 instead of 10.8")


RUNNING = np.where((np.arange(500) >= 100) & (np.arange(500) < 400), 2, 1)


@pytest.mark.parametrize(("preset", "separator"), [("ur-rtde", ","), ("ur-record", " ")])
def test_imports_the_running_program_with_torque_from_currents(taken, tmp_path, preset, separator):
    table = _write(tmp_path / "rec.csv", separator, RUNNING)
    log, notes, topics = taken(table, preset=preset)
    np.testing.assert_allclose(log.position, Q[100:400], atol=1e-6)
    np.testing.assert_allclose(log.reference_position, Q[100:400] + 0.01, atol=1e-6)
    constants = [joint.torque_constant for joint in load_robot(WITH_CONSTANTS).joints]
    np.testing.assert_allclose(log.effort, CURRENT[100:400] * constants, atol=1e-4)
    assert log.sample_rate == pytest.approx(500)
    assert topics["/motor_currents"] == 300
    assert "300 of 500 rows have runtime_state 2" in notes
    assert "torque constants 11.976, 11.976, 9.839, 10.764, 10.764, 10.764" in notes


@pytest.mark.parametrize("between", [b" ", b","])
def test_imports_a_binary_recording(taken, tmp_path, between):
    parts = [("timestamp", ">f8", T), ("actual_q", "(6,)>f8", Q), ("actual_current", "(6,)>f8", CURRENT)]
    parts += [("runtime_state", ">u4", RUNNING), ("safety_mode", ">i4", RUNNING)]
    rows = np.empty(500, [(name, kind) for name, kind, _ in parts])
    for name, _, values in parts:
        rows[name] = values
    kinds = [b"DOUBLE", b"VECTOR6D", b"VECTOR6D", b"UINT32", b"INT32"]
    names = between.join(name.encode() for name, *_ in parts)
    (tmp_path / "rec.csv").write_bytes(names + b"\n" + between.join(kinds) + b"\n" + rows.tobytes() + b"torn")
    log, _, topics = taken(tmp_path / "rec.csv", preset="ur-record")
    np.testing.assert_array_equal(log.position, Q[100:400])
    assert topics["/motor_currents"] == 300


def test_rows_that_repeat_a_time_are_dropped_and_the_column_says_when(taken, tmp_path):
    log, notes, _ = taken(_write(tmp_path / "rec.csv", ",", RUNNING, repeats=True))
    np.testing.assert_allclose(log.t, T[100:400] - T[100], atol=1e-6)
    assert "60 rows with the time of the row before, dropped" in notes


def test_without_torque_constants_the_currents_are_kept(taken, tmp_path):
    log, notes, topics = taken(_write(tmp_path / "rec.csv", ",", RUNNING), WITHOUT)
    assert log.effort is None
    assert topics["/motor_currents"] == topics["/joint_states"] == 300
    assert "currents are kept on /motor_currents; torques need the torque_constant of shoulder_pan_joint" in notes


def test_without_a_running_program_all_rows_are_taken(taken, tmp_path):
    for table in (
        _write(tmp_path / "a.csv", ",", np.ones(500)),
        _write(tmp_path / "b.csv", ",", RUNNING, "runtime_state"),
    ):
        log, notes, _ = taken(table)
        assert len(log.t) == 500
        assert "no row has runtime_state 2 (a program runs), so all rows are taken" in notes


@pytest.mark.parametrize("left_out", ["target_q", "actual_qd", "actual_current"])
def test_a_recording_may_have_fewer_columns(taken, tmp_path, left_out):
    log, notes, _ = taken(_write(tmp_path / "rec.csv", ",", RUNNING, left_out))
    np.testing.assert_allclose(log.position, Q[100:400], atol=1e-6)
    assert f"no {left_out}_0 and its like" in notes


def test_what_is_missing_or_unknown_is_named(taken, tmp_path):
    with pytest.raises(InputError, match="has no column actual_q_0"):
        taken(_write(tmp_path / "rec.csv", ",", RUNNING, "actual_q"))
    with pytest.raises(InputError, match="--preset 'other' is not known; there are ur-rtde, ur-record"):
        taken(_write(tmp_path / "rec.csv", ",", RUNNING), preset="other")


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the recordings are not here")
@pytest.mark.parametrize(
    ("name", "preset", "rows"), [("official_record", "ur-record", 299), ("ur_rtde", "ur-rtde", 130)]
)
def test_imports_files_of_the_original_recorders(taken, name, preset, rows):
    log, notes, topics = taken(RECORDINGS / f"{name}.csv", preset=preset)
    assert len(log.t) == topics["/motor_currents"] == rows
    assert ("15 rows with the time of the row before" in notes) == (name == "ur_rtde")
    np.testing.assert_allclose(log.position, np.tile([0.1, -1.5, 1.5, -1.5, -1.5, 0.0], (rows, 1)))
