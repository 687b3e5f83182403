"""Arms nobody tuned anything for, from the command line to an exported model, without nominal torques."""

import json
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

#: Limits, origins with rpy and axis of each joint, and the flange; masses of the links.
SEVEN = [
    ((-2.9, 2.9), (0, 0, 0.333), (0, 0, 0), 5.0),
    ((-1.76, 1.76), (0, 0, 0), (-np.pi / 2, 0, 0), 0.65),
    ((-2.9, 2.9), (0, -0.316, 0), (np.pi / 2, 0, 0), 3.2),
    ((-3.07, -0.07), (0.0825, 0, 0), (np.pi / 2, 0, 0), 3.6),
    ((-2.9, 2.9), (-0.0825, 0.384, 0), (-np.pi / 2, 0, 0), 1.2),
    ((-0.02, 3.75), (0, 0, 0), (np.pi / 2, 0, 0), 1.7),
    ((-2.9, 2.9), (0.088, 0, 0), (np.pi / 2, 0, 0), 0.7),
]
OFFSET_WRIST = [
    ((-6.28, 6.28), (0, 0, 0), (0, 0, 0), 3.7),
    ((-6.28, 6.28), (0, 0, 0.089), (np.pi / 2, 0, 0), 8.4),
    ((-6.28, 6.28), (-0.425, 0, 0), (0, 0, 0), 2.3),
    ((-6.28, 6.28), (-0.392, 0, 0), (0, 0, 0), 1.2),
    ((-6.28, 6.28), (0, 0, 0.109), (np.pi / 2, 0, 0), 1.2),
    ((-6.28, 6.28), (0, 0, 0.095), (-np.pi / 2, 0, 0), 0.2),
]
RECIPE = """
robot: arm/robot.yaml
controller: {{driver: tcp, address: "{address}"}}
motion:
  speed: 0.4 m/s
  fly: {{type: FLY_CART, trajectory: FLY_TOL, distance: 10 mm}}
  via_points:
    count: 6
    box:
      centre: [0.45 m, 0.1 m, 0.4 m]
      size: [200 mm, 200 mm, 200 mm]
      orientation: [0 deg, 180 deg, 0 deg]
      cone: 30 deg
search: {{population: 6, generations: 2, seed: 1}}
record: {{rate: 500 Hz, cycles: 2}}
validate: {{motions: 2, speed: 0.2 m/s, seed: 2}}
"""


def write_arm(folder: Path, joints: list, flange: float) -> Path:
    folder.mkdir()
    parts = ['<robot name="arm"><link name="world"/><link name="l0"/><joint name="mount" type="fixed">']
    parts.append('<parent link="world"/><child link="l0"/></joint>')
    rows = []
    for k, ((low, high), xyz, rpy, mass) in enumerate(joints, start=1):
        place = f'<origin xyz="{" ".join(map(repr, xyz))}" rpy="{" ".join(map(repr, rpy))}"/>'
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="l{k - 1}"/><child link="l{k}"/>{place}'
            f'<axis xyz="0 0 1"/>'
            f'<limit lower="{low}" upper="{high}" velocity="2.5" effort="100"/></joint><link name="l{k}"><inertial>'
            f'<origin xyz="0.02 0.03 0.05"/><mass value="{mass}"/><inertia ixx="{0.02 * mass}" ixy="0" ixz="0" '
            f'iyy="{0.02 * mass}" iyz="0" izz="{0.015 * mass}"/></inertial></link><transmission name="t{k}">'
            f'<joint name="j{k}"/></transmission>'
        )
        rows.append(f"  - {{name: j{k}, gear_ratio: 100, max_velocity: 2.5, max_acceleration: 6}}\n")
    parts.append(f'<joint name="tip" type="fixed"><parent link="l{len(joints)}"/><child link="flange"/>')
    parts.append(f'<origin xyz="0 0 {flange}"/></joint><link name="flange"/></robot>')
    (folder / "arm.urdf").write_text("".join(parts), encoding="utf-8")
    text = f"name: arm\nurdf: arm.urdf\ntip_frame: flange\njoints:\n{''.join(rows)}"
    (folder / "robot.yaml").write_text(text, encoding="utf-8")
    return folder / "robot.yaml"


@pytest.mark.verify
@pytest.mark.parametrize(("joints", "flange"), [(SEVEN, 0.107), (OFFSET_WRIST, 0.08)], ids=["seven", "offset wrist"])
def test_calibrates_without_nominal_torques(tmp_path: Path, start_controller, run_agent, only_run, joints, flange):
    robot = write_arm(tmp_path / "arm", joints, flange)
    controller = start_controller("--robot", str(robot))
    (tmp_path / "recipe.yaml").write_text(RECIPE.format(address=controller.address), encoding="utf-8")
    checked = run_agent("check", "recipe.yaml")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert "nominal_motor_torque" in checked.stdout
    job = run_agent("calibrate", "recipe.yaml", "--yes")
    assert job.returncode == 0, job.stderr
    assert "not judged" in job.stderr
    run = only_run(tmp_path / "logs")
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    assert result["accepted"] is None, "nobody judged it"
    assert result["validation"]["normalised_rmse"] == [None] * len(joints)
    assert result["validation"]["relative_error_all_joints"] < 0.05
    state = json.loads((run / "state.json").read_text(encoding="utf-8"))
    (run / "state.json").write_text(json.dumps({**state, "status": "running"}), encoding="utf-8")
    again = run_agent("calibrate", "recipe.yaml", "--yes", "--resume", run.name)
    assert again.returncode == 0, again.stderr
    assert "not judged" in again.stderr
    said = run_agent("history").stdout
    assert "N·m" in said
    assert "nan" not in said
    logs = [str(path) for path in sorted(run.glob("validation_[0-9][0-9].mcap"))]
    model = str(run / "model.json")
    for command in (
        ("validate", "--model", model, *logs),
        ("diagnose", "--robot", str(robot), "--model", model, "--report", "gap.html", *logs),
        ("estimate", "--robot", str(robot), "-o", "m.json", "--export", "out", str(run / "excitation.mcap")),
        ("export", "m.json", "-o", "again"),
        ("report", run.name),
        ("report", "--index"),
    ):
        done = run_agent(*command)
        assert done.returncode == 0, (command, done.stderr)
    assert pin.buildModelFromUrdf(str(tmp_path / "again" / "arm.urdf")).nv == len(joints)
