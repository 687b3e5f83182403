"""The fake controller as a process, as users meet it."""

import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests import warm

RECIPE = """
robot: comau_ns16
controller: {{driver: tcp, address: "{address}"}}
motion:
  speed: 1 m/s
  fly: {{type: FLY_CART, trajectory: FLY_TOL, distance: 20 mm}}
  via_points:
    count: 6
    box:
      centre: [1.0 m, 0 m, 0.8 m]
      size: [500 mm, 600 mm, 400 mm]
      orientation: [0 deg, 180 deg, 0 deg]
      cone: 30 deg
search: {{population: 4, generations: 1, seed: 1}}
record: {{rate: 500 Hz, cycles: {cycles}}}
validate: {{motions: {motions}, speed: {speed}, seed: 2}}
gate: {{normalised_rmse: {gate}}}
"""


@pytest.fixture
def controller(start_controller: Callable[..., Any]) -> Any:
    """A fake controller that runs as fast as it can."""
    return start_controller()


@pytest.fixture
def write_recipe(tmp_path: Path) -> Callable[..., Path]:
    """Writes a small recipe into the test's folder; keyword arguments: cycles, motions, speed, gate."""

    def write(address: str, **values: object) -> Path:
        chosen = {"cycles": 2, "motions": 2, "speed": "1 m/s", "gate": 0.03, **values}
        path = tmp_path / "recipe.yaml"
        path.write_text(RECIPE.format(address=address, **chosen), encoding="utf-8")
        return path

    return write


@pytest.fixture
def start_agent(tmp_path: Path) -> Iterator[Callable[..., warm.PipedProcess]]:
    """Starts the command line, off a terminal, in the test's folder; it ends with the test."""
    with ExitStack() as undo:
        yield lambda *arguments: undo.enter_context(warm.PipedProcess("agent", *arguments, cwd=tmp_path))


@pytest.fixture
def run_agent(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command line to its end, in the test's folder."""
    return lambda *arguments: warm.run("agent", *arguments, cwd=tmp_path)


@pytest.fixture
def wait_for_motion() -> Callable[[warm.PipedProcess], None]:
    """Reads an agent's progress until the arm moves."""

    def wait(process: warm.PipedProcess) -> None:
        assert any("of motion" in line for line in process.stderr), "the agent ended before anything moved"

    return wait


@pytest.fixture
def only_run() -> Callable[[Path], Path]:
    """Finds the one run folder in a folder of runs."""

    def find(logs: Path) -> Path:
        (run,) = (state.parent for state in logs.glob("*/state.json"))
        return run

    return find
