"""PACE recordings, read without torch and without running what is in them."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from agent.core import InputError
from agent.recording import read_recording
from tests.recording.datasets.recordings import arm, tensor, text, torch_file

ARM = arm(["a", "b", "c"])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_reads_tensors(tmp_path: Path, chirp, kind):
    path = torch_file(tmp_path / "chirp.pt", {name: values.astype(kind) for name, values in chirp.items()})
    (log,), notes = read_recording(path, ARM)
    np.testing.assert_array_equal(log.position, chirp["dof_pos"].astype(float))
    np.testing.assert_array_equal(log.reference_position, chirp["des_dof_pos"].astype(float))
    assert log.sample_rate == pytest.approx(200, rel=1e-6)
    assert any("taken as a, b, c" in note for note in notes)


def test_takes_half_precision_and_other_content(tmp_path: Path, chirp):
    halves = {name: values.astype(np.float16) for name, values in chirp.items() if name != "time"}
    halves["des_dof_pos"] = (chirp["des_dof_pos"].view(np.uint32) >> 16).astype(np.uint16)  # bfloat16
    others = {"time": chirp["time"], "image": np.zeros((2, 3, 4), np.uint8), "nothing": np.zeros(0, np.float32)}
    (log,), _ = read_recording(torch_file(tmp_path / "chirp.pt", others | halves), ARM)
    np.testing.assert_allclose(log.position, chirp["dof_pos"], atol=1e-3)
    np.testing.assert_allclose(log.reference_position, chirp["des_dof_pos"], atol=1e-2)


def test_names_in_the_file_say_the_order_of_the_joints(tmp_path: Path, chirp):
    path = torch_file(tmp_path / "chirp.pt", chirp)
    with zipfile.ZipFile(path) as archive:
        content = archive.read("chirp/data.pkl")
    names = text("joint_names") + b"](" + text("c") + text("a") + text("b") + b"e"
    (log,), _ = read_recording(torch_file(path, chirp, {"data.pkl": content[:-2] + names + b"u."}), ARM)
    np.testing.assert_array_equal(log.position, chirp["dof_pos"][:, [1, 2, 0]])


def test_joints_without_names_have_to_be_as_many_as_those_of_the_arm(tmp_path: Path, chirp):
    with pytest.raises(InputError, match="3 columns without names, and arm has 2 joints"):
        read_recording(torch_file(tmp_path / "chirp.pt", chirp), arm(["a", "b"]))


DEEP = b"(" + b"".join(b"q%c((h%ch%ct" % (k, k, k) for k in range(40)) + b"t" * 80  # a tuple that takes ages to hash
ATTACKS = {
    "runs code": b"\x80\x02cposix\nsystem\n" + text("touch RUN") + b"\x85R.",
    "names a file's reader": b"\x80\x02cbuiltins\nopen\n" + text("RUN") + b"\x85R.",
    "calls by an attribute": b"\x80\x04" + b"\x8c\x05torch\x8c\x04load\x93.",
    "builds an object": b"\x80\x02ccollections\nOrderedDict\n)R}b.",
    "an extension": b"\x80\x02\x82\x01.",
    "a huge place in the memo": b"\x80\x02}r\xff\xff\xff\xff.",
    "a dict with a tuple as key": b"\x80\x02}" + DEEP + b"K\x01s.",
    "ends early": b"\x80\x02}(",
    "no pickle": b"\xff" * 30,
    "empty": b"",
    "takes from an empty stack": b"\x80\x02u.",
    "a number": b"\x80\x02K\x01.",
    "larger than its numbers": b"\x80\x02}(" + text("time") + tensor("0", (10**9,)) + b"u.",
    "from beyond its numbers": b"\x80\x02}(" + text("time") + tensor("0", (600,), offset=1) + b"u.",
    "numbers of nobody": b"\x80\x02}(" + text("time") + tensor("../../secret", (600,)) + b"u.",
    "other tensors": b"\x80\x02}(" + text("weights") + tensor("0", (600,)) + b"u.",
    "a tensor of nearly a billion numbers": b"\x80\x02](" + tensor("0", (30000, 30000)) * 3 + b"e.",
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_nothing_in_a_file_is_run(tmp_path: Path, chirp, attack, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = torch_file(tmp_path / "chirp.pt", chirp, {"data.pkl": ATTACKS[attack]})
    with pytest.raises(InputError, match=r"chirp\.pt: not read as a PACE recording: .*nothing in the file was run"):
        read_recording(path, ARM)
    assert [file.name for file in tmp_path.iterdir()] == ["chirp.pt"]


def test_a_bomb_is_refused_by_the_size_it_declares(tmp_path: Path, chirp):
    path = tmp_path / "chirp.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("chirp/data.pkl", b"\x80\x02}.")
        archive.writestr("chirp/data/0", b"")
        archive.infolist()[1].file_size = 2**30  # as the index of the zip says it
    with pytest.raises(InputError, match="unpacks to more than 512 MiB"):
        read_recording(path, ARM)


def test_shapes_have_to_fit_together(tmp_path: Path, chirp):
    chirp["des_dof_pos"] = chirp["des_dof_pos"][:, :2].copy()
    with pytest.raises(InputError, match="different numbers of joints"):
        read_recording(torch_file(tmp_path / "chirp.pt", chirp), ARM)
    chirp["des_dof_pos"] = chirp["dof_pos"][:-1]
    with pytest.raises(InputError, match="sizes do not fit together"):
        read_recording(torch_file(tmp_path / "chirp.pt", chirp), ARM)
