"""Whole blind checks: runs recorded over the link, diagnosed by a process without the key, scored; and the command."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.blind_check import BlindCheck
from agent.blind_check.key import Key
from agent.blind_check.own_check import hidden_from
from agent.blind_check.report import read_results
from agent.blind_check.worlds import EmulatorWorld
from agent.core import Console, InProcess, InputError, LocalProcesses, available_cores
from agent.recording import read_log
from benchmarks import blind_baselines, blind_results
from tests import warm
from tests.blind_check.tiny_world import TinyWorld
from tests.conftest import ROOT

QUIET = Console(verbosity=-1)
RUNS = 2


class FewRuns(EmulatorWorld):
    """Of five runs the ones that are quick to simulate."""

    def draw(self, count: int, seed: int, laws: str) -> list[dict[str, Any]]:
        drawn = super().draw(5, seed, laws)
        return [{**drawn[which], "number": number} for number, which in enumerate((0, 4))]


@pytest.fixture(scope="module")
def check(arm: str, tmp_path_factory) -> BlindCheck:
    """Two short runs of two joints, done: one without an effect, and one with two."""
    folder = tmp_path_factory.mktemp("blind")
    world = FewRuns({"robot": arm, "cycle": 0.8})
    whole = BlindCheck(world, RUNS, folder / "check")
    whole.key_file.parent.mkdir(parents=True)
    Key(world.name, RUNS, 1, "a salt").save(whole.key_file)
    whole.run(QUIET)
    return whole


def test_runs_are_recorded_diagnosed_and_scored(check):
    key = Key.load(check.key_file)
    assert (len(key.runs), key.not_recorded) == (RUNS, [])
    results = read_results(check.folder / "results.jsonl")
    assert {one["run"] for one in results} == {run["run"] for run in key.runs}
    assert all(one["outcome"] != "no answer" for one in results)
    assert all((one["withheld"] is not None) == (one["kind"] in ("one", "two")) for one in results)
    right = {"none": ("no gap",), "outside": ("unknown",)}
    right_ones = [one for one in results if one["outcome"] in right.get(one["kind"], ("named", "in class"))]
    assert right_ones == results
    sizes = {run["run"]: run["size"] for run in key.runs}
    assert all((sizes[one["run"]] is None) == (one["kind"] == "none") for one in results)
    assert (check.folder / "blind_check.md").read_text().startswith("# WEDGE")


def test_every_run_has_the_same_files_and_a_plan_for_every_sample(check):
    folders = sorted((check.folder / "export" / "runs").iterdir())
    names = [sorted(path.relative_to(run).as_posix() for path in run.rglob("*.*")) for run in folders]
    sessions = [f"{session}/{name}.mcap" for session in ("baseline", "logs") for name in ("excite", "moves", "slow")]
    assert names == [sorted(["arm.urdf", "robot.yaml", *sessions])] * RUNS
    for run in folders:
        logs = [read_log(path) for path in sorted((run / "logs").glob("*.mcap"))]
        assert all(np.isfinite(log.planned_position).all() for log in logs)
        assert len({log.metadata["serial"] for log in logs}) == 1
        assert not any("FAKE" in log.metadata["serial"] for log in logs)


def test_a_rerun_diagnoses_nothing_twice_and_scores_the_same(check):
    said = check.folder / "answers.jsonl"
    before = said.read_text().splitlines()
    lost = next(line for line in before if json.loads(line)["verdict"] == "no_gap" and "without" not in line)
    said.write_text("".join(f"{line}\n" for line in before if line != lost))
    scores = check.run(QUIET)
    assert said.read_text().splitlines() == [*(line for line in before if line != lost), lost]
    assert scores["tools"]["agent diagnose"]["runs"] == RUNS


def test_a_folder_of_another_check_is_refused(check, tmp_path: Path):
    with pytest.raises(InputError, match=f"is the key of {RUNS} runs of world emulator"):
        BlindCheck(check.world, RUNS + 1, check.folder).run(QUIET)
    with pytest.raises(InputError, match="at least one run"):
        BlindCheck(check.world, 0, tmp_path / "none").run(QUIET)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="is a file, or lies below one"):
        BlindCheck(check.world, 1, tmp_path / "file" / "deep").run(QUIET)


def test_the_diagnosing_process_cannot_see_the_key(tmp_path: Path):
    (tmp_path / "withheld").mkdir()
    (tmp_path / "withheld" / "key.json").write_text("secret")
    look = f"import os; print(os.listdir({str(tmp_path / 'withheld')!r}), os.listdir({str(tmp_path)!r}))"
    command = hidden_from([sys.executable, "-c", look], tmp_path / "withheld")
    if command[0] == sys.executable:
        pytest.skip("this system has no mount namespaces for its users")
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["[]", "['withheld']"]
    assert (tmp_path / "withheld" / "key.json").read_text() == "secret"


def test_reports_a_failed_diagnosis_as_no_answer(tmp_path: Path, capfd):
    scores = BlindCheck(TinyWorld(), 2, tmp_path / "check").run(QUIET)
    counted = scores["tools"]["agent diagnose"]["outcomes"]
    assert sum(row["no answer"] for row in counted.values()) == 2
    assert capfd.readouterr().err.count("agent: run ") >= 2


def test_the_baselines_answer_the_same_runs(check, tmp_path: Path, monkeypatch):
    answers = blind_results.scored(check, InProcess())
    alone = tmp_path / "ranking.jsonl"
    monkeypatch.setattr(sys, "argv", ["x", "ranking", str(check.folder / "export"), "-o", str(alone)])
    blind_baselines.main()
    assert alone.read_text() == (answers / "ranking.jsonl").read_text()
    files = [answers / f"{tool}.jsonl" for tool in ("agent_diagnose", "ranking", "refit")]
    run = warm.run(
        "agent", "blind-check", "--score", check.key_file, *files, "--json", "-o", tmp_path / "page", cwd=tmp_path
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert read_results(tmp_path / "page" / "results.jsonl") == read_results(answers / "results.jsonl")
    tools = json.loads(run.stdout)["tools"]
    assert list(tools) == ["agent_diagnose", "ranking", "refit"]
    for method in ("ranking", "refit"):
        counted = tools[method]["outcomes"]
        assert not any(row["no answer"] for row in counted.values())
        assert counted["none"]["no gap"] >= 1
        assert f"| {method} |" in (tmp_path / "page" / "blind_check.md").read_text()
    named = [row["named"] + row["in class"] + row["wrong name"] for row in tools["ranking"]["outcomes"].values()]
    assert not any(named)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--export", "out"], "--export DIR and --key KEY.json go together"),
        (["answers.jsonl"], "answers need --score KEY.json"),
        (["--score", "key.json"], "takes files of answers"),
        (["--score", "key.json", "--key", "other.json", "answers.jsonl"], "neither --export nor --key"),
        (["--score", "key.json", "answers.jsonl"], "key.json"),
        (["--export", "out", "--key", "out/key.json"], "the key must lie outside"),
        (["--world", "moon"], "--world moon: there is no such world; one of emulator, mujoco, positions"),
    ],
)
def test_refuses_incompatible_options(tmp_path: Path, arguments: list[str], message: str):
    run = warm.run("agent", "blind-check", *arguments, cwd=tmp_path)
    assert run.returncode == 2
    assert message in run.stderr
    assert "Traceback" not in run.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.verify
def test_blind_check_on_the_fake_controller(measured):
    """Two hundred runs of the emulator; what is finished is kept in `.verify/`, and so is its page."""
    folder = ROOT / ".verify" / "blind_check"
    with LocalProcesses(available_cores()) as engine:
        (scores,) = BlindCheck(EmulatorWorld(), 200, folder).run(Console(), engine)["tools"].values()
    for kind, row in scores["outcomes"].items():
        for name, count in row.items():
            measured(f"blind check, {kind}: {name}", count, f"of {sum(row.values())}")
    for name in ("brier", "ece"):
        measured(f"blind check: {name} of the probability", scores["calibration"][name])
    assert scores["runs"] >= 190
    assert scores["outcomes"]["none"]["no gap"] > scores["outcomes"]["none"]["unknown"]
