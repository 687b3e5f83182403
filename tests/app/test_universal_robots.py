"""The whole job on an emulated UR5e, by its recipe: a model, and what differs from it later."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from agent.model import IdentifiedModel
from tests import warm
from tests.conftest import ROOT, emulators, free_loopback

RECIPE = (ROOT / "recipes/ur5e.yaml").read_text(encoding="utf-8")
MASS = 1.5
HIDDEN = {
    "payload": {"effect": "payload", "joints": [], "parameters": {"mass": MASS}},
    "dress_pack": {
        "effect": "dress_pack",
        "joints": ["wrist_1_joint"],
        "parameters": {"stiffness": 10.0, "centre": -1.2, "hysteresis": 5.0, "travel": 0.15},
    },
}


class Job:
    """A folder with the recipe, in which the agent runs against emulators of one UR5e."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def agent(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """The command line, to its end."""
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = warm.run("agent", *map(str, arguments), cwd=self.folder, env=environment)
        assert done.returncode == 0, done.stderr
        return done

    @contextmanager
    def emulated(self, *effects: dict[str, Any]):
        """The arm with these effects, and the recipe for its address."""
        (self.folder / "effects.json").write_text(json.dumps(effects), encoding="utf-8")
        address = free_loopback()
        text = RECIPE.replace("address: 127.0.0.1", f"address: {address}")
        (self.folder / "ur5e.yaml").write_text(text, encoding="utf-8")
        with emulators() as start:
            start("--robot", "ur5e", "--address", address, "--effects", str(self.folder / "effects.json"))
            yield

    @property
    def run(self) -> Path:
        """The folder of the calibration."""
        (state,) = self.folder.glob("logs/*/validation_30.mcap")
        return state.parent


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Job:
    """A job of which `agent calibrate` has made a model that its gate accepts."""
    job = Job(tmp_path_factory.mktemp("ur5e"))
    with job.emulated():
        job.agent("calibrate", "ur5e.yaml")
    return job


@pytest.mark.verify
def test_the_model_predicts_unseen_motions(calibrated: Job, measured: Callable[..., None]):
    result = json.loads((calibrated.run / "result.json").read_text(encoding="utf-8"))
    assert result["accepted"] is True
    worst = 100 * max(result["validation"]["normalised_rmse"])
    measured("UR5e: worst axis on 30 unseen motions", worst, "% of nominal torque", "at most 1 %", worst <= 1.0)
    assert len(list(calibrated.run.glob("validation_[0-9][0-9].mcap"))) == 30
    assert worst <= 1.0


@pytest.mark.verify
@pytest.mark.parametrize("name", HIDDEN)
def test_what_is_hidden_later_is_named(calibrated: Job, measured: Callable[..., None], name: str):
    with calibrated.emulated(HIDDEN[name]):
        model = calibrated.run / "model.json"
        calibrated.agent("diagnose", "--record", "ur5e.yaml", "--model", model, "-o", f"{name}.json")
    (found,) = IdentifiedModel.load(calibrated.folder / f"{name}.json").effects
    assert (found.effect, list(found.joints)) == (name, HIDDEN[name]["joints"])
    if name == "payload":
        load = calibrated.agent("export", "payload.json", "--load", "ur")
        mass = float(re.search(r"set_target_payload\(([\d.]+),", load.stdout).group(1))
        off = 100 * abs(mass / MASS - 1)
        measured("UR5e: a payload of 1.5 kg, as set_target_payload", off, "% off", "at most 2 %", off <= 2.0)
        assert off <= 2.0
