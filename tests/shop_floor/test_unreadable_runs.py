"""Runs that are damaged, half finished, or of another version of the agent: one message, and nothing is written."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from agent.apply import apply_run
from agent.compare import compare_runs
from agent.console import Console
from agent.errors import AgentError, InputError
from agent.history import FILE, history_table, open_history
from agent.report_again import report_again
from agent.reports import write_index
from agent.run import RunFolder

QUIET = Console(verbosity=-1)


def _edit(file: Path, **changes: object) -> None:
    data = json.loads(file.read_text(encoding="utf-8")) | changes
    file.write_text(json.dumps({key: value for key, value in data.items() if value is not None}), encoding="utf-8")


def _runs(logs: Path) -> list[Path]:
    return sorted(path for path in logs.iterdir() if path.is_dir())


@pytest.mark.parametrize("page", [True, False])
def test_a_run_of_another_version_is_pointed_to_its_own_page(write_runs, page: bool):
    (run,) = _runs(write_runs(1))
    if page:
        (run / "report.html").write_text("as it was", encoding="utf-8")
    before = sorted(path.name for path in run.iterdir())
    with pytest.raises(InputError, match=r"another version of the agent wrote them \('recipe' is missing") as caught:
        report_again(run, QUIET)
    assert ("report.html" in str(caught.value)) == page
    assert sorted(path.name for path in run.iterdir()) == before
    assert not page or (run / "report.html").read_text(encoding="utf-8") == "as it was"


@pytest.mark.parametrize("missing", ["loop", "diagnosis"])
def test_a_result_of_another_version_is_said_plainly(shop: Path, run_agent, missing: str):
    (page,) = (shop / "logs").glob("*/report.html")
    before = page.read_bytes()
    state = "recalibrate" if missing == "loop" else "calibrate"
    _edit(page.parent / "state.json", kind=state)
    _edit(page.parent / "result.json", **{missing: None})
    run = run_agent("report", page.parent.name)
    assert (run.returncode, run.stdout) == (2, "")
    (line,) = run.stderr.splitlines()
    assert str(page.relative_to(shop)) in line
    assert page.read_bytes() == before


@pytest.mark.parametrize("file", ["state.json", "result.json", "model.json"])
@pytest.mark.parametrize("content", [b"", b"[]", b"null", b'{"a": [', b"\xff\xfe"])
def test_a_damaged_file_does_not_hide_the_other_runs(write_runs, file: str, content: bytes):
    logs = write_runs(3)
    first, damaged, last = _runs(logs)
    (damaged / file).write_bytes(content)
    with open_history(logs) as history:
        assert [run.run for run in history.runs()] == [first.name, last.name]
        (said,) = history.damaged
    assert damaged.name in said
    assert file in said
    assert write_index(logs).is_file()
    for act in (lambda: report_again(damaged, QUIET), lambda: apply_run(logs, damaged)):
        with pytest.raises(InputError, match=damaged.name):
            act()


def test_the_command_tells_what_it_leaves_out(shop: Path, run_agent):
    (result,) = (shop / "logs").glob("*/result.json")
    (shop / "logs" / FILE).unlink()
    result.write_text("[]", encoding="utf-8")
    run = run_agent("history")
    assert run.returncode == 0
    assert result.parent.name not in run.stdout
    assert result.parent.name in run.stderr
    assert "no runs yet" not in run.stderr


@pytest.mark.parametrize("kind", ["calibrate", "recalibrate", "diagnose"])
@pytest.mark.parametrize("status", ["running", "stopped"])
def test_an_unfinished_run_has_nothing_to_report(write_runs, kind: str, status: str):
    (run,) = _runs(write_runs(1))
    _edit(run / "state.json", kind=kind, status=status, stopped={"reason": "the emergency stop is pressed"})
    (run / "result.json").unlink()
    with pytest.raises(InputError, match="nothing to report yet") as caught:
        report_again(run, QUIET)
    assert ("--resume" in str(caught.value)) == (kind == "calibrate")
    assert ("emergency stop" in str(caught.value)) == (status == "stopped")


@pytest.mark.parametrize("kind", ["recalibrate", "diagnose"])
def test_only_a_calibration_is_gone_on_with(write_runs, kind: str):
    (run,) = _runs(write_runs(1))
    _edit(run / "state.json", kind=kind, status="stopped", inputs_sha256={"recipe.yaml": "s"})
    before = (run / "state.json").read_bytes()
    with pytest.raises(InputError, match=f"start this one again: `agent {kind}`"):
        RunFolder.open(run, "s")
    assert (run / "state.json").read_bytes() == before


@pytest.mark.parametrize("content", ["", "[]", '"x"', "{}", '{"schema": "run/1"}', '{"schema": "run/2"}'])
def test_a_damaged_state_is_not_gone_on_with(write_runs, content: str):
    (run,) = _runs(write_runs(1))
    (run / "state.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=r"state\.json"):
        RunFolder.open(run, "s")


def test_a_diagnosis_is_in_the_table_with_its_verdict_and_passes_no_gate(write_runs):
    logs = write_runs(2)
    run = _runs(logs)[0]
    (run / "model.json").unlink()
    (run / "result.json").write_text(json.dumps({"verdict": "no_gap"}), encoding="utf-8")
    _edit(run / "state.json", kind="diagnose")
    with open_history(logs) as history:
        assert [past.accepted for past in history.runs()] == [False, True]
        assert "diagnose     no gap" in history_table(history.runs())
    with pytest.raises(InputError, match="this run has no model"):
        compare_runs(run, _runs(logs)[1], QUIET)


@pytest.mark.parametrize("seed", range(30))
def test_a_history_with_flipped_bytes_is_mended_or_named(write_runs, seed: int):
    logs = write_runs(4)
    with open_history(logs):
        pass
    rng = random.Random(seed)
    content = bytearray((logs / FILE).read_bytes())
    for _ in range(rng.choice([1, 30, 1000])):
        content[rng.randrange(len(content))] = rng.randrange(256)
    (logs / FILE).write_bytes(content)
    said = ""
    try:
        with open_history(logs) as history:
            assert len(history.runs()) == 4
            history.parameters()
    except AgentError as error:
        said = str(error)
    assert not said or "delete it" in said


def test_no_runs_at_all(shop: Path, run_agent):
    (shop / "empty").mkdir()
    listed = run_agent("history", "--logs", "empty")
    assert (listed.returncode, len(listed.stdout.splitlines())) == (0, 1)
    assert "agent calibrate" in listed.stderr
    page = run_agent("report", "--index", "--logs", "empty")
    assert page.returncode == 2
    assert "no runs yet" in page.stderr
    assert [path.name for path in (shop / "empty").iterdir()] == [FILE]
