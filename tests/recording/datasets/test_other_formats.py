"""Isaac Sim's CSV, Isaac Lab's HDF5, and recordings that are refused with the reason."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from agent.core import InputError
from agent.pipeline import import_files
from agent.recording import read_log, read_recording
from tests.recording.datasets.recordings import SO101, arm, motion, torch_file, write_lerobot

THREE = arm(["a", "b", "c"])
Q, R = motion(400, 3, 100.0, 1)


def write_csv(path: Path, fields: str, names: bool = True) -> Path:
    columns = {"q": Q, "dq": np.gradient(Q, 0.01, axis=0), "cmd": R}
    table = np.column_stack([np.arange(len(Q)) / 100, *(columns[field] for field in fields.split())])
    head = ",".join(["time", *(f"{field}{k + 1}" for field in fields.split() for k in range(3))])
    np.savetxt(path, table, "%.9g", ",", header=head if names else "", comments="")
    return path


def write_hdf5(path: Path, demos: int = 2, env_args: dict | None = None, joints: int = 3, **moved: np.ndarray) -> Path:
    sim = {"sim_args": {"dt": 0.005, "decimation": 2}}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps(sim if env_args is None else env_args)
        for number in range(demos):
            demo = data.create_group(f"demo_{number}")
            q, r = motion(300, joints, 100.0, number)
            arrays = {"processed_actions": r, "states/articulation/robot/joint_position": q, "obs/joint_pos": q - 1}
            for name, values in (arrays | moved).items():
                if values is not None:
                    demo[name] = values
    return path


@pytest.mark.parametrize("fields", ["q dq cmd", "q dq", "q"])
def test_reads_each_layout_of_isaac_sims_csv(tmp_path: Path, fields):
    (log,), _ = read_recording(write_csv(tmp_path / "telemetry.csv", fields), THREE)
    np.testing.assert_allclose(log.position, Q, atol=1e-8)
    assert (log.velocity is None) == ("dq" not in fields)
    assert (log.reference_position is None) == ("cmd" not in fields)
    assert log.sample_rate == pytest.approx(100)


@pytest.mark.parametrize("change", ["\ufeff{}", "# {}", ";", "\t", "t,", '"time",'])
def test_reads_a_csv_with_names_in_any_notation(tmp_path: Path, change):
    path = write_csv(tmp_path / "telemetry.csv", "q dq cmd")
    names, numbers = path.read_text("utf-8").split("\n", 1)
    if change in ";\t":
        names, numbers = names.replace(",", change), numbers.replace(",", change)
    path.write_text(
        (change.format(names) if "{" in change else names.replace("time,", change)) + "\n" + numbers, "utf-8"
    )
    (log,), _ = read_recording(path, THREE)
    np.testing.assert_allclose(log.reference_position, R, atol=1e-8)


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        ("time,q1,q2,q4,cmd1,cmd2,cmd3", "q1…qN are not all there: 1, 2, 4"),
        ("time,q1,q2,q3,cmd1,cmd2,cmd4", "not of the same joints: position 1, 2, 3; command 1, 2, 4"),
        ("time,a_pos,b_pos,c_pos,a_cmd,b_cmd,c_cmd", r"a table\. Describe its columns: agent import --map"),
    ],
)
def test_refuses_a_csv_with_other_columns(tmp_path: Path, names, reason):
    path = write_csv(tmp_path / "telemetry.csv", "q cmd")
    path.write_text(names + "\n" + path.read_text("utf-8").split("\n", 1)[1], "utf-8")
    with pytest.raises(InputError, match=reason):
        read_recording(path, THREE)


def test_the_preset_takes_no_columns_with_other_names(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("agent.pipeline.identify.load_arm", lambda *_: THREE)
    path = tmp_path / "telemetry.csv"
    path.write_text("time,a,b,c,a_cmd,b_cmd,c_cmd\n" + "0,1,2,3,1,2,3\n" * 20, "utf-8")
    with pytest.raises(InputError, match="the columns time, a, b, c, a_cmd, b_cmd, c_cmd are not time, and one to"):
        import_files("arm", "isaac-sysid", [path], tmp_path / "log.mcap")


def test_imports_a_csv_without_names_by_its_preset(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("agent.pipeline.identify.load_arm", lambda *_: THREE)
    table = write_csv(tmp_path / "bare.csv", "q dq cmd", names=False)
    import_files("arm", "isaac-sysid", [table], tmp_path / "log.mcap")
    log = read_log(tmp_path / "log.mcap", THREE)
    np.testing.assert_allclose(log.position, Q, atol=1e-8)
    np.testing.assert_allclose(log.reference_position, R, atol=1e-8)


def test_reads_every_demonstration_of_isaac_lab(tmp_path: Path):
    logs, notes = read_recording(write_hdf5(tmp_path / "demos.hdf5", demos=12), THREE)
    assert [log.name for log in logs] == [f"demo_{k}" for k in range(12)]
    for number, log in enumerate(logs):
        q, r = motion(300, 3, 100.0, number)
        np.testing.assert_allclose(log.position, q)
        np.testing.assert_allclose(log.reference_position, r)
        assert log.sample_rate == 100
    assert "12 episodes at 100 Hz (dt times decimation)" in notes


def test_reads_the_commanded_of_two_articulations_and_leaves_out_empty_ones(tmp_path: Path):
    others = {"states/articulation/cabinet/joint_position": np.zeros((300, 2))}
    path = write_hdf5(tmp_path / "demos.hdf5", env_args={"sim_args": {"dt": 0.005}, "decimation": 2}, **others)
    with h5py.File(path, "a") as file:
        for name in ("processed_actions", "states/articulation/robot/joint_position"):
            file[f"data/demo_2/{name}"] = np.zeros((0, 3))
    logs, notes = read_recording(path, THREE)
    assert [log.name for log in logs] == ["demo_0", "demo_1"]
    assert logs[0].sample_rate == 100
    assert "1 episode of less than 10 frames left out" in notes


def test_a_dataset_becomes_a_folder_with_a_log_for_each_episode(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("agent.pipeline.identify.load_arm", lambda *_: THREE)
    dataset = write_hdf5(tmp_path / "demos.hdf5")
    with pytest.raises(InputError, match="holds 2 episodes: name a folder"):
        import_files("arm", None, [dataset], tmp_path / "one.mcap")
    import_files("arm", "isaaclab", [dataset], tmp_path / "logs")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["demos.hdf5", "logs"]
    assert [read_log(file, THREE).metadata["motion"] for file in sorted((tmp_path / "logs").iterdir())] == [
        "demo_0",
        "demo_1",
    ]


def lerobot(folder: Path, **changes) -> Path:
    q, r = (np.round(np.degrees(values) / 360 * 4095) * 360 / 4095 for values in motion(300, 3, 30.0))
    return write_lerobot(folder, [(q, changes.pop("sent", r))], names=changes.pop("names", ["a", "b", "c"]), **changes)


ENDS = ["x", "y", "z"]
COMPOSITE = {"type": "BASIC", "right": {"type": "OSC_POSE", "gripper": {"type": "GRIP"}}}
REFUSED = {
    "end-effector actions": (
        lambda p: lerobot(p / "set", actions=ENDS),
        r"actions are of the end effector \(x, y, z\)",
    ),
    "end-effector states": (lambda p: lerobot(p / "set", names=ENDS), "are no joints: x, y, z"),
    "no names": (lambda p: lerobot(p / "set", names=None), "are no joints: none"),
    "joints of another arm": (
        lambda p: lerobot(p / "set", actions=["d", "e", "f"]),
        "states and actions are of different",
    ),
    "commands of another arm": (
        lambda p: lerobot(p / "set", sent=motion(300, 3, 30.0, 9)[1]),
        "do not follow the comm",
    ),
    "percent without range": (
        lambda p: write_lerobot(p / "set", [(still(), still())], names=SO101[:3]),
        "shoulder_lift is in percent of a range that nothing says",
    ),
    "robomimic": (
        lambda p: write_hdf5(p / "d.hdf5", env_args={"env_kwargs": {"control_freq": 20, "c": {"type": "OSC_POSE"}}}),
        r"actions are end-effector \(OSC_POSE\)",
    ),
    "composite robomimic": (
        lambda p: write_hdf5(p / "d.hdf5", env_args={"env_kwargs": {"control_freq": 20, "c": COMPOSITE}}),
        r"actions are end-effector \(OSC_POSE\)",
    ),
    "set-points in a group": (
        lambda p: write_hdf5(p / "d.hdf5", **{"processed_actions": None, "processed_actions/arm": R[:300]}),
        r"processed_actions \(a group\) is no table",
    ),
    "time in words": (
        lambda p: write_hdf5(p / "d.hdf5", env_args={"sim_args": {"dt": "fast"}}),
        "env_args says no dt",
    ),
    "no time": (lambda p: write_hdf5(p / "d.hdf5", env_args={}), "env_args says no dt"),
    "foreign HDF5": (lambda p: write_hdf5(p / "d.hdf5", demos=0), "neither Isaac Lab nor robomimic"),
    "a hand too many": (lambda p: write_hdf5(p / "d.hdf5", processed_actions=np.ones((300, 4))), "4 set-points for 3"),
    "no HDF5": (lambda p: text_file(p / "d.h5"), "not a readable HDF5 file"),
    "pickle": (lambda p: text_file(p / "log.pkl"), r"runs whatever code .*np\.savez"),
    "copied commands": (lambda p: torch_file(p / "c.pt", tensors(Q, Q)), "are the positions themselves"),
    "the next position": (lambda p: torch_file(p / "c.pt", tensors(Q[:-1], Q[1:])), "are the positions themselves"),
    "the position before": (lambda p: torch_file(p / "c.pt", tensors(Q[1:], Q[:-1])), "commands of a, b, c are"),
    "a joint's own positions": (
        lambda p: torch_file(p / "c.pt", tensors(Q, np.column_stack([R[:, 0], Q[:, 1:]]))),
        "commands of b, c are the positions themselves",
    ),
    "time in ms": (lambda p: torch_file(p / "c.pt", tensors(Q, R, 10.0)), "frames of c are 10 s apart"),
    "time that stands still": (lambda p: torch_file(p / "c.pt", tensors(Q, R, 0.0)), "frames of c are 0 s apart"),
    "one way": (lambda p: torch_file(p / "c.pt", tensors(*ramp())), "no joint reverses twice"),
    "no motion": (lambda p: torch_file(p / "c.pt", tensors(0 * Q, R)), "no joint moves"),
}


def still() -> np.ndarray:
    """Two joints that move on grids of their own, and one that does not."""
    t = np.linspace(0, 20, 400)
    moving = np.round(50 * np.sin(t) / 0.08) * 0.08, np.round(50 * np.cos(t) / 0.09) * 0.09
    return np.column_stack([moving[0], np.full(400, 3.0), moving[1]])


def ramp() -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(400)[:, None] * np.ones(3) / 100
    return np.maximum(t - 0.1, 0), t


def tensors(position: np.ndarray, command: np.ndarray, period: float = 0.01) -> dict[str, np.ndarray]:
    named = {"time": np.arange(len(position)) * period, "dof_pos": position, "des_dof_pos": command}
    return {name: np.ascontiguousarray(values, np.float32) for name, values in named.items()}


def text_file(path: Path) -> Path:
    path.write_text("text", encoding="utf-8")
    return path


@pytest.mark.parametrize("case", REFUSED)
def test_refuses_with_the_reason(tmp_path: Path, case):
    make, reason = REFUSED[case]
    with pytest.raises(InputError, match=reason):
        read_recording(make(tmp_path), arm(SO101[:3]) if case == "percent without range" else THREE)
