"""What a diagnosis that was stopped between its rounds says to go on with."""

from __future__ import annotations

from pathlib import Path

import pytest

from agent.pipeline.ending import going_on
from agent.runs.folder import RunFolder


@pytest.mark.parametrize(("budget", "options"), [(None, ""), (600.0, " --until-sure --budget '600 s'")])
def test_the_command_to_go_on_asks_the_same(tmp_path: Path, budget: float | None, options: str):
    recipe = tmp_path / "job.yaml"
    recipe.write_text("robot: comau_ns16\n", encoding="utf-8")
    run = RunFolder.create(tmp_path / "logs", "comau_ns16", recipe)
    run.note(kind="diagnose", question={"cutoff": None, "without": [], "budget": budget})
    assert going_on(run, "rounds").endswith(f"job.yaml --logs {tmp_path / 'logs'}{options}")
