"""Friction and rotor of a joint that stood still are no numbers: in the table, in the file, nor in an export."""

import json
from dataclasses import replace

import numpy as np
import pytest

from agent.data_quality import check_quality
from agent.estimation import EstimationSettings, estimate
from agent.model import IdentifiedModel
from agent.pages.calibration.parameters import parameters_section
from agent.simulators import export_model
from fake_controller.plant import Plant
from tests.small_arms import make_arm, record


@pytest.fixture(scope="module")
def parked() -> IdentifiedModel:
    """A model from motions in which the second of three joints stands."""
    robot = make_arm("RRR")
    plant = Plant(robot, seed=3)
    logs = [record(plant, f"{k}", 10 + k, [1.0, 0.0, 1.0]) for k in range(2)]
    return estimate(robot, logs, EstimationSettings.create(method="consistent"))


def test_a_braked_joint_says_nothing_of_the_links_it_carries(parked):
    robot, plant = parked.robot, Plant(parked.robot, seed=3)
    logs = [record(plant, f"{k}", 10 + k, [1.0, 0.0, 1.0]) for k in range(2)]
    braked = [replace(log, effort=np.where(np.arange(3) == 1, 1.2, log.effort)) for log in logs]
    held = [replace(log, position=np.where(np.arange(3) == 1, log.position[0], log.position)) for log in braked]
    model = estimate(robot, held, EstimationSettings.create(method="weighted"))
    of = [
        {n: (v, d) for n, v, d in zip(m.names, m.values, m.standard_deviations, strict=True)} for m in (model, parked)
    ]
    for name in ("mx3", "mz3", "f0_3", "f0_1"):
        (braked_value, deviation), (value, other) = (values[name] for values in of)
        assert abs(braked_value - value) < 4 * np.hypot(deviation, other), name
    assert "joint_2" in model.summary("")
    assert not any(finding.refuses for finding in check_quality(robot, held))


def of_joint_2(name: str) -> bool:
    return name.endswith("_2") and not name.startswith("offset")


def test_table_and_file_have_no_number(parked, tmp_path):
    rows = {row[0]: row for row in parked.rows()[1:]}
    assert {name for name, row in rows.items() if row[1] == "-"} == {name for name in rows if of_joint_2(name)}
    assert rows["f0_2"][1:4] == ("-", "-", "-")
    (table,) = parameters_section(parked.rows()).parts
    assert {row[0] for row in table.rows if "stood still" in row} == {name for name in rows if of_joint_2(name)}
    parked.save(tmp_path / "model.json")
    entries = json.loads((tmp_path / "model.json").read_text(encoding="utf-8"))["friction"]
    assert {e["name"] for e in entries if e["value"] is None} == {name for name in rows if of_joint_2(name)}
    again = IdentifiedModel.load(tmp_path / "model.json")
    np.testing.assert_array_equal(again.values, parked.values)
    assert again.text() == parked.text()


def test_an_export_says_what_is_not_measured(parked, tmp_path):
    said: list[str] = []
    export_model(parked, tmp_path / "out", said.append)
    assert any("joint_2 stood still" in line for line in said)
    axles = json.loads((tmp_path / "out/friction.json").read_text(encoding="utf-8"))["axles"]
    assert [all(term["value"] is None for term in axle["terms"] if term["form"] != "offset") for axle in axles] == [
        False,
        True,
        False,
    ]
