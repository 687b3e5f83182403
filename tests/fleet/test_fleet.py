"""A fleet's rows are the single command's answers; only what is new is done; what cannot be read is a row."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from agent.core.errors import InputError
from agent.fleet import make_question, simulate, store, worker
from agent.recording import read_log, write_log
from tests.fleet.conftest import a_run_each, rows_of


def _single(command, plant: Path, row: dict, tmp_path: Path, *options: object) -> dict:
    logs = [plant / row["run"] / name for name in row["logs"]]
    return command(*options, "--json", "-q", *logs)


def test_a_fleet_estimate_equals_the_single_command(command, plant: Path, estimated: Path, tmp_path: Path):
    rows = [row for row in rows_of(estimated) if row["status"] == "ok"]
    assert [(row["robot"], row["run"].split("/")[0]) for row in rows] == [
        (f"robot_000{k}", f"robot_000{k}") for k in range(4) for _ in range(2)
    ]
    for row in rows[::5]:
        model = tmp_path / "model.json"
        robot = plant / row["robot"] / "robot.yaml"
        single = _single(command, plant, row, tmp_path, "estimate", "--robot", robot, "-o", model)
        single["provenance"].pop("created")
        assert json.loads((estimated / row["model"]).read_text("utf-8")) == single
        assert [entry["value"] for entry in row["parameters"]] == [
            entry["value"] for entry in single["base_parameters"] + single["friction"]
        ]
        assert row["rmse"] == single["held_out_rmse"]
        assert [level["joint"] for level in row["friction"]] == ["shoulder", "shoulder", "elbow", "elbow"]
        assert row["started"].isoformat() == simulate._week(int("0113" in row["run"])).isoformat()
        assert row["serial"] == row["robot"]


def test_fleet_validation_and_diagnosis_equal_the_single_commands(command, plant, estimated, tmp_path: Path):
    small = tmp_path / "plant" / "robot_0001"
    a_run_each(plant, small.parent)
    for robot in set(small.parent.glob("robot_*")) - {small}:
        shutil.rmtree(robot)
    model = estimated / next(row["model"] for row in rows_of(estimated) if row["robot"] == "robot_0002")
    command("fleet", "validate", small.parent, "--model", model, "-o", tmp_path / "v", "--allow-mixed")
    command("fleet", "diagnose", small.parent, "--model", model, "-o", tmp_path / "d", "--allow-mixed")
    (row,) = rows_of(tmp_path / "v")
    assert "the model was fitted to" not in " ".join(row["warnings"])
    mixed = ("--model", model, "--allow-mixed")
    assert json.loads(row["result"]) == _single(command, small.parent, row, tmp_path, "validate", *mixed)
    assert row["normalised_rmse"] == json.loads(row["result"])["overall"]["normalised_rmse"]
    (row,) = rows_of(tmp_path / "d")
    robot = ("--robot", small / "robot.yaml")
    single = _single(command, small.parent, row, tmp_path, "diagnose", *robot, *mixed)
    assert json.loads(row["result"]) == single
    assert (row["verdict"], row["gap_before"]) == (single["verdict"], single["gap"]["before"])


def test_a_logged_payload_is_used_by_diagnose_and_refused_by_other_commands(plant, estimated, tmp_path):
    """As with the single command: of a fleet nobody looks at every row."""
    described = str(plant / "robot_0001" / "robot.yaml")
    model = estimated / next(row["model"] for row in rows_of(estimated) if row["robot"] == "robot_0001")
    silent = next((plant / "robot_0001").glob("*/*.mcap"))
    log = read_log(silent)
    write_log(tmp_path / "a.mcap", replace(log, metadata={**log.metadata, "payload": "2 kg, 0 mm, 0 mm, 0 mm"}))

    def answer(kind: str, path: Path, model: Path | None) -> dict:
        question = make_question(kind, described, None if model is None else str(model))
        return worker.answer(question, described, model, [path])[0]

    for kind, known, reason in (
        ("estimate", None, "leave it out"),
        ("validate", model, "leave it out"),
        ("diagnose", None, "name one with --model"),
    ):
        with pytest.raises(InputError, match=reason):
            answer(kind, tmp_path / "a.mcap", known)
    said, without = (answer("diagnose", path, model) for path in (tmp_path / "a.mcap", silent))
    assert without["verdict"] == "no_gap"
    assert said["verdict"] != "no_gap", "the model carries what the log says, which this arm did not"


def test_an_unreadable_log_is_a_row_with_its_reason(estimated: Path):
    (row,) = (row for row in rows_of(estimated) if row["status"] != "ok")
    assert (row["robot"], row["run"]) == ("robot_0003", "robot_0003/bad")
    assert (row["status"], row["exit_code"]) == ("unreadable", 2)
    assert row["reason"].startswith("robot_0003/bad/a.mcap: not an MCAP file")


def test_processes_only_new_runs(command, plant: Path, estimated: Path, tmp_path: Path, monkeypatch):
    here, out = a_run_each(plant, tmp_path / "plant"), tmp_path / "result"
    shutil.copytree(estimated, out)

    def again() -> tuple[int, int]:
        told = command("fleet", "estimate", here, "-o", out, "--json", "-q")
        return told["done"], told["kept"]

    before = rows_of(out)
    assert again() == (0, 5), "a run each, and one that is no log"
    log = next((here / "robot_0000").rglob("*.mcap"))
    shutil.copy(next((here / "robot_0001").rglob("*.mcap")), log)
    assert again() == (1, 4), "another content"
    yaml = here / "robot_0002" / "robot.yaml"
    yaml.write_text(yaml.read_text("utf-8").replace("nominal_motor_torque: 1.0", "nominal_motor_torque: 2.0"))
    assert again() == (1, 4), "its description"
    urdf = here / "robot_0002" / "robot.urdf"
    urdf.write_text(urdf.read_text("utf-8") + "\n")
    assert again() == (1, 4), "and the URDF of that"
    shutil.copytree(here / "robot_0001", here / "robot_0009")
    assert again() == (1, 5), "a new machine"
    rows = {row["run"]: row for row in rows_of(out)}
    assert len(rows) == 10, "what has left the source stays in the result"
    assert all(rows[row["run"]] == row for row in before if row["robot"] in ("robot_0001", "robot_0003"))
    assert list(rows) == sorted(rows)


def test_another_version_or_question_recomputes_the_rows(command, plant, estimated, tmp_path, monkeypatch):
    from agent.fleet import tasks

    here, out = tmp_path / "plant", tmp_path / "result"
    shutil.copytree(plant / "robot_0003" / "bad", here / "bad")
    shutil.copy(plant / "robot_0003" / "robot.yaml", here)

    def done(*options: str) -> int:
        return command("fleet", "estimate", here, "-o", out, "--json", "-q", *options)["done"]

    assert (done(), done()) == (1, 0)
    assert (done("--cutoff", "20"), done("--cutoff", "20")) == (1, 0)
    monkeypatch.setattr(tasks, "figures_version", lambda *_: "another")
    assert (done("--cutoff", "20"), done("--cutoff", "20")) == (1, 0)


def test_assigns_each_run_to_its_robot(tmp_path: Path):
    def robots(*logs: str) -> list[str]:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        for log in logs:
            (folder / log).parent.mkdir(parents=True, exist_ok=True)
            (folder / log).write_text("{}" if log.endswith("json") else "", encoding="utf-8")
        plant = tasks.find_tasks(store.Store(str(folder)), tasks.RunQuestion("estimate"))
        return [f"{task.robot} {task.run}" for task in plant.tasks]

    from agent.fleet import tasks

    assert robots("a/robot.yaml", "a/1/x.mcap", "a/2/x.mcap") == ["a a/1", "a a/2"]
    assert robots("hall/a/robot.yaml", "hall/a/x.mcap") == ["hall/a hall/a"]
    assert robots("robot.yaml", "a/x.mcap", "b/1/x.mcap", "_out/x.mcap") == ["a a", "b b/1"]
    assert robots("a/run/state.json", "a/run/excitation.mcap", "a/run/validation_00.mcap") == ["a a/run"]


def test_run_folders_of_the_agent_say_which_robot_they_are(command, plant: Path, estimated: Path, tmp_path: Path):
    row = rows_of(estimated)[0]
    run = tmp_path / "logs" / "20250106T020000Z_arm"
    run.mkdir(parents=True)
    shutil.copy(plant / row["run"] / row["logs"][0], run / "excitation.mcap")
    shutil.copy(estimated / row["model"], run / "model.json")
    told = json.dumps({"robot": "arm", "serial": "S1"})

    def found(state: str) -> dict:
        (run / "state.json").write_text(state, encoding="utf-8")
        command("fleet", "estimate", tmp_path / "logs", "-o", tmp_path / "out", "-q")
        (only,) = rows_of(tmp_path / "out")
        return only

    first, deep = found(told), found("[" * 100_000)
    assert (first["robot"], first["status"], first["rmse"]) == ("S1", "ok", row["rmse"])
    assert (deep["status"], deep["rmse"]) == ("ok", row["rmse"]), "a state that is none says nothing of the run"
    (run / "model.json").unlink()
    without = found(told)
    assert without["status"] == "unreadable"
    assert without["reason"].startswith("there is no robot.yaml in or above this run;")


def test_logs_without_a_robot_yaml_are_a_usage_error(command, plant: Path, tmp_path: Path):
    (tmp_path / "a").mkdir()
    shutil.copy(next(plant.rglob("*.mcap")), tmp_path / "a")
    with pytest.raises(InputError, match=r"no robot\.yaml in or above any run"):
        command("fleet", "estimate", tmp_path, "-o", tmp_path / "out")


def test_a_source_without_logs_is_a_usage_error(command, tmp_path: Path):
    for source in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError, match=r"no such folder|no folder in it has logs"):
            command("fleet", "estimate", source, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["validate", "diagnose"])
def test_a_missing_model_is_a_usage_error(command, plant: Path, tmp_path: Path, kind: str):
    with pytest.raises(InputError, match=r"no run in it has nowhere.json in or above it"):
        command("fleet", kind, plant, "-o", tmp_path / "out", "--model", "nowhere.json")
    assert not (tmp_path / "out" / "rows.parquet").exists()


def test_a_result_of_another_command_is_not_overwritten(command, plant: Path, estimated: Path):
    before = (estimated / "rows.parquet").read_bytes()
    with pytest.raises(InputError, match="holds a result of `fleet estimate`"):
        command("fleet", "diagnose", plant, "-o", estimated)
    assert (estimated / "rows.parquet").read_bytes() == before


def test_without_dask_it_says_what_to_install(plant: Path, tmp_path: Path, monkeypatch):
    import sys

    from agent.core.on_dask import DaskEngine

    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'calibration-agent\[fleet\]'"), DaskEngine():
        pass


def test_a_seed_draws_the_same_fleet(tmp_path: Path):
    one, two = (simulate.draw_fleet(30, 12, ("a", "b", "c"), 3) for _ in range(2))
    assert one.planted == two.planted
    assert (one.friction == two.friction).all()
    kinds = [planted.kind for planted in one.planted]
    assert kinds.count("wear") == 1
    assert kinds.count("cause") == 2


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["--method", "wrong"], "choose one of"),
        (["--structure", "wrong"], "rigid or auto"),
        (["--cutoff", -3], "at least 0.1 Hz"),
    ],
)
def test_invalid_options_are_a_usage_error(command, plant: Path, tmp_path: Path, asked: list[str], said: str):
    with pytest.raises(InputError, match=said):
        command("fleet", "estimate", plant, "-o", tmp_path / "out", *asked)
    assert not (tmp_path / "out").exists()


def test_a_file_in_place_of_a_folder_is_a_usage_error(command, estimated: Path, tmp_path: Path):
    file = tmp_path / "file"
    file.touch()
    for arguments in (("simulate", "-n", 1), ("trends", estimated)):
        for out in (file, file / "below"):
            with pytest.raises(InputError, match="where a folder should be"):
                command("fleet", *arguments, "-o", out)
    with pytest.raises(InputError, match="is a folder; name a file"):
        command("fleet", "report", estimated, "-o", tmp_path)
    with pytest.raises(InputError, match="where its folder should be"):
        command("fleet", "report", estimated, "-o", file / "page.html")


@pytest.mark.parametrize("package", ["fsspec", "pyarrow"])
def test_a_fleet_without_a_package_says_what_to_install(package: str, tmp_path: Path):
    code = f"import sys; sys.modules[{package!r}] = None; from agent.cli import main; main()"
    words = [sys.executable, "-c", code, "fleet", "simulate", "-n", "1", "-o", str(tmp_path / "out"), "--rows"]
    run = subprocess.run(words, capture_output=True, text=True)
    assert run.returncode == 2
    assert re.fullmatch(rf"agent: a fleet needs {package}, .*: pip install 'calibration-agent\[fleet\]'\n", run.stderr)


def test_a_simulation_refuses_an_existing_folder(arm: str, tmp_path: Path):
    simulate.simulate_fleet(arm, 1, 1, 1, str(tmp_path / "plant"), rows=False)
    with pytest.raises(InputError, match="something in it"):
        simulate.simulate_fleet(arm, 1, 1, 1, str(tmp_path / "plant"), rows=False)
