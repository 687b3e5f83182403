"""kill -9 in every step of a calibration: the run resumes at the next step boundary."""

import json
import re
from pathlib import Path

import pytest

from agent.recording import read_log
from tests.warm import PipedProcess

#: What the agent says as a step begins, or in the middle of one.
SPOKEN = ("search:", "fitness", "drawing", "recording", "estimating", "validating")
#: What it says when it has recorded for more than a second; and the motion's log.
IN_MOTION = {
    "excitation.mcap": r"excitation: +([1-9]\d*\.\d) of",
    "validation_01.mcap": r"validation: +([1-9]\d*\.\d) of",
}


def kill_when_it_says(process: PipedProcess, pattern: str) -> str:
    """What stands in the group of the pattern, if it has one."""
    for line in process.stderr:
        if found := re.search(pattern, line):
            process.kill()
            process.communicate()
            return found.groups("")[0] if found.groups() else ""
    raise AssertionError(f"the agent ended and never said {pattern!r}")


def go_on(run_agent, recipe: Path, folder: Path) -> None:
    """Resume the run to its end; what was finished stays as it is."""
    finished = json.loads((folder / "state.json").read_text(encoding="utf-8"))["steps"]
    resumed = run_agent("calibrate", recipe, "--resume", folder)
    assert resumed.returncode == 0, resumed.stderr
    state = json.loads((folder / "state.json").read_text(encoding="utf-8"))
    assert state["status"] == "finished"
    for step, what in finished.items():
        assert state["steps"][step] == what, f"{step} was done again"


@pytest.mark.verify
@pytest.mark.parametrize("moment", SPOKEN)
def test_resumes_a_killed_calibration(
    start_controller, write_recipe, start_agent, run_agent, only_run, tmp_path: Path, moment: str
):
    recipe = write_recipe(start_controller().address, motions=1, cycles=1)
    kill_when_it_says(start_agent("calibrate", recipe), moment)
    go_on(run_agent, recipe, only_run(tmp_path / "logs"))


@pytest.mark.verify
@pytest.mark.parametrize("name", IN_MOTION)
def test_a_calibration_killed_in_motion_loses_at_most_one_second(
    start_controller, write_recipe, start_agent, run_agent, only_run, tmp_path: Path, name: str
):
    """In real time. The interrupted motion runs again from its beginning, and its old log is kept as well."""
    controller = start_controller("--clock", "real", "--watchdog", "1")
    recipe = write_recipe(controller.address, motions=1, cycles=2)
    elapsed = float(kill_when_it_says(start_agent("calibrate", recipe), IN_MOTION[name]))
    folder = only_run(tmp_path / "logs")
    cut = read_log(folder / name)
    assert cut.t[-1] - cut.t[0] > elapsed - 1.0
    go_on(run_agent, recipe, folder)
    (aside,) = folder.glob("*.stopped*.mcap")
    assert aside.name == name.replace(".mcap", ".stopped1.mcap")
    assert len(read_log(aside).t) == len(cut.t)
