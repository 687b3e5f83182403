"""The current model: one step, with a backup, never half of one."""

import os
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from agent.core.errors import InputError
from agent.runs.current import apply_previous, apply_run, current_model
from tests.shop_floor.conftest import edit, runs_of


def _three(write_runs) -> tuple[Path, list[Path]]:
    return (logs := write_runs(3)), runs_of(logs)


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


@pytest.mark.parametrize(
    ("file", "changes", "said"),
    [
        *(("state.json", {"status": status}, f"this run is {status}") for status in ("rejected", "stopped", "running")),
        ("state.json", {"kind": "diagnose"}, "a diagnosis and made no model"),
        ("state.json", {"model_sha256": "0" * 64}, "SHA-256 differs"),
        ("state.json", {"model_sha256": None}, "'model_sha256' is missing"),
        ("model.json", {"friction": None}, "SHA-256 differs"),
        ("result.json", {"validation": None}, "files of this run are damaged"),
        ("result.json", {"validation": None, "conditions": None}, "'validation' is missing"),
        ("result.json", None, "No such file|no such file"),
    ],
)
def test_refuses_a_run_that_was_not_accepted_or_has_lost_something(write_runs, file: str, changes, said: str):
    logs, runs = _three(write_runs)
    apply_run(logs, runs[1])
    (runs[0] / file).unlink() if changes is None else edit(runs[0] / file, **changes)
    with pytest.raises(InputError, match=f"{runs[0].name}.*{said}"):
        apply_run(logs, runs[0])
    assert current_model(logs, "comau_ns16", "NS16-1").run == runs[1].name
    assert len(list(logs.glob("models/*/versions/*"))) == 1


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
    from agent.runs.current import _model_folder

    logs = tmp_path_factory.mktemp("logs")
    assert len({_model_folder(logs, *machine) for machine in machines}) == len(machines)
