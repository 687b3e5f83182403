"""The whole job on an emulated UR5e, by its recipe: a model, and what differs from it later."""

import json
import re
from pathlib import Path

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


def agent(folder: Path, *arguments: object, hidden: tuple[dict, ...] = ()) -> str:
    """What the command line prints in this folder, where the recipe has the address of a UR5e with these effects."""
    address = free_loopback()
    (folder / "effects.json").write_text(json.dumps(hidden), encoding="utf-8")
    text = RECIPE.replace("address: 127.0.0.1", f"address: {address}")
    (folder / "ur5e.yaml").write_text(text, encoding="utf-8")
    with emulators() as start:
        start("--robot", "ur5e", "--address", address, "--effects", str(folder / "effects.json"))
        done = warm.run("agent", *arguments, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of `agent calibrate recipes/ur5e.yaml`, in a folder of its own."""
    folder = tmp_path_factory.mktemp("ur5e")
    return folder / agent(folder, "calibrate", "ur5e.yaml").splitlines()[0]


@pytest.mark.verify
def test_the_model_predicts_unseen_motions(run, measured):
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    assert result["accepted"] is True
    worst = 100 * max(result["validation"]["normalised_rmse"])
    measured("UR5e: worst axis on 30 unseen motions", worst, "% of nominal torque", "at most 1 %", worst <= 1.0)
    assert len(list(run.glob("validation_[0-9][0-9].mcap"))) == 30
    assert worst <= 1.0


@pytest.mark.verify
@pytest.mark.parametrize("name", HIDDEN)
def test_what_is_hidden_later_is_named(run, measured, tmp_path, name):
    model, found = run / "model.json", tmp_path / f"{name}.json"
    agent(tmp_path, "diagnose", "--record", "ur5e.yaml", "--model", model, "-o", found, hidden=(HIDDEN[name],))
    (effect,) = IdentifiedModel.load(found).effects
    assert (effect.effect, list(effect.joints)) == (name, HIDDEN[name]["joints"])
    if name == "payload":
        load = agent(tmp_path, "export", found, "--load", "ur")
        off = 100 * abs(float(re.search(r"set_target_payload\(([\d.]+),", load).group(1)) / MASS - 1)
        measured("UR5e: a payload of 1.5 kg, as set_target_payload", off, "% off", "at most 2 %", off <= 2.0)
        assert off <= 2.0
