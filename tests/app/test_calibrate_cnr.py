"""The whole job over the link that a real NS16 has, in the ways that want more than the socket programs."""

import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fake_controller.build import build_controller
from fake_controller.servers.cnr.server import CnrServer

AWAY = """PROGRAM elsewhere HOLD, PROG_ARM=1
BEGIN
  $TOOL := POS(0, 0, 0, 0, 0, 0, '')
  MOVE JOINT TO {0, 0, -90, 0, 30, 0}
END elsewhere
"""


@pytest.fixture
def server(broker):
    """The fake in this process, as fast as it goes."""
    controller = build_controller("comau_ns16", seed=7, clock="fast")
    with closing(CnrServer(controller, watchdog=5.0, broker=broker.address, waits=True)) as server:
        yield server


def recipe_for(write_recipe, address: str) -> Path:
    recipe = write_recipe(address)
    recipe.write_text(recipe.read_text(encoding="utf-8").replace("driver: tcp", "driver: cnr_comau"), encoding="utf-8")
    return recipe


def check(folder: Path, measured, what: str) -> None:
    """Accepted, and as accurate as the same small recipe is over TCP."""
    result = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    worst = float(np.max(result["validation"]["normalised_rmse"]))
    measured(f"cnr_comau, {what}: worst axis on {result['validation']['motions']} unseen motions", 100 * worst, "%")
    assert result["accepted"]
    assert worst <= 0.02
    assert sum(recording["lost"] for recording in result["recordings"]) == 0


@pytest.mark.verify
def test_calibrates_with_operator_started_programs(
    server, write_recipe, start_agent, only_run, measured, tmp_path: Path
):
    recipe = recipe_for(write_recipe, f"{server.address},start=hand")
    agent = start_agent("calibrate", recipe)
    said = []
    for line in agent.stderr:
        said.append(line)
        if "press START" in line:
            server.press_start()
    agent.communicate()
    assert agent.returncode == 0, "".join(said)
    check(only_run(tmp_path / "logs"), measured, "start=hand")
    assert server.controller.motions_started == 3


@pytest.mark.verify
def test_calibrates_with_via_points(server, write_recipe, run_agent, only_run, measured, tmp_path: Path):
    """Straight lines cannot begin in the singular calibration pose, nor with a tool that somebody left: a program goes
    elsewhere first and sets the tool."""
    (tmp_path / "away.pdl").write_text(AWAY, encoding="utf-8")
    first = run_agent(
        "record", recipe_for(write_recipe, server.address), "--program", "away.pdl", "-o", tmp_path / "away.mcap"
    )
    assert first.returncode == 0, first.stderr
    run = run_agent("calibrate", recipe_for(write_recipe, f"{server.address},mode=points"))
    assert run.returncode == 0, run.stderr
    check(only_run(tmp_path / "logs"), measured, "mode=points")
    assert server.controller.motions_started > 4, "each trajectory from stop to stop has a start of its own"
