"""Runs for any tool: nothing but the samples tells the key, and the key draws the same runs again."""

import hashlib
import json
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from agent.blind_check import export_runs
from agent.blind_check.key import Key
from agent.blind_check.worlds import EmulatorWorld, SecondWorld
from agent.core import InputError, LocalProcesses
from agent.recording import read_log
from tests.blind_check.tiny_world import NAMES, TinyWorld, metadata_of, p_value, table_of

RUNS = 200
#: Of all searches for a leak, this share finds one by chance.
CHANCE = 0.001


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> tuple[Path, Key]:
    """Two hundred runs of a world that tells everything; the draw is the same every time."""
    folder = tmp_path_factory.mktemp("tiny")
    Key("tiny", RUNS, 7, "a salt").save(folder / "key.json")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)  # two thousand small files need not outlive a power cut
        return folder / "out", export_runs(TinyWorld(), folder / "out", folder / "key.json", RUNS)


def labels_of(key: Key) -> dict[str, np.ndarray]:
    """What somebody would like to know of every run: is there an effect, and is it this one?"""
    names = sorted({effect["effect"] for run in key.runs for effect in run["effects"]})
    told = {"any": np.array([bool(run["effects"]) for run in key.runs])}
    for name in names:
        told[name] = np.array([any(effect["effect"] == name for effect in run["effects"]) for run in key.runs])
    return {name: label for name, label in told.items() if 10 <= label.sum() <= len(label) - 10}


def leaks(folder: Path, key: Key) -> dict[str, float]:
    """How likely chance tells as much as the metadata of the runs, by what is asked."""
    table = table_of([metadata_of(folder / "runs" / run["run"]) for run in key.runs])
    return {name: p_value(table, label) for name, label in labels_of(key).items()}


def test_metadata_of_two_hundred_runs_do_not_predict_the_key(tiny):
    folder, key = tiny
    assert len(key.runs) == RUNS
    found = leaks(folder, key)
    assert set(found) == {"any", *NAMES}
    assert min(found.values()) > CHANCE, found


def touched(path: Path, run: dict) -> None:
    os.utime(path / "robot.yaml", (1.6e9 + len(run["effects"]),) * 2)


def more_there(path: Path, run: dict) -> None:
    if run["effects"]:
        (path / "without").mkdir()


def longer(path: Path, run: dict) -> None:
    with (path / "arm.urdf").open("a") as file:
        file.write(" " * len(run["effects"]))


def named(path: Path, run: dict) -> None:
    if run["effects"] and run["effects"][0]["effect"] == "payload":
        (path / "logs" / "excite.mcap").rename(path / "logs" / "moves.mcap")


@pytest.mark.parametrize(
    "leak", [longer, *(pytest.param(leak, marks=pytest.mark.verify) for leak in (touched, more_there, named))]
)
def test_detects_a_leak(tiny, tmp_path: Path, leak: Callable[[Path, dict], None]):
    folder, key = tiny
    shutil.copytree(folder, tmp_path / "out", copy_function=shutil.copy2)
    for run in key.runs:
        leak(tmp_path / "out" / "runs" / run["run"], run)
    assert min(leaks(tmp_path / "out", key).values()) < CHANCE


def test_exported_runs_omit_what_the_world_reports_about_itself(tiny):
    folder, key = tiny
    run = next(run for run in key.runs if run["effects"])
    held = folder / "runs" / run["run"]
    assert sorted(path.relative_to(held).as_posix() for path in held.rglob("*") if path.is_file()) == [
        "arm.urdf",
        "baseline/excite.mcap",
        "logs/excite.mcap",
        "robot.yaml",
    ]
    log = (held / "logs" / "excite.mcap").read_bytes()
    for secret in (run["effects"][0]["effect"], str(run["machine"]), str(run["motion"]), "made_by"):
        assert secret.encode() not in log
    read = read_log(held / "logs" / "excite.mcap")
    assert read.metadata["serial"] == run["serial"]
    assert read.reference_position is not None
    assert read.planned_position is not None


def test_the_samples_are_copied_as_they_are(tmp_path: Path):
    world, key = TinyWorld(), Key("tiny", 1, 3, "salt")
    key.save(tmp_path / "key.json")
    (truth,) = world.draw(1, key.entropy, key.laws)
    (tmp_path / "as_recorded").mkdir()
    world.write(truth, tmp_path / "as_recorded")
    (run,) = export_runs(world, tmp_path / "out", tmp_path / "key.json", 1).runs
    before = read_log(tmp_path / "as_recorded" / "logs" / "excite.mcap")
    after = read_log(tmp_path / "out" / "runs" / run["run"] / "logs" / "excite.mcap")
    for name in ("position", "velocity", "effort", "reference_position", "planned_position"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    np.testing.assert_allclose(before.t, after.t, atol=1e-6)


def test_the_key_is_private_and_outside_the_runs(tmp_path: Path):
    key = tmp_path / "key.json"
    export_runs(TinyWorld(), tmp_path / "out", key, 3)
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert sorted(path.name for path in tmp_path.iterdir()) == ["key.json", "out"]
    index = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert index["key_sha256"] == hashlib.sha256(key.read_bytes()).hexdigest()
    with pytest.raises(InputError, match="the key must lie outside"):
        export_runs(TinyWorld(), tmp_path / "more", tmp_path / "more" / "key.json", 3)


def test_a_seed_without_the_key_draws_other_runs(tmp_path: Path):
    keys = [export_runs(TinyWorld(), tmp_path / name, tmp_path / f"{name}.json", 5, seed=1) for name in ("a", "b")]
    assert keys[0].entropy != keys[1].entropy
    assert not {run["run"] for run in keys[0].runs} & {run["run"] for run in keys[1].runs}
    assert len({run["serial"] for key in keys for run in key.runs}) == 10


def test_the_key_draws_the_same_runs_again(tmp_path: Path):
    made = export_runs(TinyWorld(), tmp_path / "a", tmp_path / "key.json", 5, seed=1)
    again = export_runs(TinyWorld(), tmp_path / "b", tmp_path / "key.json", 5)
    assert again == made
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file()]
    assert len(files) == 5 * 4 + 1
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def test_a_draw_without_a_seed_differs_from_development_draws(tmp_path: Path):
    keys = [export_runs(TinyWorld(), tmp_path / f"{seed}", tmp_path / f"{seed}.json", 1, seed) for seed in (None, 1)]
    assert [key.laws for key in keys] == ["judgement", "development"]
    told = [json.loads((tmp_path / name / "benchmark.json").read_text())["laws"] for name in ("None", "1")]
    assert told == ["judgement", "development"]
    assert len({Key("tiny", 1, 1, "salt", laws=laws).entropy for laws in told}) == 2


@pytest.mark.parametrize("world", [EmulatorWorld(), SecondWorld()], ids=lambda world: world.name)
def test_no_process_argument_contains_the_secret(world, monkeypatch):
    """Everybody on a machine can read them."""
    known: list[list[str]] = []

    def noted(command, **options):
        known.append(command)
        return subprocess.CompletedProcess(command, 0, "[]", "")

    monkeypatch.setattr(subprocess, "run", noted)
    world.draw(3, 123456789, "judgement")
    assert known
    assert not any("123456789" in word for command in known for word in command)


@pytest.fixture(scope="module")
def family(tmp_path_factory) -> tuple[Path, Key]:
    """Three short runs of the second world, by laws of judgement: a healthy one and a path that is not the planned one
    among them."""
    pytest.importorskip("mujoco", reason="mujoco is not installed: pip install calibration-agent[mujoco]")
    folder = tmp_path_factory.mktemp("family")
    Key("mujoco", 3, 1, "salt 9").save(folder / "key.json")
    return folder, export_runs(SecondWorld(0.4), folder / "out", folder / "key.json", 3)


def test_draws_the_second_world_and_keeps_the_truth_in_the_key(family):
    folder, key = family
    assert key.laws == "judgement"
    assert len({run["machine"] for run in key.runs}) == 3
    assert {run["machine"] % 2 for run in key.runs} == {run["motion"] % 2 for run in key.runs} == {1}
    for run in key.runs:
        held = folder / "out" / "runs" / run["run"]
        rate = read_log(held / "logs" / "wide.mcap").sample_rate
        assert (f"name: {run['world']['arm']}" in (held / "robot.yaml").read_text(), rate) == (
            True,
            run["world"]["rate"],
        )
        assert [path.stem for path in sorted((held / "baseline").iterdir())] == ["moves", "slow", "wide", "wide_2"]
        assert all(effect["parameters"]["amount"] for effect in run["effects"])
        secrets = [run["motion"], run["machine"], *(value for effect in run["effects"] for value in effect.values())]
        written = b"".join(path.read_bytes() for path in held.rglob("*.*") if path.is_file())
        assert not any(str(secret).encode() in written for secret in secrets if len(str(secret)) > 7)


@pytest.mark.verify
def test_the_key_draws_the_family_again_bit_by_bit(family, tmp_path: Path):
    folder, key = family
    assert export_runs(SecondWorld(0.4), tmp_path / "out", folder / "key.json", 3) == key
    files = [path.relative_to(tmp_path) for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert len(files) == 3 * 9 + 1
    for file in files:
        assert (folder / file).read_bytes() == (tmp_path / file).read_bytes(), file


def test_resumes_an_interrupted_export(tmp_path: Path, monkeypatch):
    world, whole = TinyWorld(), TinyWorld.write

    def stopped(self, truth, folder):
        if truth["number"] == 2 and len(self.wrote) == 2:
            self.wrote.append("stopped")
            raise KeyboardInterrupt
        return whole(self, truth, folder)

    monkeypatch.setattr(TinyWorld, "write", stopped)
    with pytest.raises(KeyboardInterrupt):
        export_runs(world, tmp_path / "out", tmp_path / "key.json", 4)
    assert not (tmp_path / "out").exists()
    assert stat.S_IMODE((tmp_path / "key.json.parts").stat().st_mode) == 0o700
    assert len(export_runs(world, tmp_path / "out", tmp_path / "key.json", 4).runs) == 4
    assert world.wrote == [0, 1, "stopped", 2, 3]
    assert not (tmp_path / "key.json.parts").exists()


def test_two_exports_of_one_key_do_not_run_at_once(tmp_path: Path, monkeypatch):
    world, whole = TinyWorld(), TinyWorld.write

    def meanwhile(self, truth, folder):
        with pytest.raises(InputError, match="another export is recording these runs"):
            export_runs(TinyWorld(), tmp_path / "out", tmp_path / "key.json", 2)
        return whole(self, truth, folder)

    monkeypatch.setattr(TinyWorld, "write", meanwhile)
    assert len(export_runs(world, tmp_path / "out", tmp_path / "key.json", 2).runs) == 2


def test_a_run_that_cannot_be_recorded_is_left_out_and_listed_in_the_key(tmp_path: Path):
    key = export_runs(TinyWorld(fails=[1]), tmp_path / "out", tmp_path / "key.json", 3)
    assert [run["number"] for run in key.not_recorded] == [1]
    assert key.not_recorded[0]["error"] == "the tool is 302 mm off"
    assert {path.name for path in (tmp_path / "out" / "runs").iterdir()} == {run["run"] for run in key.runs}


def test_what_cannot_be_exported_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="at least one run"):
        export_runs(TinyWorld(), tmp_path / "out", tmp_path / "key.json", 0)
    export_runs(TinyWorld(), tmp_path / "out", tmp_path / "key.json", 1, seed=4)
    with pytest.raises(InputError, match="holds a benchmark already"):
        export_runs(TinyWorld(), tmp_path / "out", tmp_path / "other.json", 1)
    with pytest.raises(InputError, match="key of 1 runs of world tiny, seed 4"):
        export_runs(TinyWorld(), tmp_path / "new", tmp_path / "key.json", 1, seed=5)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    with pytest.raises(InputError, match="is not empty"):
        export_runs(TinyWorld(), tmp_path / "full", tmp_path / "fresh.json", 1)
    (tmp_path / "fresh.json").write_text("{}")
    with pytest.raises(InputError, match="not a key of a blind check"):
        export_runs(TinyWorld(), tmp_path / "new", tmp_path / "fresh.json", 1)


@pytest.mark.verify
@pytest.mark.parametrize("world", [EmulatorWorld({"cycle": 2.0}), SecondWorld(1.0)], ids=lambda world: world.name)
def test_metadata_of_two_hundred_recorded_runs_do_not_predict_the_key(world, tmp_path: Path, measured):
    with LocalProcesses(2) as engine:
        key = export_runs(world, tmp_path / "out", tmp_path / "key.json", RUNS, engine=engine)
    found = leaks(tmp_path / "out", key)
    for name, value in found.items():
        measured(f"metadata of {world.name}: p-value of {name}", value, "", f"at least {CHANCE / len(found):.2g}")
    assert min(found.values()) > CHANCE / len(found), found
