"""kill -9 in every step of a calibration: the folder it leaves goes on at the next step boundary, and no further."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from agent.recording import read_log

#: What the agent says as a step begins, or in the middle of one.
MOMENTS = ("search:", "fitness", "drawing", "recording", "excitation:", "validation:", "estimating", "validating")


@pytest.mark.verify
@pytest.mark.parametrize("moment", MOMENTS)
def test_a_killed_calibration_goes_on(
    controller, write_recipe, start_agent, run_agent, only_run, tmp_path: Path, moment: str
):
    recipe = write_recipe(controller.address, motions=1, cycles=1)
    killed = start_agent("calibrate", recipe)
    assert killed.stderr is not None
    assert any(moment in line for line in killed.stderr), f"the agent ended and never said {moment!r}"
    killed.kill()
    killed.communicate()
    folder = only_run(tmp_path / "logs")
    finished = json.loads((folder / "state.json").read_text(encoding="utf-8"))["steps"]
    stopped = [log for log in folder.glob("*.mcap") if log.name not in finished and log.name != "analysis.mcap"]
    for log in stopped:
        read_log(log)

    resumed = run_agent("calibrate", recipe, "--resume", folder)
    assert resumed.returncode == 0, resumed.stderr
    state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    assert state["status"] == "finished"
    for step, what in finished.items():
        assert state["steps"][step] == what, f"{step} was done again"
    assert len(list(folder.glob("*.stopped*.mcap"))) == len(stopped)
