"""A recipe with a tool: the arm goes where the program says, and the model is accepted."""

import re
from pathlib import Path

import numpy as np
import pinocchio
import pytest
from mcap_ros2.reader import read_ros2_messages

from agent.robot import load_robot
from tests.conftest import ROOT

FLY_DISTANCE = 0.020
SMALL = {
    "192.168.1.10:9100": None,  # the emulator's
    "population: 50": "population: 8",
    "generations: 40": "generations: 2",
    "cycles: 100": "cycles: 2",
    "motions: 30": "motions: 1",
    "speed: 0.1 m/s": "speed: 1 m/s",
}


def flange_poses(log: Path) -> list[pinocchio.SE3]:
    """Measured, by the URDF."""
    robot = load_robot("comau_ns16")
    model = pinocchio.buildModelFromXML(robot.urdf)
    data, tip = model.createData(), model.getFrameId(robot.tip_frame)
    poses = []
    for message in read_ros2_messages(str(log), topics=["/joint_states"]):
        pinocchio.framesForwardKinematics(model, data, np.array(message.ros_msg.position))
        poses.append(data.oMf[tip].copy())
    return poses


def programmed(text: str) -> np.ndarray:
    """(K, 3) positions of the via-points [m]."""
    found = re.findall(r"p\d+ := POS\(([^,]+), ([^,]+), ([^,]+),", text)
    return np.array(found, dtype=float) / 1000.0


@pytest.mark.parametrize(
    "tool", [pytest.param(True, id="tool"), pytest.param(False, id="no_tool", marks=pytest.mark.verify)]
)
def test_the_ns16_recipe_is_accepted_and_passes_every_point(tool, controller, run_agent, only_run, tmp_path: Path):
    text = (ROOT / "recipes" / "ns16.yaml").read_text(encoding="utf-8")
    for usual, small in SMALL.items():
        assert usual in text
        text = text.replace(usual, small or controller.address)
    if not tool:
        text = re.sub(r"(?m)^tool:.*\n(  .*\n)+", "", text)
    (tmp_path / "recipe.yaml").write_text(text, encoding="utf-8")
    run = run_agent("calibrate", tmp_path / "recipe.yaml")
    assert run.returncode == 0, run.stderr
    folder = only_run(tmp_path / "logs")
    program = (folder / "program.pdl").read_text(encoding="utf-8")
    length = 0.12 if tool else 0.0
    assert f"$TOOL := POS(0, 0, {1000 * length:g}, 0, 0, 0, '')" in program
    passed = np.array([pose.act(np.array([0.0, 0.0, length])) for pose in flange_poses(folder / "excitation.mcap")])
    points = programmed(program)
    assert len(points) == 6
    for point in points:
        assert np.linalg.norm(passed - point, axis=1).min() <= FLY_DISTANCE + 0.003  # the servos lag
