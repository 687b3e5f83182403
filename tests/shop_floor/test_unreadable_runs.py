"""Runs that are damaged, half finished, or of another version of the agent: one message, and nothing is written."""

import contextlib
import json
import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from agent.core import AgentError, Console, InputError
from agent.pipeline import compare_runs, rebuild_report, write_index
from agent.pipeline.reports import against_last
from agent.runs import History, RunFolder, apply_previous, apply_run, find_run, history_json, history_table, watch
from tests.damage import damaged
from tests.shop_floor.conftest import edit, friction_runs, runs_of, write_run

QUIET = Console(verbosity=-1)


def _left_out(logs: Path, damaged: Path, has_figures: bool) -> list[str]:
    """Messages about a damaged run among two whole ones; it lacks its parameters, or everything."""
    history = History(logs)
    listed, parameters = {run.run for run in history.runs()}, set(history.parameters())
    assert len(parameters) == 2
    assert listed - parameters == ({damaged.name} if has_figures else set())
    return history.damaged


@pytest.mark.parametrize("page", [True, False])
def test_a_run_of_another_version_links_to_its_own_page(write_runs, page: bool):
    (run,) = runs_of(write_runs(1))
    if page:
        (run / "report.html").write_text("as it was", encoding="utf-8")
    before = sorted(path.name for path in run.iterdir())
    with pytest.raises(InputError, match=r"another version of the agent wrote them \('recipe' is missing") as caught:
        rebuild_report(run, QUIET)
    assert ("report.html" in str(caught.value)) == page
    assert sorted(path.name for path in run.iterdir()) == before
    assert not page or (run / "report.html").read_text(encoding="utf-8") == "as it was"


@pytest.mark.parametrize("missing", ["loop", "diagnosis"])
def test_reports_a_result_of_another_version(shop: Path, run_agent, missing: str):
    (page,) = (shop / "logs").glob("*/report.html")
    before = page.read_bytes()
    state = "recalibrate" if missing == "loop" else "calibrate"
    edit(page.parent / "state.json", kind=state)
    edit(page.parent / "result.json", **{missing: None})
    run = run_agent("report", page.parent.name)
    assert (run.returncode, run.stdout) == (2, "")
    (line,) = run.stderr.splitlines()
    assert str(page.relative_to(shop)) in line
    assert page.read_bytes() == before


def test_history_lists_the_runs_it_leaves_out(shop: Path, run_agent):
    (result,) = (shop / "logs").glob("*/result.json")
    result.write_text("[]", encoding="utf-8")
    run = run_agent("history")
    assert run.returncode == 0
    assert result.parent.name not in run.stdout
    assert result.parent.name in run.stderr
    assert "no runs yet" not in run.stderr


@pytest.mark.parametrize("kind", ["calibrate", "recalibrate", "diagnose"])
@pytest.mark.parametrize("status", ["running", "stopped"])
def test_refuses_to_report_an_unfinished_run(write_runs, kind: str, status: str):
    (run,) = runs_of(write_runs(1))
    edit(run / "state.json", kind=kind, status=status, stopped={"reason": "the emergency stop is pressed"})
    (run / "result.json").unlink()
    with pytest.raises(InputError, match="nothing to report yet") as caught:
        rebuild_report(run, QUIET)
    assert ("--resume" in str(caught.value)) == (kind == "calibrate")
    assert ("emergency stop" in str(caught.value)) == (status == "stopped")


@pytest.mark.parametrize("kind", ["recalibrate", "diagnose"])
def test_only_a_calibration_can_be_resumed(write_runs, kind: str):
    (run,) = runs_of(write_runs(1))
    edit(run / "state.json", kind=kind, status="stopped", inputs_sha256={"recipe.yaml": "s"})
    before = (run / "state.json").read_bytes()
    with pytest.raises(InputError, match=f"start this one again: `agent {kind}`"):
        RunFolder.open(run, "s")
    assert (run / "state.json").read_bytes() == before


@pytest.mark.parametrize("content", ["", "[]", '"x"', "{}", '{"schema": "run/1"}', '{"schema": "run/2"}'])
def test_refuses_to_resume_a_damaged_state(write_runs, content: str):
    (run,) = runs_of(write_runs(1))
    (run / "state.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=r"state\.json"):
        RunFolder.open(run, "s")


def test_a_diagnosis_is_listed_with_its_verdict_and_no_gate(write_runs):
    logs = write_runs(2)
    run = runs_of(logs)[0]
    (run / "model.json").unlink()
    (run / "result.json").write_text(json.dumps({"verdict": "no_gap"}), encoding="utf-8")
    edit(run / "state.json", kind="diagnose")
    history = History(logs)
    assert [past.accepted for past in history.runs()] == [False, True]
    assert "diagnose     no gap" in history_table(history.runs())
    with pytest.raises(InputError, match="this run has no model"):
        compare_runs([run, runs_of(logs)[1]], QUIET)


def test_reports_a_folder_without_runs(shop: Path, run_agent):
    (shop / "empty").mkdir()
    listed = run_agent("history", "--logs", "empty")
    assert (listed.returncode, len(listed.stdout.splitlines())) == (0, 1)
    assert "agent calibrate" in listed.stderr
    page = run_agent("report", "--index", "--logs", "empty")
    assert page.returncode == 2
    assert "no runs yet" in page.stderr
    assert not any((shop / "empty").iterdir())


@pytest.fixture(scope="module")
def three_runs(tmp_path_factory):
    """Three whole runs, written again from memory for every example."""
    logs = tmp_path_factory.mktemp("runs") / "logs"
    for number, (result, parameters) in enumerate(friction_runs(3, 5)):
        write_run(logs, number, result, parameters)
    return logs, {path: path.read_bytes() for path in logs.glob("*/*.json")}


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_a_damaged_run_does_not_affect_the_others(three_runs, data):
    """One value of one file is damaged: the other runs are listed, and commands on this run say so."""
    logs, files = three_runs
    for path, content in files.items():
        path.write_bytes(content)
    first, bad, last = sorted(logs.glob("2*"))
    file = bad / data.draw(st.sampled_from(["state.json", "result.json", "model.json"]))
    document = data.draw(damaged(json.loads(file.read_text(encoding="utf-8"))))
    file.write_text(json.dumps(document), encoding="utf-8")
    history = History(logs)
    runs = history.runs()
    assert {first.name, last.name} <= {run.run for run in runs}
    history_table(runs)
    json.dumps(history_json(history, runs))
    watch(runs)
    for run in runs:
        run.in_future()
    write_index(logs)
    for act in (
        lambda: rebuild_report(bad, QUIET),
        lambda: apply_run(logs, bad),
        lambda: compare_runs([first, bad], QUIET),
        lambda: RunFolder.open(bad, "s"),
    ):
        with contextlib.suppress(AgentError):
            act()


def _loop(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _deep(file: Path) -> None:
    file.write_text("[" * 100_000, encoding="utf-8")


CONTENTS = [b"", b"[]", b"null", b'{"a": [', b"\xff\xfe"]


@pytest.mark.parametrize("damage", [*CONTENTS, _loop, _folder, _pipe, _deep])
@pytest.mark.parametrize("file", ["state.json", "result.json", "model.json"])
def test_a_damaged_file_does_not_hide_the_other_runs(write_runs, damage, file):
    logs = write_runs(3)
    _, bad, last = runs_of(logs)
    (logs / "a file where a folder is expected").write_text("x", encoding="utf-8")
    (logs / "loop").symlink_to("loop")
    (bad / file).write_bytes(damage) if isinstance(damage, bytes) else damage(bad / file)
    about_loop, said = sorted(_left_out(logs, bad, file == "model.json"), key=lambda text: bad.name in text)
    assert bad.name not in about_loop
    assert bad.name in said
    assert file in said
    assert write_index(logs).is_file()
    for act in (lambda: rebuild_report(bad, QUIET), lambda: apply_run(logs, bad)):
        with pytest.raises(InputError, match=bad.name):
            act()
    if file == "model.json":
        assert against_last(RunFolder(last, {}), None, QUIET) == {"reference": "", "diagnosis": None}


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
def test_names_an_unreadable_folder_and_lists_the_others(write_runs):
    logs = write_runs(3)
    bad = runs_of(logs)[1]
    bad.chmod(0o700)
    for folder in (logs, *logs.parents):
        if folder.is_relative_to(tempfile.gettempdir()) and folder != Path(tempfile.gettempdir()):
            folder.chmod(0o777)
    os.seteuid(65534)
    try:
        history = History(logs)
        assert len(history.runs()) == 2
        (said,) = history.damaged
        with pytest.raises(InputError, match=f"{bad.name}: cannot be read: Permission denied"):
            find_run(logs, bad.name)
    finally:
        os.seteuid(0)
    assert bad.name in said
    assert "Permission denied" in said


def test_a_damaged_current_model_does_not_affect_other_robots(write_runs):
    logs = write_runs(2)
    first, second = runs_of(logs)
    apply_run(logs, first)
    apply_run(logs, second)
    other = logs / "models" / "other_1"
    other.mkdir()
    (other / "current").symlink_to("nowhere")
    assert apply_previous(logs).run == first.name
