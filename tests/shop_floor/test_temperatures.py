"""Temperatures, where the controller gives them: in the log, in the run, in the history."""

import json
import re
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

WARMING = {"start": -10.0, "equilibrium": 5.0, "time_constant": 60.0, "coulomb_rate": 0.002, "viscous_rate": 0.01}


def _recalibrate(shop: Path, run_agent, address: str) -> Path:
    recipe = shop / "recipe.yaml"
    text = re.sub(r'address: "[^"]*"', f'address: "{address}"', recipe.read_text(encoding="utf-8"))
    recipe.write_text(text, encoding="utf-8")
    run = run_agent("recalibrate", "recipe.yaml", "-q")
    assert run.returncode == 0, run.stderr
    return shop / run.stdout.strip()


def test_records_the_temperatures_of_a_warming_machine(shop: Path, run_agent, start_controller):
    effects = shop / "effects.json"
    warm = {"effect": "thermal_friction", "joints": ["joint_2", "joint_4"], "parameters": WARMING}
    effects.write_text(json.dumps([warm]), encoding="utf-8")
    folder = _recalibrate(shop, run_agent, start_controller("--seed", "7", "--effects", str(effects)).address)
    met = json.loads((folder / "result.json").read_text(encoding="utf-8"))["conditions"]["temperatures_c"]
    first, last = np.array(met["first"]), np.array(met["last"])
    np.testing.assert_array_equal(first[[0, 2, 4, 5]], 25.0)
    assert np.all((first[[1, 3]] >= 15.0) & (first[[1, 3]] < last[[1, 3]]) & (last[[1, 3]] < 30.0))

    with open(folder / "excitation.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [m for *_, m in reader.iter_decoded_messages(topics=["/temperatures"])]
    np.testing.assert_allclose([messages[0].effort, messages[-1].effort], [first, last])
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages]
    assert stamps == sorted(stamps)

    listed = json.loads(run_agent("history", "--json").stdout)["runs"]
    assert [run["conditions"]["temperatures_c"] for run in listed] == [None, met]
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert f"{last[1]:.1f}</td>" in page
