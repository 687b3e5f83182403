"""A recipe to start from: by flags, by questions on a terminal, with a schema for editors."""

import errno
import json
import os
import pty
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from agent.core import AgentError, InputError
from agent.pipeline.setup.init import schema_text, write_recipe
from agent.recipe import load_recipe
from agent.robot import load_robot
from agent.runs import make_folder
from drivers.errors import DriverError
from tests.conftest import ROOT, environment
from tests.shop_floor.conftest import agent


def test_options_replace_all_questions(tmp_path: Path):
    flags = ["--controller", "10.0.0.5:9100", "--centre", "900 mm, 0.1 m, 0.7", "--size", "0.3 m, 0.3 m, 0.2 m"]
    run = agent(tmp_path, "init", "cell.yaml", *flags, "--orientation", "0 deg, 170 deg, 0 deg", "--cone", "10 deg")
    assert run.returncode == 0, run.stderr
    recipe = load_recipe(tmp_path / "cell.yaml")
    assert recipe.controller.address == "10.0.0.5:9100"
    via = recipe.motion.via_points.box
    assert via.centre == pytest.approx((0.9, 0.1, 0.7))
    assert via.size == pytest.approx((0.3, 0.3, 0.2))
    assert via.orientation == pytest.approx((0, np.deg2rad(170), 0))
    assert via.cone == pytest.approx(np.deg2rad(10))


@pytest.mark.parametrize(
    ("driver", "address"),
    [
        ("modbus", "192.0.2.1:502"),
        ("ur", "192.0.2.1"),
        ("ros2", "ros2://0/joint_trajectory_controller"),
        ("cnr_comau", "192.0.2.1"),
    ],
)
def test_a_recipe_fits_its_driver(tmp_path: Path, driver: str, address: str):
    flags = {"robot": "ur5e", "driver": driver, "controller": address, "centre": "450 mm, 0 mm, 350 mm"}
    path = write_recipe(tmp_path / "cell.yaml", flags)
    controller = load_recipe(path).controller
    assert (controller.driver, controller.address) == (driver, address)
    assert controller.effort == ("torque" if driver == "ros2" else None)


class Controller:
    """What describes its arm, a tx40, with `joints` in its own order."""

    def __init__(self, joints, text, failure=None):
        self.joints, self.text, self.failure, self.closed = joints, text, failure, False

    def connect(self):
        if self.failure is not None:
            raise self.failure

    def identify(self):
        return Mock(robot="staubli tx40", joint_names=self.joints)

    def description(self):
        return self.text

    def close(self):
        self.closed = True


TX40 = (ROOT / "recipes/examples/tx40/tx40.urdf").read_text(encoding="utf-8")
TX40_JOINTS = tuple(f"joint_{k}" for k in range(1, 7))
AT = {"driver": "ros2", "controller": "ros2://0/arm"}


def init_at(controller, folder: Path, monkeypatch):
    monkeypatch.setattr("agent.pipeline.setup.init.create", lambda name, address: controller)
    return write_recipe(folder / "cell.yaml", AT)


def test_a_wrong_value_is_said_before_the_controller_is_asked(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(AT, "cone", "much")
    with pytest.raises(InputError, match="--cone much: "):
        init_at(Controller(TX40_JOINTS, TX40), tmp_path, monkeypatch)
    assert list(tmp_path.iterdir()) == []


def test_a_controller_describes_the_robot_of_its_recipe(tmp_path: Path, monkeypatch):
    controller = Controller(TX40_JOINTS, TX40)
    recipe = load_recipe(init_at(controller, tmp_path, monkeypatch))
    assert controller.closed
    robot, own = recipe.robot, load_robot(ROOT / "recipes/examples/tx40/robot.yaml")
    assert (robot.name, robot.joint_names) == ("staubli tx40", own.joint_names)
    assert np.array_equal(robot.position_limits, own.position_limits)
    assert np.array_equal(robot.max_acceleration, robot.max_velocity)
    with pytest.raises(InputError, match=r"staubli_tx40.urdf: exists already.*name yours with --robot"):
        write_recipe(tmp_path / "other.yaml", AT)


@pytest.mark.parametrize(
    ("controller", "why"),
    [
        (Controller(TX40_JOINTS[::-1], TX40), "has the joints joint_6, .*; its URDF has joint_1, "),
        (Controller(("rail",), TX40), "none of its joints is in the logs|none of its joints moves"),
        (Controller(TX40_JOINTS, "<robot"), "not valid XML"),
        (Controller(TX40_JOINTS, TX40, DriverError("nobody is there")), "nobody is there. .*name your robot with"),
    ],
)
def test_a_robot_that_is_not_described_is_said_and_nothing_is_written(tmp_path, monkeypatch, controller, why):
    with pytest.raises((InputError, DriverError), match=why):
        init_at(controller, tmp_path, monkeypatch)
    assert controller.closed
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flag", "value", "why"),
    [
        ("--size", "0.3 m, 0.3 m", "three quantities"),
        ("--centre", "1 kg, 0 m, 0 m", "--centre 1 kg"),
        ("--cone", "wide", "--cone wide"),
        ("--cone", "30", "did you mean 30 deg?"),
        ("--size", "500, 600, 400", "did you mean 500 mm?"),
        ("--size", "0 m, 0 m, 0 m", "a box of no size"),
        ("--robot", "nothing.yaml", "nothing.yaml"),
        ("--driver", "carrier_pigeon", "there is no driver"),
    ],
)
def test_refuses_impossible_values_and_writes_nothing(tmp_path: Path, flag: str, value: str, why: str):
    run = agent(tmp_path, "init", "cell.yaml", flag, value)
    assert run.returncode == 2
    assert why in run.stderr
    assert "Traceback" not in run.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("number", "code"), [(errno.EROFS, 1), (errno.EACCES, 1), (errno.ENOENT, 2)])
def test_a_folder_that_cannot_be_written_is_said_before_any_question(tmp_path: Path, monkeypatch, number, code):
    monkeypatch.setattr("agent.runs.folder.TemporaryFile", Mock(side_effect=OSError(number, os.strerror(number))))
    with pytest.raises(
        AgentError, match=f"cell.yaml: cannot be written there: {os.strerror(number)}; name another"
    ) as said:
        write_recipe(tmp_path / "cell.yaml", {})
    assert said.value.exit_code == code
    with pytest.raises(AgentError, match=f"no folder for the export can be made there: {os.strerror(number)}; free"):
        make_folder(tmp_path / "out", "the export")


def test_asks_again_after_an_invalid_answer(tmp_path: Path):
    answers = ["", "", "10.0.0.9:9100", "1 m, 0 m", "1.1 m, 0 m, 0.9 m", "", "", "20 deg"]
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "agent", "init", "cell.yaml"],
        cwd=tmp_path,
        env=environment(),
        stdin=slave,
        stdout=subprocess.PIPE,
        stderr=slave,
    )
    os.close(slave)
    os.write(master, "".join(f"{answer}\n" for answer in answers).encode())
    output, _ = process.communicate(timeout=60)
    said = os.read(master, 65536).decode()
    os.close(master)
    assert process.returncode == 0, said
    assert output.decode().strip() == "cell.yaml"
    assert "three quantities with commas between are expected, not 2" in said
    recipe = load_recipe(tmp_path / "cell.yaml")
    assert recipe.controller.address == "10.0.0.9:9100"
    assert recipe.motion.via_points.box.centre == (1.1, 0.0, 0.9)
    assert recipe.robot.name == "comau_ns16"


def test_the_schema_is_next_to_the_recipe_and_named_in_it(tmp_path: Path):
    assert agent(tmp_path, "init", "cell.yaml").returncode == 0
    first = (tmp_path / "cell.yaml").read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=recipe.schema.json"
    schema = json.loads((tmp_path / "recipe.schema.json").read_text(encoding="utf-8"))
    assert {"robot", "controller", "motion"} <= set(schema["required"])
    assert "recalibrate" in schema["properties"]


def test_the_documented_schema_is_current():
    assert (ROOT / "docs" / "recipe.schema.json").read_text(encoding="utf-8") == schema_text()


def test_advises_via_points_without_a_box_for_an_arm_of_few_joints(tmp_path: Path):
    robot = ROOT / "recipes/examples/emps/robot.yaml"
    run = agent(tmp_path, "init", "slide.yaml", "--robot", str(robot))
    assert run.returncode == 0
    assert "1 joint cannot turn the tool every way" in run.stderr
    assert "`agent estimate` needs no recipe" in run.stderr
