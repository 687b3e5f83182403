"""Tables become logs by mapping files; the examples for measured data give what direct computation gives."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from agent.core.errors import InputError
from agent.recording import import_log, named_joints, read_log
from agent.robot import load_robot

EXAMPLES = Path(__file__).resolve().parents[2] / "recipes/examples"

ROBOT = """
name: pair
urdf: pair.urdf
tip_frame: tip
joints:
  - {name: turn, gear_ratio: -50, max_velocity: 2, max_acceleration: 5, torque_constant: 0.5}
  - {name: slide, gear_ratio: 200, max_velocity: 1, max_acceleration: 5, torque_constant: 0.1}
motor_coupling: [[1, 0], [0.25, 1]]
"""
URDF = """<robot name="pair"><link name="base"/><link name="middle"/><link name="tip"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="middle"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3" velocity="2" effort="9"/></joint>
<joint name="slide" type="prismatic"><parent link="middle"/><child link="tip"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="9"/></joint></robot>"""


@pytest.fixture
def pair(tmp_path):
    """A turning joint and a slide behind coupled motors."""
    (tmp_path / "robot.yaml").write_text(ROBOT)
    (tmp_path / "pair.urdf").write_text(URDF)
    return load_robot(tmp_path / "robot.yaml")


@pytest.fixture
def convert(pair, tmp_path):
    """Import a table by the text of a mapping; returns the log that is read back, and the notes."""

    def run(mapping: str, *inputs: Path, robot=pair):
        (tmp_path / "map.yaml").write_text(mapping)
        notes = import_log(robot, tmp_path / "map.yaml", inputs, tmp_path / "out.mcap")
        return read_log(tmp_path / "out.mcap", robot), notes

    return run


@pytest.fixture
def table(tmp_path):
    """A CSV file with time, two positions, two velocities, two efforts; and its content (S, 7)."""
    t = np.arange(400) / 200
    values = np.column_stack([t, *(np.sin(t * k) * k for k in range(1, 7))])
    path = tmp_path / "data.csv"
    np.savetxt(path, values, delimiter=",", header="time,q1,q2,v1,v2,e1,e2", comments="", fmt="%.17g")
    return path, values


JOINT_SIDE = "time: {column: time}\nposition: {columns: [q1, q2]}\n"


def test_joint_side_columns_are_imported_unchanged(convert, table):
    path, values = table
    log, notes = convert(JOINT_SIDE + "velocity: {columns: [v1, v2]}\neffort: {columns: [e1, e2]}\n", path)
    np.testing.assert_array_equal(log.position, values[:, 1:3])
    np.testing.assert_array_equal(log.velocity, values[:, 3:5])
    np.testing.assert_array_equal(log.effort, values[:, 5:7])
    np.testing.assert_allclose(log.t, values[:, 0], atol=1e-9)
    assert log.sample_rate == pytest.approx(200)
    assert log.metadata["robot"] == "pair"
    assert notes == (
        *(f"out.mcap: {key}: turn from {x}1, slide from {x}2" for key, x in [("position", "q"), ("velocity", "v")]),
        "out.mcap: effort: turn from e1, slide from e2",
        "out.mcap: 400 samples, 1.995 s at 200 Hz",
    )


def test_applies_units_scales_and_offsets(convert, table):
    path, values = table
    log, _ = convert(
        "time: {column: time, unit: min}\n"
        "position: {columns: [q1, q2], unit: [deg, mm], scale: [2, -1], offset: [90 deg, 10 mm]}\n"
        "velocity: {columns: [v1, v2], unit: [rpm, m/min]}\n"
        "effort: {columns: [6, 7], unit: [Nm, kN]}\n",
        path,
    )
    q = values[:, 1:3] * [2 * np.pi / 180, -1e-3] + [np.pi / 2, 0.01]
    np.testing.assert_allclose(log.position, q, rtol=1e-14)
    np.testing.assert_allclose(log.velocity, values[:, 3:5] * [np.pi / 30, 1 / 60], rtol=1e-14)
    np.testing.assert_allclose(log.effort, values[:, 5:7] * [1, 1000], rtol=1e-14)
    assert log.sample_rate == pytest.approx(200 / 60)
    with pytest.raises(InputError, match=r"time.unit: rows are 5e-06 s apart .* too near for an arm: is ms right"):
        convert("time: {column: time, unit: ms}\nposition: {columns: [q1, q2]}\n", path)


def test_converts_motor_side_columns_by_gears_and_coupling(convert, table):
    path, values = table
    log, _ = convert(
        "time: {column: time}\nside: motor\nposition: {columns: [q1, q2]}\nvelocity: {columns: [v1, v2], unit: rpm}\n"
        "effort: {columns: [e1, e2], unit: A}\nreference_position: {columns: [q1, q2]}\n",
        path,
    )
    ratio = np.diag([-50.0, 200.0]) @ np.array([[1.0, 0.0], [0.25, 1.0]])  # joint speed to motor speed
    np.testing.assert_allclose(log.position @ ratio.T, values[:, 1:3], atol=1e-12)
    np.testing.assert_allclose(log.velocity @ ratio.T, values[:, 3:5] * np.pi / 30, atol=1e-12)
    np.testing.assert_allclose(log.reference_position @ ratio.T, values[:, 1:3], atol=1e-12)
    motor_torque = values[:, 5:7] * [0.5, 0.1]
    np.testing.assert_allclose(log.effort, motor_torque @ ratio, atol=1e-12)
    # the power is the same on both sides
    np.testing.assert_allclose(
        np.sum(log.effort * log.velocity, axis=1), np.sum(motor_torque * values[:, 3:5] * np.pi / 30, axis=1), atol=1e-9
    )


def test_imports_currents_with_joint_positions(convert, table):
    path, values = table
    log, _ = convert(JOINT_SIDE + "effort: {columns: [e1, e2], unit: mA, torque_constant: 2}\n", path)
    np.testing.assert_array_equal(log.position, values[:, 1:3])
    torque = values[:, 5:7] * 2e-3 * [-50, 200]
    np.testing.assert_allclose(log.effort, np.column_stack([torque[:, 0] + 0.25 * torque[:, 1], torque[:, 1]]))


def test_applies_window_cycles_and_motion_name(convert, table):
    path, values = table
    log, _ = convert(JOINT_SIDE + "window: {from: 500 ms, to: 1.5}\ncycle_period: 0.4 s\nmotion: wave\n", path)
    np.testing.assert_array_equal(log.position, values[100:300, 1:3])
    assert log.stamp == pytest.approx(0.5)
    np.testing.assert_allclose(log.cycle_starts, [0.0, 0.4, 0.8], atol=1e-9)
    assert log.metadata["motion"] == "wave"


def test_decimation_keeps_slow_motion_and_filters_aliasing(convert, tmp_path):
    t = np.arange(20000) / 5000
    slow, fast = np.sin(2 * np.pi * 3 * t), 0.1 * np.sin(2 * np.pi * 480 * t)
    np.savetxt(tmp_path / "fast.csv", np.column_stack([slow + fast, slow]), delimiter=",")
    log, notes = convert("rate: 5 kHz\nposition: {columns: [1, 2]}\ndecimate: 10\n", tmp_path / "fast.csv")
    assert log.sample_rate == 500
    assert len(log.t) == 2000
    np.testing.assert_allclose(log.position[50:-50, 0], slow[::10][50:-50], atol=1e-4)  # 480 Hz would alias to 20 Hz
    assert any("every 10th sample, after a zero-phase filter at 200 Hz" in note for note in notes)


@pytest.fixture
def uneven(tmp_path):
    """A table of about 500 Hz with jitter and a gap of half a second: a 1 Hz motion, and its sign as effort."""
    t = np.cumsum(np.random.default_rng(2).uniform(0.001, 0.003, 4000))
    t[2000:] += 0.5
    q = np.sin(2 * np.pi * (t - t[0]))
    np.savetxt(tmp_path / "uneven.csv", np.column_stack([t, q, 0.1 * q, np.sign(q), np.sign(q)]), delimiter=",")
    return tmp_path / "uneven.csv"


UNEVEN = "time: {column: 1}\nposition: {columns: [2, 3]}\neffort: {columns: [4, 5]}\ndecimate: "


def test_decimation_resamples_uneven_data_first(convert, uneven):
    log, notes = convert(UNEVEN + "2\n", uneven)
    assert any("interpolated to even" in note for note in notes)
    assert len(log.segments) == 2
    for start, stop in log.segments:
        np.testing.assert_allclose(np.diff(log.t[start:stop]), 1 / log.sample_rate, rtol=1e-5)
        inside = slice(start + 50, stop - 50)
        np.testing.assert_allclose(log.position[inside, 0], np.sin(2 * np.pi * log.t[inside]), atol=1e-4)
        steady = inside, np.abs(log.position[inside, 0]) > 0.5
        np.testing.assert_allclose(np.abs(log.effort[steady[0], 0][steady[1]]), 1.0, atol=1e-3)


def test_joins_columns_of_several_files(convert, tmp_path, table):
    path, values = table
    np.savetxt(tmp_path / "other.csv", values[:398, 5:7], delimiter=";", header="q1;q2", comments="# ", fmt="%.17g")
    mapping = "rate: 200 Hz\nposition: {file: data.csv, columns: [q1, q2]}\neffort: {file: oth*, columns: [q1, q2]}\n"
    log, notes = convert(mapping, path, tmp_path / "other.csv")
    np.testing.assert_array_equal(log.position, values[:398, 1:3])
    np.testing.assert_array_equal(log.effort, values[:398, 5:7])
    assert any("2 last rows in some columns only" in note for note in notes)
    with pytest.raises(InputError, match=r"map.yaml:2: position.columns: data.csv, other.csv all have these columns"):
        convert("rate: 200 Hz\nposition: {columns: [q1, q2]}\n", path, tmp_path / "other.csv")
    np.savetxt(tmp_path / "short.csv", values[:300, 5:7], delimiter=",", header="a,b", comments="")
    with pytest.raises(InputError, match=r"different length: .*\(data.csv\) 400, effort \(short.csv\) 300 rows"):
        convert(
            "rate: 200 Hz\nposition: {columns: [q1, q2]}\neffort: {columns: [a, b]}\n", path, tmp_path / "short.csv"
        )


def _save(path: Path, names: str, *columns: np.ndarray) -> Path:
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=names, comments="", fmt="%.17g")
    return path


CLOCKS = "time: {file: data.csv, column: t}\nposition: {columns: [q1, q2]}\neffort: {columns: [e1, e2]}\n"


@pytest.mark.parametrize("kept", [slice(50, None), [*range(150), *range(157, 400)], slice(None, None, 4)])
def test_files_with_stamps_of_their_own_are_joined_by_time(convert, tmp_path, table, kept):
    """A logger that started later, lost rows, or is slower."""
    _, values = table
    t, q, e = values[:, 0], values[:, 1:3], values[:, 5:7]
    files = _save(tmp_path / "data.csv", "t,q1,q2", t, q), _save(tmp_path / "tau.csv", "t,e1,e2", t[kept], e[kept])
    log, notes = convert(CLOCKS, *files)
    np.testing.assert_allclose(log.position, q[kept], atol=1e-12)
    np.testing.assert_allclose(log.effort, e[kept], atol=1e-12)
    assert any("data.csv, tau.csv: columns have stamps of their own, joined by time" in note for note in notes)


def test_files_without_a_common_time_are_refused(convert, tmp_path, table):
    _, values = table
    t, q, e = values[:, 0], values[:, 1:3], values[:, 5:7]
    files = _save(tmp_path / "data.csv", "t,q1,q2", t, q), _save(tmp_path / "tau.csv", "t,e1,e2", t + 1e4, e)
    with pytest.raises(InputError, match=r"no time in common \(data.csv 0 s to 1.995 s; tau.csv 10000 s"):
        convert(CLOCKS, *files)


def test_rows_of_two_topics_are_joined_by_time(convert, tmp_path, table):
    """As a plotting tool exports them: the cells of the other topic are empty."""
    _, values = table
    lines = ["t,q1,q2,e1,e2"]
    for t, q1, q2, _, _, e1, e2 in values.tolist():
        lines += [f"{t!r},{q1!r},{q2!r},,", f"{t + 0.0005!r},,,{e1!r},{e2!r}"]
    (tmp_path / "data.csv").write_text("\n".join(lines))
    log, _ = convert(CLOCKS, tmp_path / "data.csv")
    np.testing.assert_allclose(log.position, values[1:, 1:3], atol=1e-12)
    np.testing.assert_allclose(log.effort, 0.9 * values[1:, 5:7] + 0.1 * values[:-1, 5:7], atol=1e-9)


LONG = "time: {column: t}\nposition: {columns: [q]}\neffort: {columns: [e]}\n"


@pytest.mark.parametrize("names", [("turn", "slide"), (7, 8)])
def test_rows_may_be_of_one_joint_each(convert, tmp_path, table, names):
    """A long table; where the mapping does not say so, the message does."""
    _, values = table
    lines = ["t,which,q,e"]
    for t, *q, _, _, e1, e2 in values.tolist():
        lines += [f"{t!r},{name},{p!r},{e!r}" for name, p, e in zip(names, q, (e1, e2), strict=True)]
    path = tmp_path / "data.csv"
    path.write_text("\n".join(lines))
    rows = f"rows: {{column: which, equals: [{names[0]}, {names[1]}]}}"
    with pytest.raises(InputError, match=re.escape(rows)):
        convert(LONG, path)
    log, _ = convert(f"{LONG}{rows}\n", path)
    np.testing.assert_array_equal(log.position, values[:, 1:3])
    np.testing.assert_array_equal(log.effort, values[:, 5:7])
    for wrong, says in (
        (rows.replace(f", {names[1]}]", ", elbow]"), f"not all of these are in column which; there are .*{names[0]}"),
        (rows.replace("which", "joint"), "rows.column: data.csv has no column joint"),
    ):
        with pytest.raises(InputError, match=says):
            convert(f"{LONG}{wrong}\n", path)
    with pytest.raises(InputError, match="by their times"):
        convert(f"{LONG}{rows}\n".replace("time: {column: t}", "rate: 200 Hz"), path)


def test_each_joint_may_have_a_file_of_its_own(convert, tmp_path, table):
    _, values = table
    paths = [_save(tmp_path / f"{k}.csv", "q,e", values[:, k], values[:, k + 4]) for k in (1, 2)]
    files = "file: [1.csv, 2.csv], columns: "
    mapping = f"rate: 200 Hz\nposition: {{{files}[q, q]}}\neffort: {{{files}[e, e]}}\n"
    log, notes = convert(mapping, *paths)
    np.testing.assert_array_equal(log.position, values[:, 1:3])
    np.testing.assert_array_equal(log.effort, values[:, 5:7])
    assert "out.mcap: position: turn from q of 1.csv, slide from q of 2.csv" in notes
    with pytest.raises(InputError, match=r"position.file: 1 file for 2 columns"):
        convert("rate: 200 Hz\nposition: {file: [1.csv], columns: [q, q]}\n", *paths)


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ("position: {columns: [q1, q1]}\n", "position.columns: column q1 of data.csv stands in position already"),
        ("position: {columns: [q1, q2]}\neffort: {columns: [q2, e2]}\n", "effort.columns: column q2 .*in position"),
    ],
)
def test_a_column_stands_for_one_joint_and_quantity(convert, tmp_path, table, columns, says):
    _, values = table
    path = _save(tmp_path / "data.csv", "q1,q2,e2", values[:, [1, 2, 5]])
    with pytest.raises(InputError, match=says):
        convert(f"rate: 200 Hz\n{columns}", path)


def test_columns_that_are_named_after_other_joints_are_refused(convert, tmp_path, table):
    _, values = table
    path = _save(tmp_path / "data.csv", "t,slide.q,turn.q", values[:, 0], values[:, 1:3])
    with pytest.raises(InputError, match=r"joints are turn, slide, but slide.q is of slide, turn.q is of turn; write"):
        convert("time: {column: t}\nposition: {columns: [2, 3]}\n", path)
    log, _ = convert("time: {column: t}\nposition: {columns: [3, 2]}\n", path)
    np.testing.assert_array_equal(log.position, values[:, [2, 1]])


@pytest.mark.parametrize(
    ("names", "effort", "says"),
    [
        ("left_turn,left_slide,right_turn,right_slide", "right_turn, right_slide", "are of right, .*position of left"),
        ("arm1_A,arm1_B,arm2_A,arm2_B", "arm2_A, arm2_B", "are of arm2, those of position of arm1"),
        ("q1,q2,tau1,tau2", "tau2, tau1", "are in another order than those of position: tau2 stands where q1 does"),
        ("left_A,left_B,left_FA,left_FB", "left_FA, left_FB", None),
        ("q0,q1,tau0,tau1", "tau0, tau1", None),
    ],
)
def test_columns_of_two_quantities_are_of_the_same_joints(convert, tmp_path, table, names, effort, says):
    _, values = table
    path = _save(tmp_path / "data.csv", names, values[:, [1, 2, 5, 6]])
    mapping = f"rate: 200 Hz\nposition: {{columns: [1, 2]}}\neffort: {{columns: [{effort}]}}\n"
    with pytest.raises(InputError, match=f"effort.columns: the columns {says}") if says else contextlib.nullcontext():
        convert(mapping, path)


@pytest.mark.parametrize("velocity", ["velocity: {columns: [v1, v2]}\n", ""])
@pytest.mark.parametrize("share", [0.01, 0.06])
def test_rows_that_were_lost_show_in_how_far_positions_go(convert, tmp_path, share, velocity):
    mapping = f"rate: 100 Hz\nposition: {{columns: [q1, q2]}}\n{velocity}"
    rng = np.random.default_rng(4)
    t = np.arange(2000) / 100
    q, v = np.column_stack([np.sin(2 * t), 0.1 * t]), np.column_stack([2 * np.cos(2 * t), 0.1 + 0 * t])
    kept = np.append(0, 1 + np.flatnonzero(rng.random(1999) > share))
    path = _save(tmp_path / "data.csv", "q1,q2,v1,v2", q[kept].round(4), v[kept].round(4))
    log, notes = convert(mapping, path)
    recovered = round(100 * log.t[-1]) + 1 - len(kept)  # but for what was lost while the arm hardly moved
    assert 0.7 * (2000 - len(kept)) <= recovered <= 2000 - len(kept)
    assert any("rows are missing at" in note for note in notes)
    block = np.r_[0:600, 700:2000]
    path = _save(tmp_path / "block.csv", "q1,q2,v1,v2", q[block], v[block])
    log, notes = convert(mapping, path)
    assert log.segments == ((0, 600), (600, 1900))
    assert any("first after row 600: positions jump" in note for note in notes)
    whole = _save(tmp_path / "whole.csv", "q1,q2,v1,v2", q, v)
    log, notes = convert(mapping, whole)
    assert not any("missing" in note for note in notes)


@pytest.mark.parametrize("velocity", ["velocity: {columns: [v1, v2]}\n", ""])
@pytest.mark.parametrize("count", [1e-3, 1e-9])
def test_coarse_encoders_and_sudden_starts_lose_no_rows(convert, tmp_path, count, velocity):
    """A velocity as many drives give it: the way since the row before, which is late by half a row."""
    steps = np.repeat([0.0, 1.5, 0.0, 4.0, -2.0, 0.0, 1.0], 60) * 1e-3
    q = np.round(np.cumsum(np.tile(steps, 5)) / count) * count
    path = _save(tmp_path / "data.csv", "q1,q2,v1,v2", q, 0 * q, 500 * np.diff(q, prepend=0.0), 0 * q)
    _, notes = convert(f"rate: 500 Hz\nposition: {{columns: [q1, q2]}}\n{velocity}", path)
    assert not any("missing" in note for note in notes)


@pytest.mark.parametrize("velocity", ["velocity: {columns: [v1, v2]}\n", ""])
def test_a_log_with_one_short_move_loses_no_rows(convert, tmp_path, velocity):
    """As of a hobby arm: 4096 counts a turn, and hardly any steps that are many counts."""
    t = np.arange(2000) / 50
    slow = 0.0 if velocity else 0.1 * np.sin(0.5 * t)
    q = np.column_stack([slow + np.clip(t - 20, 0.0, 0.6), 0 * t])
    q = np.round(q / (2 * np.pi / 4096)) * 2 * np.pi / 4096
    path = _save(tmp_path / "data.csv", "q1,q2,v1,v2", q, np.gradient(q, t, axis=0))
    _, notes = convert(f"rate: 50 Hz\nposition: {{columns: [q1, q2]}}\n{velocity}", path)
    assert not any("missing" in note for note in notes)


def test_rows_too_far_apart_for_a_motion_ask_for_the_unit_of_time(convert, tmp_path, table):
    _, values = table
    path = _save(tmp_path / "data.csv", "t,q1,q2", 1e4 * values[:, 0], values[:, 1:3])
    with pytest.raises(InputError, match=r"map.yaml:1: time.unit: rows are 50 s apart .*is s right, or is it ms"):
        convert("time: {column: t}\nposition: {columns: [q1, q2]}\n", path)


def test_rows_of_arrival_without_a_rhythm_ask_for_a_rate(convert, tmp_path, table):
    _, values = table
    burst = np.searchsorted(np.cumsum(np.random.default_rng(2).integers(1, 9, len(values))), np.arange(len(values)))
    time = burst * values[-1, 0] / burst[-1] + 1e-5 * np.arange(len(values))
    path = _save(tmp_path / "data.csv", "t,q1,q2", time, values[:, 1:3])
    with pytest.raises(InputError, match=r"map.yaml:1: time: rows are 1e-05 s .* rate: 20[01] Hz instead of time"):
        convert("time: {column: t}\nposition: {columns: [q1, q2]}\n", path)


def test_files_in_different_units_of_time_are_refused(convert, tmp_path, table):
    _, values = table
    a = _save(tmp_path / "a.csv", "t,q1,q2", 1e3 * values[:, 0], values[:, 1:3])
    b = _save(tmp_path / "b.csv", "t,e1,e2", values[:, 0], values[:, 5:7])
    mapping = "time: {column: t, unit: ms}\nposition: {columns: [q1, q2]}\neffort: {columns: [e1, e2]}\n"
    with pytest.raises(InputError, match=r"map.yaml:1: time.unit: rows are 5e-06 s apart .*is ms right, or is it s\?"):
        convert(mapping, a, b)


def test_repairs_broken_and_jittered_rows(convert, tmp_path, table):
    path, values = table
    rng = np.random.default_rng(1)
    values[:, 0] += rng.uniform(-1e-3, 1e-3, 400)
    np.savetxt(path, values, delimiter=",", header="time,q1,q2,v1,v2,e1,e2", comments="", fmt="%.17g")
    with open(path, "a", encoding="utf-8") as file:
        file.write("2.0,nan,1,1,1,1,1\n2.005,0.1,oops,1,1,1,1\n2.01,0.1")
    log, notes = convert(JOINT_SIDE + "effort: {columns: [e1, e2]}\n", path)
    np.testing.assert_array_equal(log.position, values[:, 1:3])
    np.testing.assert_allclose(log.t, values[:, 0] - values[0, 0], atol=2e-9)
    assert log.sample_rate == pytest.approx(200, rel=1e-3)
    assert "out.mcap: 3 rows without a number in every column, dropped; the first is row 401" in notes
    assert any("uneven intervals" in note for note in notes)


@pytest.mark.parametrize(
    "text",
    [
        "t;a;b\n0;1,5;2\n0,01;2,5;3\n0,02;3,5;4\n",
        "# t a b\n0 1.5 2\n0.01 2.5 3\n0.02 3.5 4\n",
        "% made by a logger\nt\ta\tb\n[s]\t[rad]\t[m]\n0\t1.5\t2\n0.01\t2.5\t3\n0.02\t3.5\t4\n",
        '"t","a","b"\r\n0,1.5,2\r\n0.01,2.5,3\r\n0.02,3.5,4\r\n',
        "\ufefft,a,b,state\n0,1.5,2,ok\n0.01,2.5,3,ok\n0.02,3.5,4,ok\n",
        '"t";"a";"b"\n"0";"1,5";"2"\n"0,01";"2,5";"3"\n"0,02";"3,5";"4"\n',
        '"t","a","b","state"\n"0","1.5","2","ok"\n"0.01","2.5","3","o,k"\n"0.02","3.5","4",""\n',
        "t|a|b\n0|1.5|2\n0.01|2.5|3\n0.02|3.5|4\n",
    ],
    ids=["decimal comma", "blanks", "tabs and units", "quotes", "text column", "quoted", "quoted text", "bars"],
)
def test_reads_text_tables_of_any_separator(convert, tmp_path, text):
    (tmp_path / "data.csv").write_bytes(text.encode())
    for a, b in (("a", "b"), (2, 3)):
        log, _ = convert(f"time: {{column: t}}\nposition: {{columns: [{a}, {b}]}}\n", tmp_path / "data.csv")
        np.testing.assert_array_equal(log.position, [[1.5, 2], [2.5, 3], [3.5, 4]])
        assert log.sample_rate == pytest.approx(100)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "utf-8", "cp1252"])
def test_reads_tables_in_the_encodings_of_windows(convert, tmp_path, encoding):
    (tmp_path / "data.csv").write_text('"t, s",a [°],b\n0,1.5,2\n0.01,2.5,3\n0.02,3.5,4\n', encoding=encoding)
    log, _ = convert("time: {column: 't, s'}\nposition: {columns: ['a [°]', b]}\n", tmp_path / "data.csv")
    np.testing.assert_array_equal(log.position, [[1.5, 2], [2.5, 3], [3.5, 4]])


@pytest.mark.parametrize(
    ("rows", "complaint"),
    [
        (["1.0;{k};2"] * 300, r"map.yaml:1: time.column: .*data.csv: column t stands still at 1 s \(300 rows\)"),
        (["at {k};1;2"] * 60, r"time.column: .*data.csv: column t is not of numbers \('at 0'"),
        (["{k};1,234.5;2"] * 9, r"map.yaml:2: position.columns: .*data.csv: column a is not of numbers \('1,234.5' is"),
        (["{k};nan;2"] * 9, r"map.yaml:2: position.columns: .*data.csv: column a is empty"),
        (["{k};2;0x1F"] * 9, r"map.yaml:2: position.columns: .*data.csv: column 3 is not of numbers"),
    ],
)
def test_names_the_unusable_column(convert, tmp_path, rows, complaint):
    lines = [row.format(k=k) for k, row in enumerate(rows)]
    (tmp_path / "data.csv").write_text("\n".join(["t;a;b", *lines]))
    with pytest.raises(InputError, match=complaint):
        convert("time: {column: t}\nposition: {columns: [a, 3]}\n", tmp_path / "data.csv")


def test_reports_a_clock_set_back_in_a_table(convert, tmp_path):
    times = np.concatenate([np.arange(300), np.arange(300)]) / 100
    rows = [f"{t},{k % 300},{k}" for k, t in enumerate(times)]
    (tmp_path / "data.csv").write_text("\n".join(["t,a,b", *rows]))
    with pytest.raises(InputError, match=r"data.csv: the controller's clock was set back"):
        convert("time: {column: t}\nposition: {columns: [a, b]}\n", tmp_path / "data.csv")


def test_reads_mat_files(convert, tmp_path):
    t = np.arange(100) / 50
    q = np.column_stack([np.sin(t), np.cos(t)])
    path = tmp_path / "data.mat"
    savemat(path, {"log": {"time": t[:, None], "q": q.T, "gain": 3.0}, "force": q})
    mapping = "time: {column: log.time}\nposition: {columns: log.q}\neffort: {columns: force, scale: [log.gain, 1]}\n"
    log, _ = convert(mapping, path)
    np.testing.assert_array_equal(log.position, q)
    np.testing.assert_array_equal(log.effort, q * [3, 1])
    savemat(tmp_path / "zero.mat", {"q": q, "gain": 0.0})
    with pytest.raises(InputError, match=r"position.scale: zero.mat: 'gain' is 0; a finite number other than 0"):
        convert("rate: 50 Hz\nposition: {columns: q, scale: gain}\n", tmp_path / "zero.mat")
    log, _ = convert("rate: 50 Hz\nposition: {columns: ['log.q[2]', 'force[1]']}\n", path)
    np.testing.assert_array_equal(log.position, q[:, [1, 0]])
    path.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(500))
    with pytest.raises(InputError, match=r"data.mat: not a readable MAT file"):
        convert(mapping, path)


def test_reads_parquet_files(convert, tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="reading Parquet is an extra: pip install '.[tables]'")
    from pyarrow import parquet

    count = np.arange(100)
    stamps = (1_700_000_000_000_000_000 + count * 10_000_000).astype("datetime64[ns]")
    q = np.column_stack([np.sin(count / 9), np.cos(count / 9)])
    content = {"when": stamps, "q": [row.tolist() for row in q], "e1": q[:, 0], "e2": q[:, 1], "note": ["x"] * 100}
    parquet.write_table(pyarrow.table(content), tmp_path / "data.parquet")
    mapping = "time: {column: when}\nposition: {columns: q}\neffort: {columns: [e1, e2]}\n"
    log, _ = convert(mapping, tmp_path / "data.parquet")
    np.testing.assert_array_equal(log.position, q)
    np.testing.assert_array_equal(log.effort, q)
    assert log.sample_rate == pytest.approx(100, rel=1e-3)
    assert log.stamp == pytest.approx(1.7e9)
    (tmp_path / "data.parquet").write_bytes(b"PAR1 no")
    with pytest.raises(InputError, match=r"not a readable Parquet file"):
        convert(mapping, tmp_path / "data.parquet")


def test_without_pyarrow_it_says_what_to_install(convert, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "data.parquet").touch()
    with pytest.raises(InputError, match=r"pip install 'calibration-agent\[tables\]'"):
        convert("rate: 1\nposition: {columns: q}\n", tmp_path / "data.parquet")


RATE, BOTH = "rate: 5\n", "position: {columns: [q1, q2]}\n"


@pytest.mark.parametrize(
    ("mapping", "complaint"),
    [
        (BOTH, r"map.yaml:1: document: give either rate"),
        ("rate: 5 m\n" + BOTH, r"map.yaml:1: rate: .*frequency.*length"),
        (RATE, r"map.yaml:\d+: position: this key is required"),
        (RATE + "position: {colums: [q1, q2]}\n", r"map.yaml:2: position.colums: unknown key.*did you mean columns"),
        (RATE + "position: {columns: {a: 1}}\n", r"map.yaml:2: position.columns: a column, by name or by number"),
        (RATE + "position: {columns: [q1]}\n", r"map.yaml:2: position.columns: 1 column for 2 joints \(turn, slide\)"),
        (RATE + "position:\n  columns: [q1, q9]\n", r"map.yaml:3: position.columns: data.csv has no column q9; it has"),
        (RATE + "position: {columns: [1, 12]}\n", r"map.yaml:2: position.columns: data.csv has no column 12"),
        (RATE + "position: {columns: [q1, q2], file: x.csv}\n", r"map.yaml:2: position.file: no input is named"),
        (
            RATE + "position:\n  columns: [q1, q2]\n  unit: deg\n",
            r"map.yaml:4: position.unit: 'deg' is no unit of position for slide on the joint side; allowed are m, cm",
        ),
        (RATE + "position: {columns: [q1, q2], offset: [1 s, 0]}\n", r"position.offset: turn: an angle"),
        (RATE + "position: {columns: [q1, q2], scale: gain}\n", r"position.scale: data.csv has no constant 'gain'"),
        (RATE + "position: {columns: [q1, q2], scale: .nan}\n", r"map.yaml:2: position.scale: a finite number other"),
        (RATE + "position: {columns: [q1, q2], scale: [1, 0]}\n", r"map.yaml:2: position.scale: a finite number other"),
        (
            f"rate: 5\nposition: {{columns: [q1, q2], scale: {'9' * 400}}}\n",
            r"map.yaml:2: position.scale: a finite number other",
        ),
        ("rate: 1e12 Hz\n" + BOTH, r"map.yaml:1: rate: .*less than or equal to 1000000"),
        (RATE + "position: {columns: [q1, q2], scale: [1, 2, 3]}\n", r"position.scale: 3 values for 2 joints"),
        (RATE + "side: left\n" + BOTH, r"map.yaml:2: side: .*'motor' or 'joint'"),
        (RATE + "window: {from: 2 s, to: 1 s}\n" + BOTH, r"map.yaml:2: window: from 2 s"),
        (RATE + "window: {from: 900 s, to: 901 s}\n" + BOTH, r"window: no row is in it"),
        (RATE + "decimate: 1\n" + BOTH, r"map.yaml:2: decimate: .*greater than or equal to 2"),
        (
            RATE + BOTH + "effort: {columns: [e1, e2], unit: A, side: joint}\n",
            r"map.yaml:3: effort.side: currents are on the motor side",
        ),
        ("time: {column: when}\n" + BOTH, r"map.yaml:1: time.column: data.csv has no column when"),
        (RATE + "cycle_period: 1 s\n" + BOTH, r"map.yaml:2: cycle_period: .*ten samples"),
        (RATE + "decimate: 50\n" + BOTH, r"map.yaml:2: decimate: 400 samples would leave"),
        ("rate: 1e-9\n" + BOTH, r"map.yaml:1: rate: times go up to 3.99e\+11 s: is the unit"),
        ("time: {column: time, unit: m}\n" + BOTH, r"time.unit: 'm' is no unit of time"),
    ],
)
def test_a_wrong_map_names_file_line_and_key_and_leaves_no_file(convert, tmp_path, table, mapping, complaint):
    with pytest.raises(InputError, match=complaint):
        convert(mapping, table[0])
    assert not [*tmp_path.glob("*.mcap*"), *tmp_path.glob(".*")]


def test_refuses_files_that_are_not_tables(convert, pair, tmp_path, table):
    (tmp_path / "words.csv").write_text("nothing\nbut words\n")
    (tmp_path / "empty.csv").touch()
    for name, complaint in {
        "words.csv": "no line of numbers",
        "empty.csv": "no line of numbers",
        "absent.csv": "no such file",
        "log.mcap": "tables end in .csv",
    }.items():
        with pytest.raises(InputError, match=complaint):
            convert(JOINT_SIDE, tmp_path / name)
    with pytest.raises(InputError, match=r"ends in \.mcap"):
        import_log(pair, tmp_path / "map.yaml", [tmp_path / "out.mcap"], table[0])
    assert table[0].exists()


@pytest.mark.parametrize(("stretch", "start", "stop"), [("fit", 500, 22700), ("held_out", 22700, 37500)])
def test_the_tx40_import_matches_the_published_formulas(shared_data, tmp_path, stretch, start, stop):
    robot = load_robot(EXAMPLES / "tx40")
    tables = [shared_data / "tx40" / name for name in ("pos_read_data.csv", "curr_data.csv")]
    out = tmp_path / "tx40.mcap"
    import_log(robot, EXAMPLES / "tx40" / f"map_{stretch}.yaml", tables, out)
    log = read_log(out, robot)

    motor, torque = (np.loadtxt(table, delimiter=",", skiprows=1)[start:stop] for table in tables)
    n = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    q = motor / n
    q[:, 5] = motor[:, 5] / n[5] - q[:, 4]
    q[:, 1] -= np.pi / 2
    q[:, 2] += np.pi / 2
    tau = torque * n
    tau[:, 4] += n[5] * torque[:, 5]
    np.testing.assert_allclose(log.position, q, atol=1e-12)
    np.testing.assert_allclose(log.effort, tau, atol=1e-12)
    np.testing.assert_allclose(log.t, np.arange(stop - start) / 5000, atol=1e-9)
    assert log.sample_rate == 5000
    assert log.segments == ((0, stop - start),)
    assert log.repairs == ()
    lower, upper = robot.position_limits
    assert ((log.position > lower) & (log.position < upper)).all()


@pytest.mark.parametrize("name", ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"])
def test_the_emps_import_matches_the_published_formulas(shared_data, tmp_path, name):
    robot = load_robot(EXAMPLES / "emps")
    out = tmp_path / "emps.mcap"
    import_log(robot, EXAMPLES / "emps" / "map.yaml", [shared_data / "emps" / name], out)
    log = read_log(out, robot)
    data = loadmat(shared_data / "emps" / name)
    np.testing.assert_array_equal(log.position, data["qm"])
    np.testing.assert_array_equal(log.reference_position, data["qg"])
    np.testing.assert_allclose(log.effort, data["gtau"] * data["vir"], rtol=1e-15)
    np.testing.assert_allclose(log.t, data["t"][:, 0] - data["t"][0, 0], atol=2e-9)
    assert log.sample_rate == pytest.approx(1000, rel=1e-6)
    assert len(log.segments) == 1


ALOHA = [f"vx300s_{side}/{name}" for side in ("left", "right") for name in ("waist", "elbow")]


@pytest.mark.parametrize(
    ("columns", "joints", "named"),
    [
        (["q_pan", "/drives/lift/torque"], ["pan", "lift"], ["pan", "lift"]),
        (["shoulder_pan.pos", "wrist_3.pos"], ["shoulder_pan_joint", "wrist_3_joint", "wrist_2_joint"], [0, 1]),
        (["right_waist", "right_elbow"], ALOHA, [2, 3]),
        (["waist", "elbow"], ALOHA, None),
        (["joint1.q", "joint2.q"], ["panda_joint1", "panda_joint2", "panda_joint3"], [0, 1]),
        (["q1", "q2"], ["joint_1", "joint_2"], None),
        (["joint_0", "joint_1"], ["joint_1", "joint_2"], None),
        (["pan.q", "pan.tau"], ["pan", "lift"], None),
    ],
)
def test_the_joint_of_a_column_is_known_by_its_name(columns, joints, named):
    expected = named and [joints[one] if isinstance(one, int) else one for one in named]
    assert named_joints(columns, joints) == expected
