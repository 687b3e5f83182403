"""The whole job on an emulated UR5e, by its recipe: a model, and what differs from it later."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from agent.model import IdentifiedModel
from tests.conftest import free_loopback

RECIPE = (Path(__file__).parents[2] / "recipes/ur5e.yaml").read_text(encoding="utf-8")
MASS = 1.5
HIDDEN = {
    "payload": {"effect": "payload", "joints": [], "parameters": {"mass": MASS}},
    "dress_pack": {
        "effect": "dress_pack",
        "joints": ["wrist_1_joint"],
        "parameters": {"stiffness": 10.0, "centre": -1.2, "hysteresis": 5.0, "travel": 0.15},
    },
}


@pytest.mark.verify
def test_calibrated_then_diagnosed(tmp_path: Path, start_controller, run_agent, only_run, measured):
    def emulate(*effects: dict) -> None:
        """A UR5e with these effects, and the recipe for it."""
        (tmp_path / "effects.json").write_text(json.dumps(effects), encoding="utf-8")
        address = free_loopback()
        start_controller("--robot", "ur5e", "--address", address, "--effects", str(tmp_path / "effects.json"))
        text = RECIPE.replace("address: 127.0.0.1", f"address: {address}")
        (tmp_path / "ur5e.yaml").write_text(text, encoding="utf-8")

    emulate()
    job = run_agent("calibrate", "ur5e.yaml")
    assert job.returncode == 0, job.stderr
    run = only_run(tmp_path / "logs")
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    assert result["accepted"] is True
    worst = 100 * max(result["validation"]["normalised_rmse"])
    measured("UR5e: worst axis on 30 unseen motions", worst, "% of nominal torque", "at most 1 %", worst <= 1.0)
    assert len(list(run.glob("validation_[0-9][0-9].mcap"))) == 30
    assert worst <= 1.0
    for name, effect in HIDDEN.items():
        emulate(effect)
        told = run_agent("diagnose", "--record", "ur5e.yaml", "--model", run / "model.json", "-o", f"{name}.json")
        assert told.returncode == 0, told.stderr
        (found,) = IdentifiedModel.load(tmp_path / f"{name}.json").effects
        assert (found.effect, list(found.joints)) == (name, effect["joints"])
    load = run_agent("export", "payload.json", "--load", "ur")
    mass = float(re.search(r"set_target_payload\(([\d.]+),", load.stdout).group(1))
    off = 100 * abs(mass / MASS - 1)
    measured("UR5e: a payload of 1.5 kg, as set_target_payload", off, "% off", "at most 2 %", off <= 2.0)
    assert off <= 2.0
