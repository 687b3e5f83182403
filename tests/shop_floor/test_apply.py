"""The current model: one step, with a backup, never half of one."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from agent.core.errors import InputError
from agent.runs.current import apply_previous, apply_run, current_model
from tests.shop_floor.conftest import edit


def _three(write_runs) -> tuple[Path, list[Path]]:
    logs = write_runs(3)
    return logs, sorted(path for path in logs.iterdir() if path.is_dir())


def test_apply_and_repeated_previous(write_runs):
    logs, runs = _three(write_runs)
    assert current_model(logs, "comau_ns16", "NS16-1") is None
    for run in runs:
        applied = apply_run(logs, run)
        assert applied.model.read_bytes() == (run / "model.json").read_bytes()
    assert apply_run(logs, runs[2]).previous == current_model(logs, "comau_ns16", "NS16-1").previous, "no new version"
    assert apply_previous(logs).run == runs[1].name
    assert apply_previous(logs).run == runs[0].name
    with pytest.raises(InputError, match="there is none before it"):
        apply_previous(logs)
    assert current_model(logs, "comau_ns16", "NS16-1").run == runs[0].name
    again = apply_run(logs, runs[1])
    assert apply_previous(logs).run == runs[0].name
    assert again.model.read_bytes() == (runs[0] / "model.json").read_bytes(), "the path of the current model is fixed"


def test_the_current_model_survives_deletion_of_its_run(write_runs):
    logs, runs = _three(write_runs)
    applied = apply_run(logs, runs[0])
    content = (runs[0] / "model.json").read_bytes()
    for file in runs[0].iterdir():
        file.unlink()
    assert applied.model.read_bytes() == content


@pytest.mark.parametrize("name", ["about.json", "model.json"])
def test_applying_a_run_repairs_a_damaged_current_model(write_runs, name: str):
    logs, runs = _three(write_runs)
    apply_run(logs, runs[0])
    damaged = apply_run(logs, runs[1]).model.parent.resolve() / name
    damaged.write_text("[]", encoding="utf-8")
    with pytest.raises(InputError, match="apply a run again"):
        current_model(logs, "comau_ns16", "NS16-1")
    assert apply_run(logs, runs[1]).run == runs[1].name
    assert current_model(logs, "comau_ns16", "NS16-1").model.read_bytes() == (runs[1] / "model.json").read_bytes()


def test_a_diagnosis_has_no_model_to_apply(write_runs):
    logs, (run, *_) = _three(write_runs)
    edit(run / "state.json", kind="diagnose")
    with pytest.raises(InputError, match="a diagnosis and made no model"):
        apply_run(logs, run)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        *((file, content) for file in ("result.json", "model.json") for content in (None, "", "{}", "[]", '{"a": ')),
        ("state.json", "without the checksum"),
    ],
)
def test_a_damaged_run_keeps_the_current_model(write_runs, file: str, content: str | None):
    logs, runs = _three(write_runs)
    apply_run(logs, runs[0])
    if content is None:
        (runs[1] / file).unlink()
    elif file == "state.json":
        edit(runs[1] / file, model_sha256=None)
    else:
        (runs[1] / file).write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=runs[1].name):
        apply_run(logs, runs[1])
    assert current_model(logs, "comau_ns16", "NS16-1").run == runs[0].name
    assert len(list(logs.glob("models/*/versions/*"))) == 1


def test_a_full_disk_keeps_the_current_model(write_runs, monkeypatch: pytest.MonkeyPatch):
    logs, runs = _three(write_runs)
    apply_run(logs, runs[0])

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(Exception, match="No space left"):
        apply_run(logs, runs[1])
    monkeypatch.undo()
    assert current_model(logs, "comau_ns16", "NS16-1").run == runs[0].name
    assert apply_run(logs, runs[1]).run == runs[1].name


@pytest.mark.parametrize("status", ["rejected", "stopped", "running"])
def test_only_an_accepted_run_is_applied(write_runs, status: str):
    logs, runs = _three(write_runs)
    edit(runs[0] / "state.json", status=status)
    with pytest.raises(InputError, match=f"this run is {status}"):
        apply_run(logs, runs[0])


def test_refuses_a_model_changed_after_acceptance(write_runs):
    logs, runs = _three(write_runs)
    edit(runs[0] / "state.json", model_sha256="0" * 64)
    with pytest.raises(InputError, match="SHA-256 differs"):
        apply_run(logs, runs[0])


def test_asks_for_the_robot_if_there_are_several(write_runs):
    logs, runs = _three(write_runs)
    apply_run(logs, runs[0])
    edit(runs[1] / "state.json", serial="NS16-2")
    apply_run(logs, runs[1])
    with pytest.raises(InputError, match="--serial"):
        apply_previous(logs)
    with pytest.raises(InputError, match="first model applied"):
        apply_previous(logs, serial="NS16-2")


@pytest.mark.parametrize("machine", [{"robot": "nope"}, {"serial": "nope"}])
def test_reports_a_machine_without_a_model(write_runs, machine: dict[str, str]):
    logs, runs = _three(write_runs)
    apply_run(logs, runs[0])
    with pytest.raises(
        InputError, match=f"no model was applied of {next(iter(machine))} nope; there is: comau_ns16 NS16-1"
    ):
        apply_previous(logs, **machine)


def test_reports_that_nothing_was_applied_yet(tmp_path: Path):
    with pytest.raises(InputError, match="no model was applied yet"):
        apply_previous(tmp_path)


#: As makers and bad links write them; with "_" and "/" the folders' names meet.
NAMES = st.text(st.sampled_from("aA1_/.-~ \x00é"), max_size=6)


def _apply_as(run: Path, robot: str, serial: str) -> Path:
    edit(run / "state.json", robot=robot, serial=serial)
    return apply_run(run.parent, run).model.parent.parent


@pytest.mark.parametrize(
    "machines",
    [
        [("r", "A/1"), ("r", "A_1"), ("r", "A 1"), ("r_A", "1")],
        [("r_A", "1"), ("r", "A_1"), ("r", "A/1"), ("r_A_1", "")],
        [("r", "x" * 128), ("r" * 128, "x" * 128), ("r" * 128, "x" * 127 + "y")],
    ],
)
def test_every_machine_has_a_current_model_of_its_own(write_runs, machines):
    logs, runs = _three(write_runs)
    assert len({_apply_as(runs[0], *machine) for machine in machines}) == len(machines)
    for machine in machines:
        found = current_model(logs, *machine)
        assert (found.robot, found.serial) == machine


@given(st.lists(st.tuples(NAMES.filter(bool), NAMES), unique=True, min_size=2, max_size=6))
def test_no_two_machines_share_a_folder(tmp_path_factory, machines):
    from agent.runs.current import _place

    logs = tmp_path_factory.mktemp("logs")
    assert len({_place(logs, *machine) for machine in machines}) == len(machines)
