"""A calibration on a controller of another interpolator, planned with the one that was learned from it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.motion.learned_law import load_law
from agent.recording import read_log
from agent.robot import load_robot
from tests.conftest import ROOT

ROBOT = load_robot("comau_ns16")


def off_plan(log: Path) -> float:
    """[mrad] by which set-points are off what was planned for the same time, at most."""
    read = read_log(log, ROBOT)
    return float(1000 * np.nanmax(np.abs(read.reference_position - read.planned_position)))


def worst(run: Path) -> float:
    """[% of nominal torque] of the worst axis on the validation motions."""
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    return 100 * max(result["validation"]["normalised_rmse"])


@pytest.fixture
def calibrate_twice(run_agent: Any, tmp_path: Path, measured: Any) -> Callable[[Path, str], None]:
    """Calibrates by a recipe, learns the law of the loop, and calibrates again with it: what the paper does with the
    vendor's library. The first may be stopped in a motion after the loop, which then says what to do."""
    return lambda recipe, what: twice(recipe, what, run_agent, tmp_path, measured)


def twice(recipe: Path, what: str, run_agent: Any, tmp_path: Path, measured: Any) -> None:
    first = run_agent("calibrate", recipe, "--yes", "-q")
    if first.returncode:
        assert "agent learn-interpolator" in first.stderr
        assert first.returncode == 5, first.stderr
    (run,) = (state.parent for state in (tmp_path / "logs").glob("*/state.json"))
    learned = run_agent(
        "learn-interpolator", "--robot", "comau_ns16", "-o", "law.yaml", run / "excitation.mcap", "--json"
    )
    assert learned.returncode == 0, learned.stderr
    after = json.loads(learned.stdout)["after"]
    text = recipe.read_text(encoding="utf-8")
    searched = text.replace("seed: 1}", "seed: 4, interpolator: law.yaml}")
    assert searched != text
    recipe.write_text(searched, encoding="utf-8")
    second = run_agent("calibrate", recipe, "--yes", "-q")
    assert second.returncode == 0, second.stderr
    again = tmp_path / second.stdout.strip()
    measured(f"{what}: path error of the learned law", after["path_mm"], "mm", "below 1 mm", after["path_mm"] < 1.0)
    measured(
        f"{what}: time error of the learned law", after["time_percent"], "%", "below 0.5 %", after["time_percent"] < 0.5
    )
    measured(f"{what}: planned with ours, the guard stops it", float(first.returncode != 0), "yes or no")
    if not first.returncode:
        measured(f"{what}: worst axis, planned with ours", worst(run), "% of nominal")
    measured(
        f"{what}: worst axis, searched again with the learned one",
        worst(again),
        "% of nominal",
        "at most 3 %",
        worst(again) <= 3.0,
    )
    measured(f"{what}: set-points off the plan with ours", off_plan(run / "excitation.mcap"), "mrad")
    measured(f"{what}: the same of the loop searched again", off_plan(again / "excitation.mcap"), "mrad")
    assert after["path_mm"] < 1.0
    assert after["time_percent"] < 0.5
    assert load_law(tmp_path / "law.yaml", ROBOT).parameters.ramps == "blocks"


@pytest.mark.verify
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_calibration_with_the_learned_interpolator_is_accepted(
    seed: int, start_controller: Callable[..., Any], write_recipe: Any, calibrate_twice: Callable[[Path, str], None]
):
    """Small searches, on three controllers."""
    controller = start_controller("--interpolator", "second", "--seed", str(seed))
    recipe = write_recipe(controller.address, cycles=2, motions=2, speed="0.4 m/s")
    calibrate_twice(recipe, f"second interpolator, seed {seed}")


@pytest.mark.verify
def test_make_calibrate_on_another_interpolator(
    start_controller: Callable[..., Any], calibrate_twice: Callable[[Path, str], None], tmp_path: Path
):
    """The recipe and the machine of `make calibrate`."""
    controller = start_controller("--interpolator", "second", "--seed", "7")
    text = (ROOT / "recipes" / "ns16_quickstart.yaml").read_text(encoding="utf-8")
    assert "127.0.0.1:9100" in text
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(text.replace("127.0.0.1:9100", controller.address), encoding="utf-8")
    calibrate_twice(recipe, "make calibrate on the second interpolator")
