"""A calibration on a controller of another interpolator, planned with the one that was learned from it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from agent.motion.learned import load_law
from agent.robot import load_robot

ROBOT = load_robot("comau_ns16")


@pytest.mark.verify
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_calibration_with_the_learned_interpolator_is_accepted(
    seed: int, start_controller: Callable[..., Any], write_recipe: Any, run_agent: Any, tmp_path: Path
):
    """What the paper does with the vendor's library: the search is run again with the controller's own law."""
    controller = start_controller("--interpolator", "second", "--seed", str(seed))
    recipe = write_recipe(controller.address, cycles=2, motions=2, speed="0.4 m/s")
    first = run_agent("calibrate", recipe, "--yes", "-q")
    assert first.returncode in (0, 3), first.stderr
    run = Path(first.stdout.strip())
    learned = run_agent(
        "learn-interpolator", "--robot", "comau_ns16", "-o", "law.yaml", tmp_path / run / "excitation.mcap", "--json"
    )
    assert learned.returncode == 0, learned.stderr
    after = json.loads(learned.stdout)["after"]
    assert after["path_mm"] < 1.0
    assert after["time_percent"] < 0.5
    text = recipe.read_text(encoding="utf-8")
    recipe.write_text(text.replace("seed: 1}", "seed: 4, interpolator: law.yaml}"), encoding="utf-8")
    second = run_agent("calibrate", recipe, "--yes", "-q")
    assert second.returncode == 0, second.stderr
    assert load_law(tmp_path / "law.yaml", ROBOT).parameters.ramps == "blocks"
