"""Run folders, alignment of plan and execution, and the conditions before motion."""

import contextlib
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.core import AgentError, ControllerError, InputError, SafetyError, sha256_text, write_atomically
from agent.link.alignment import moving_segments
from agent.runs.folder import RunFolder
from agent.safety.preconditions import check_ready, confirm_clear_cell
from drivers.protocol import Identity, Status

READY = Status(
    drives_on=True,
    mode="auto",
    emergency_stop=False,
    alarms=(),
    override=1.0,
    cell_closed=True,
    moving=False,
    program="p",
    checksum="c",
    position=np.zeros(6),
)


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "recipe.yaml"
    path.write_text("robot: comau_ns16\n", encoding="utf-8")
    return path


def test_two_runs_in_one_second_get_two_folders(recipe: Path, tmp_path: Path):
    now = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
    first = RunFolder.create(tmp_path / "logs", "arm", recipe, now)
    second = RunFolder.create(tmp_path / "logs", "arm", recipe, now)
    assert first.path.name == "20260102T030405Z_arm"
    assert first.path != second.path


def test_resuming_keeps_the_finished_steps(recipe: Path, tmp_path: Path):
    run = RunFolder.create(tmp_path / "logs", "arm", recipe)
    run.finish("plan", found=np.array([1.0, np.nan]))
    run.stopped("record", "cable pulled")
    again = RunFolder.open(run.path, sha256_text(recipe.read_text(encoding="utf-8")))
    assert again.finished("plan")["found"] == [1.0, None]
    assert again.finished("record") is None
    assert again.state["status"] == "running"


def test_a_run_of_another_recipe_or_a_complete_one_is_refused(recipe: Path, tmp_path: Path):
    run = RunFolder.create(tmp_path / "logs", "arm", recipe)
    with pytest.raises(InputError, match="another recipe"):
        RunFolder.open(run.path, sha256_text("robot: other\n"))
    run.complete(accepted=True)
    with pytest.raises(InputError, match="complete"):
        RunFolder.open(run.path, sha256_text(recipe.read_text(encoding="utf-8")))
    with pytest.raises(InputError, match="not a run folder"):
        RunFolder.open(tmp_path, "")


def test_a_failed_write_leaves_the_old_file_and_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = write_atomically(tmp_path / "model.json", "old")
    full = OSError(28, "No space left on device")
    monkeypatch.setattr("agent.core.files.os.fsync", Mock(side_effect=full))
    with pytest.raises(AgentError, match="No space left"):
        write_atomically(path, "new")
    assert path.read_text(encoding="utf-8") == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.json"]
    with pytest.raises(AgentError, match="No space left"):
        RunFolder.create(tmp_path / "logs", "arm", path)
    assert list((tmp_path / "logs").iterdir()) == []


@pytest.mark.skipif(not Path("/dev/full").is_char_device(), reason="no device here that is always full")
def test_a_full_device_gives_one_message_and_is_not_replaced(tmp_path: Path):
    link = tmp_path / "model.json"
    link.symlink_to("/dev/full")
    with pytest.raises(AgentError, match="No space left on device; free space"):
        write_atomically(link, "new")
    assert link.is_symlink()
    assert Path("/dev/full").is_char_device()


def test_state_is_json_without_nan(recipe: Path, tmp_path: Path):
    run = RunFolder.create(tmp_path / "logs", "arm", recipe)
    run.finish("estimate", value=float("inf"))
    json.loads((run.path / "state.json").read_text(encoding="utf-8"), parse_constant=pytest.fail)


@given(
    lengths=st.lists(st.tuples(st.integers(4, 60), st.integers(2, 50)), min_size=1, max_size=5), rest=st.integers(4, 20)
)
def test_finds_the_moving_stretches(lengths: list[tuple[int, int]], rest: int):
    reference, expected, here = [0.0] * rest, [], 0.0
    for pause, moving in lengths:
        expected.append((len(reference) - 1, len(reference) + moving))
        reference += [here + 0.01 * (k + 1) for k in range(moving)]
        here = reference[-1]
        reference += [here] * (rest + pause)
    found = moving_segments(np.array(reference)[:, None], rest - 1)
    assert found == expected


def test_a_stationary_log_has_no_moving_stretches():
    assert moving_segments(np.ones((100, 6)), 3) == []
    assert moving_segments(np.ones((1, 6)), 3) == []


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"emergency_stop": True}, SafetyError, "emergency stop"),
        ({"mode": "teach"}, ControllerError, "auto"),
        ({"drives_on": False}, ControllerError, "drives"),
        ({"alarms": ("4711",)}, ControllerError, "4711"),
        ({"cell_closed": False}, ControllerError, "gate"),
        ({"override": 0.5}, ControllerError, "50 %"),
        ({"moving": True}, ControllerError, "moving"),
        ({"checksum": "other"}, ControllerError, "stored program"),
        ({"program": "other"}, ControllerError, "other"),
    ],
)
def test_every_unready_condition_prevents_the_start(change: dict, error: type[AgentError], said: str):
    check_ready(READY, "here", "p", "c")
    with pytest.raises(error, match=said):
        check_ready(replace(READY, **change), "here", "p", "c")


@pytest.mark.parametrize(
    ("address", "local"),
    [("127.0.0.1:9100", True), ("localhost:1", True), ("[::1]:1", True), ("10.0.0.3:9100", False), ("robot:1", False)],
)
def test_only_a_local_emulator_moves_without_confirmation(address: str, local: bool):
    who, asked = Identity("arm", "1", "c", "v", ("a",), 0.002), []

    def nobody(question: str) -> bool:
        asked.append(question)
        return False

    with contextlib.nullcontext() if local else pytest.raises(AgentError, match="nobody confirmed"):
        confirm_clear_cell(who, replace(READY, emulator=True), address, nobody)
    assert len(asked) == (not local)
    with pytest.raises(AgentError, match="nobody confirmed"):
        confirm_clear_cell(who, READY, address, nobody)
