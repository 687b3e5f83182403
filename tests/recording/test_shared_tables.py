"""Tables and logs of three-axis arms as people's tools write them give the arm they were made with (data next to the
checkout)."""

import re
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from agent.cli.app import app
from agent.core import InputError
from agent.data_quality import check_quality, spoiled
from agent.estimation import EstimationSettings, estimate
from agent.recording import import_log, read_log, recorded_joints
from agent.simulators import load_arm, load_arm_of

FILES = Path(__file__).resolve().parents[3] / "shared/data/files-dev2"
pytestmark = pytest.mark.skipif(not FILES.is_dir(), reason="the files are not here")
#: kg·m of links 2 and 3, by which the files were made.
MOMENTS = {"mz2": 1.90, "mz3": 0.35}


def _imported(folder: str, mapping: str, tables: list[str], out: Path, urdf: str = "arm.urdf"):
    place = FILES / folder
    inputs = [place / table for table in tables]
    notes = import_log(partial(load_arm_of, place / urdf), place / mapping, inputs, out / "log.mcap")
    robot = load_arm(place / urdf, recorded_joints(out / "log.mcap"))
    return robot, read_log(out / "log.mcap", robot), "\n".join(notes)


def _check_arm(robot, log) -> None:
    model = estimate(robot, [log], EstimationSettings.create(method="weighted"))
    found = dict(zip(model.names, model.values, strict=True))
    for name, moment in MOMENTS.items():
        assert found[name] == pytest.approx(moment, rel=0.05)


@pytest.mark.parametrize(
    ("folder", "mapping", "tables"),
    [
        ("03-files-with-their-own-stamps", "map.yaml", ["pos.csv", "tau_lost.csv"]),
        ("03-files-with-their-own-stamps", "map.yaml", ["pos.csv", "tau_late.csv"]),
        ("04-parked-joint", "map.yaml", ["log.csv"]),
        ("10-rows-lost-without-stamps", "map.yaml", ["log.csv"]),
        ("19-counter-wraps", "wrap.yaml", ["wrap.csv"]),
        ("19-counter-wraps", "midnight.yaml", ["midnight.csv"]),
        ("20-stamps-of-arrival", "map.yaml", ["burst.csv"]),
        ("21-rows-of-two-topics", "map.yaml", ["export.csv"]),
        ("22-one-file-per-joint", "map.yaml", ["pan.csv", "lift.csv", "elbow.csv"]),
    ],
)
def test_the_arm_of_a_table_is_found(tmp_path, folder, mapping, tables):
    robot, log, notes = _imported(folder, mapping, tables, tmp_path)
    assert "position: pan from" in notes
    assert log.t[-1] < 30
    _check_arm(robot, log)


def test_a_model_of_an_arm_with_a_parked_joint_is_written(tmp_path):
    """Its torque is exactly zero, so nothing of it is left to compare effects with."""
    _imported("04-parked-joint", "map.yaml", ["log.csv"], tmp_path)
    arm, out = str(FILES / "04-parked-joint/arm.urdf"), tmp_path / "model.json"
    shown = CliRunner().invoke(app, ["estimate", "--robot", arm, str(tmp_path / "log.mcap"), "-o", str(out)])
    assert shown.exit_code == 0, shown.output
    assert re.search(r"pan +stood still", shown.stdout)
    assert out.is_file()


def test_the_arm_of_two_is_taken_by_the_names_of_the_columns(tmp_path):
    robot, log, _ = _imported("01-two-arms", "right.yaml", ["right.csv"], tmp_path, "two.urdf")
    assert robot.joint_names == ("right_pan", "right_lift", "right_elbow")
    _check_arm(robot, log)


def test_joints_with_a_prefix_are_read():
    place = FILES / "17-prefixed-joint-names"
    robot = load_arm(place / "arm.urdf")
    log = read_log(place / "log.mcap", robot)
    assert log.joint_names == ("pan", "lift", "elbow")
    assert any("joints arm1_pan, arm1_lift, arm1_elbow are taken for pan" in repair.kind for repair in log.repairs)
    _check_arm(robot, log)


def test_a_joint_that_a_log_lacks_is_said(tmp_path):
    """The arm is then another one: 2.00 instead of 1.90 kg·m and 3.6 instead of 4 N·m came out without a word."""
    urdf, mapping = FILES / "25-zero-is-a-level" / "arm.urdf", tmp_path / "map.yaml"
    mapping.write_text(
        "time: {column: t, unit: s}\nposition: {columns: [q_pan, q_lift]}\neffort: {columns: [tau_pan, tau_lift]}\n"
    )
    import_log(partial(load_arm_of, urdf), mapping, [urdf.with_name("log.csv")], tmp_path / "log.mcap")
    command = ["estimate", "--robot", str(urdf), "-o", str(tmp_path / "m.json"), str(tmp_path / "log.mcap")]
    run = CliRunner().invoke(app, [*command, "--method", "plain"])
    assert run.exit_code == 0
    assert "elbow of arm.urdf not recorded, so taken as fixed at zero" in run.stderr


def test_two_arms_in_one_log_name_the_way_on():
    place = FILES / "26-map-hint-that-estimate-lacks"
    with pytest.raises(InputError, match=r"several of its arms \(left_pan.*; right_pan.*write a robot.yaml"):
        load_arm(place / "two.urdf", recorded_joints(place / "log.mcap"))


@pytest.mark.parametrize(
    ("folder", "says"),
    [
        ("06-static-postures", "300 postures at standstill"),
        ("11-joint-zero-of-another-table", r"the zero of lift looks 90° off: .*offset: \[0, -90 deg, 0\]"),
    ],
)
def test_a_log_that_is_no_motion_of_the_arm_is_refused(tmp_path, folder, says):
    robot, log, _ = _imported(folder, "map.yaml", ["log.csv"], tmp_path)
    (found,) = (finding for finding in check_quality(robot, [log]) if finding.refuses)
    assert re.search(says, found.text)


def test_milliseconds_as_seconds_ask_for_the_unit(tmp_path):
    with pytest.raises(InputError, match=r"map_ms.yaml:1: time.unit: .*or is it ms"):
        _imported("20-stamps-of-arrival", "map_ms.yaml", ["ms.csv"], tmp_path)


def test_zero_as_a_level_of_a_torque_is_no_dropout(tmp_path):
    robot, log, _ = _imported("25-zero-is-a-level", "map.yaml", ["log.csv"], tmp_path)
    assert spoiled(robot, [log]) == []
    assert np.mean(log.effort[:, 0] == 0) > 0.01


def test_datasets_and_matrices_are_found_by_their_names(tmp_path):
    folder = "23-name-of-a-matrix"
    _, log, _ = _imported(folder, "slashes.yaml", ["demo.hdf5"], tmp_path)
    assert len(log.t) == 600
    with pytest.raises(InputError, match=r"no column q; it has t, q_actual \(600 x 3\), tau \(600 x 3\)"):
        _imported(folder, "wrong.yaml", ["log.npz"], tmp_path)
