"""The history is what the run folders say: quick, and never in the way."""

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from agent.core.errors import InputError
from agent.pipeline.reports import write_index
from agent.runs import History, apply_run, find_run, history_json, history_table
from tests.conftest import ROOT
from tests.shop_floor.conftest import agent, edit


def test_lists_runs_with_parameters_in_order(write_runs):
    history = History(write_runs(3))
    runs = history.runs()
    assert [run.run for run in runs] == sorted(run.run for run in runs)
    assert [run.accepted for run in runs] == [True] * 3
    data = history_json(history, runs)
    first = data["runs"][0]
    assert data["schema"] == "history/1"
    assert [p["name"] for p in first["parameters"]][:2] == ["p0", "p1"]
    assert first["parameters"][-1]["name"] == "f0_6"
    assert first["parameters"][0]["standard_deviation"] == pytest.approx(0.01)
    assert first["conditions"]["cycles"] == 4


def test_tolerates_folders_that_appear_and_vanish(write_runs):
    logs = write_runs(3)
    history = History(logs)
    names = [run.run for run in history.runs()]
    shutil.rmtree(logs / names[0])
    edit(logs / names[1] / "state.json", status="rejected")
    (logs / "no_run").mkdir()
    history = History(logs)
    assert [(run.run, run.status) for run in history.runs()] == [(names[1], "rejected"), (names[2], "finished")]
    assert set(history.parameters()) == set(names[1:])


def test_lists_a_stopped_run_with_its_reason(write_runs):
    logs = write_runs(1)
    run = logs / "20270101T000000Z_comau_ns16"
    run.mkdir()
    stopped = {"step": "record", "reason": "the emergency stop is pressed", "at": "x"}
    state = {"robot": "comau_ns16", "started": "2027-01-01T00:00:00+00:00", "status": "stopped", "stopped": stopped}
    (run / "state.json").write_text(json.dumps(state), encoding="utf-8")
    history = History(logs)
    runs = history.runs()
    assert (runs[-1].status, runs[-1].reason) == ("stopped", "the emergency stop is pressed")
    assert "stopped" in history_table(runs)


def test_the_table_ends_with_the_latest_trend(write_runs):
    logs = write_runs(3)
    runs = sorted(path for path in logs.iterdir() if path.is_dir())
    for run, said in zip(runs, (["joint_1 stepped"], [], ["joint_3 drifts", "joint_3 reaches the gate"]), strict=True):
        edit(run / "state.json", watch=said)
    history = History(logs)
    table = history_table(history.runs())
    assert table.splitlines()[-3:] == [
        "",
        "comau_ns16 NS16-1: joint_3 drifts",
        "comau_ns16 NS16-1: joint_3 reaches the gate",
    ]
    assert "joint_1 stepped" not in table


def test_a_reader_of_a_long_list_may_leave(write_runs):
    listing = f"{sys.executable} -m agent history --logs {write_runs(100)} | true; exit ${{PIPESTATUS[0]}}"
    run = subprocess.run(["bash", "-c", listing], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")


def test_the_current_model_is_marked_in_the_table_and_on_the_index(write_runs):
    logs = write_runs(3)
    runs = sorted(path for path in logs.iterdir() if path.is_dir())
    apply_run(logs, runs[1])
    listed = agent(ROOT, "history", "--logs", str(logs))
    marked = [line.split()[0] for line in listed.stdout.splitlines() if "accepted, current" in line]
    assert marked == [runs[1].name]
    page = write_index(logs).read_text(encoding="utf-8")
    assert page.count("accepted, current") == 1
    (logs / "models" / "comau_ns16_NS16-1" / "current" / "about.json").write_text("[]", encoding="utf-8")
    damaged = agent(ROOT, "history", "--logs", str(logs))
    assert damaged.returncode == 0
    assert "apply a run again" in damaged.stderr
    assert "current" not in damaged.stdout


@pytest.mark.parametrize(
    ("filters", "said"),
    [
        (("--robot", "nope"), "none of the runs here (2) is of robot nope"),
        (("--serial", "nope"), "none of the runs here (2) is of serial nope"),
        (("--robot", "nope", "--serial", "7"), "is of robot nope, serial 7"),
    ],
)
def test_a_filter_without_hits_differs_from_an_empty_history(write_runs, filters: tuple[str, ...], said: str):
    run = agent(ROOT, "history", "--logs", str(write_runs(2)), *filters)
    assert run.returncode == 0
    assert said in run.stderr
    assert "no runs yet" not in run.stderr


def test_reports_that_there_are_no_runs_yet(tmp_path: Path):
    assert "no runs yet" in agent(ROOT, "history", "--logs", str(tmp_path), "--robot", "nope").stderr


def test_reports_a_missing_folder(tmp_path: Path):
    with pytest.raises(InputError, match="no runs are kept there"):
        History(tmp_path / "nothing")
    with pytest.raises(InputError, match="no such run"):
        find_run(tmp_path, "nothing")


def test_listing_runs_writes_nothing(write_runs):
    logs = write_runs(1)
    before = sorted(logs.rglob("*"))
    assert "accepted" in agent(ROOT, "history", "--logs", str(logs)).stdout
    assert sorted(logs.rglob("*")) == before


def test_listing_loads_nothing_heavy(write_runs):
    logs = write_runs(2)
    script = (
        "import sys; sys.argv = ['agent', 'history', '--logs', sys.argv[1]]\n"
        "from agent.cli import main\n"
        "try: main()\nexcept SystemExit as end: assert not end.code\n"
        "heavy = {'numpy', 'scipy', 'pinocchio', 'matplotlib', 'mcap', 'rich.console'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    run = subprocess.run([sys.executable, "-c", script, logs], cwd=ROOT, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert len(re.findall("accepted", run.stdout)) == 2


@pytest.mark.verify
def test_lists_a_thousand_runs_quickly(write_runs, measured):
    """`agent history` in 0.5 s and the index page in 5 s, CPU time of the process."""
    import resource

    logs = write_runs(1000)

    def cpu(*arguments: str) -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        command = [sys.executable, "-m", "agent", *arguments, "--logs", str(logs)]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    listing = min(cpu("history") for _ in range(3))
    page = min(cpu("report", "--index") for _ in range(2))
    started = time.process_time()
    history = History(logs)
    assert len(history.runs()) == 1000
    measured("`agent history` with 1000 runs", listing, "s CPU", "at most 0.5 s", listing <= 0.5)
    measured("index page with 1000 runs", page, "s CPU", "at most 5 s", page <= 5)
    measured("reading a history of 1000 runs", time.process_time() - started, "s CPU")
    assert listing <= 0.5
    assert page <= 5
