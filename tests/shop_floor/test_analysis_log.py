"""Logs that open where people look: measured and predicted over each other, a layout inside."""

import json
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from agent.recording import read_log
from agent.recording.mcap.foxglove import FOXGLOVE_LAYOUT as FILE_NAME, foxglove_layout
from agent.robot import load_robot
from tests.conftest import ROOT

TOPICS = ("/filtered_joint_states", "/predicted_joint_states", "/residual_joint_states")


def _efforts(path: Path, topic: str) -> tuple[np.ndarray, np.ndarray]:
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = [message for *_, message in reader.iter_decoded_messages(topics=[topic])]
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in messages]
    return np.array(stamps), np.array([list(m.effort) for m in messages])


def test_measured_predicted_and_residual_are_topics_on_common_stamps(calibrated: Path):
    (run,) = [path for path in (calibrated / "logs").iterdir() if (path / "state.json").exists()]
    path = run / "analysis.mcap"
    log = read_log(path, load_robot("comau_ns16"))  # it is a log like any other
    found = {topic: _efforts(path, topic) for topic in TOPICS}
    stamps, filtered = found["/filtered_joint_states"]
    assert len(stamps) > 100
    for topic in TOPICS:
        assert np.array_equal(found[topic][0], stamps)
    assert np.all(np.isin(np.rint(1e6 * (stamps - log.stamp)), np.rint(1e6 * log.t)))
    predicted, residual = found["/predicted_joint_states"][1], found["/residual_joint_states"][1]
    assert np.allclose(filtered - predicted, residual, atol=1e-9)
    rmse = np.sqrt(np.mean(residual**2, axis=0)) / load_robot("comau_ns16").nominal_torque
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    assert np.allclose(rmse, result["validation"]["normalised_rmse_all_samples"], rtol=0.02)


def test_every_log_carries_the_layout_for_its_joints(calibrated: Path):
    robot = load_robot("comau_ns16")
    logs = list((calibrated / "logs").rglob("*.mcap"))
    assert len(logs) == 3
    for path in logs:
        with open(path, "rb") as file:
            attachments = list(make_reader(file).iter_attachments())
        assert [(a.name, a.media_type) for a in attachments] == [(FILE_NAME, "application/json")]
        assert attachments[0].data.decode() == foxglove_layout(robot.joint_names)


def test_the_documented_layout_is_current():
    text = (ROOT / "docs" / "foxglove" / "layout.json").read_text(encoding="utf-8")
    assert text == foxglove_layout(load_robot("comau_ns16").joint_names)


def test_layouts_use_existing_panels_and_topics():
    for names in (["slide"], [f"joint_{k}" for k in range(7)]):
        layout = json.loads(foxglove_layout(names))

        def panels(node) -> list[str]:
            return [node] if isinstance(node, str) else [*panels(node["first"]), *panels(node["second"])]

        assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
        paths = [line["value"] for panel in layout["configById"].values() for line in panel.get("paths", [])]
        topics = {path.split(".")[0] for path in paths}
        assert topics == {*TOPICS, "/joint_states", "/joint_references"}
        assert f"/predicted_joint_states.effort[{len(names) - 1}]" in paths
