"""What is published is complete: a wheel, built from the archive of the sources, calibrates in an empty environment."""

import os
import subprocess
import sys
import tomllib
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.conftest import ROOT

#: Nothing of the checkout, and nothing of the environment that runs the tests.
ALONE = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}


def test_every_recipe_and_example_is_part_of_the_package():
    folders = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["data-files"]
    packed = {path for patterns in folders.values() for pattern in patterns for path in ROOT.glob(pattern)}
    there = {path for path in (ROOT / "recipes").rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    assert packed == there
    assert {folder.removeprefix("share/calibration-agent/") for folder in folders} == {
        path.parent.relative_to(ROOT).as_posix() for path in there
    }


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> Path:
    """An environment with the wheel and what `requirements.lock` names; nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "build", "--outdir", folder, ROOT], check=True, env=ALONE)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", with_pip=True)
    install = [folder / "venv/bin/python", "-m", "pip", "install", "--quiet"]
    subprocess.run([*install, "--constraint", ROOT / "requirements.lock", wheel], check=True, env=ALONE)
    return folder / "venv"


@pytest.fixture
def installed(environment: Path, tmp_path: Path):
    """Runs `agent` of the wheel in the test's folder."""

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [environment / "bin/agent", *arguments]
        return subprocess.run(command, cwd=tmp_path, env=ALONE, capture_output=True, text=True, check=False)

    return run


@pytest.fixture
def address(environment: Path, tmp_path: Path) -> Iterator[str]:
    """The emulator of the wheel, on a free port."""
    options = ["--robot", "comau_ns16", "--port", "0", "--seed", "7", "--clock", "fast"]
    emulator = subprocess.Popen(
        [environment / "bin/agent", "emulator", *options], cwd=tmp_path, env=ALONE, stdout=subprocess.PIPE, text=True
    )
    assert emulator.stdout is not None
    try:
        yield emulator.stdout.readline().split(" at ")[1].split(", clock")[0]
    finally:
        emulator.terminate()
        emulator.wait()
        emulator.stdout.close()


@pytest.mark.verify
def test_the_wheel_prints_its_version_and_writes_a_recipe(installed, tmp_path: Path):
    assert installed("--version").stdout.strip()
    assert installed("init").returncode == 0
    assert (tmp_path / "recipe.yaml").is_file()
    doctor = installed("doctor")
    assert doctor.returncode == 0, doctor.stdout
    assert "pip install 'calibration-agent[mujoco]'" in doctor.stdout


@pytest.mark.verify
def test_the_wheel_calibrates_the_emulated_robot(environment: Path, installed, address: str, tmp_path: Path):
    shipped = environment / "share/calibration-agent/recipes/first_look.yaml"
    recipe = tmp_path / "first_look.yaml"
    recipe.write_text(shipped.read_text("utf-8").replace("127.0.0.1:9100", address), encoding="utf-8")
    check = installed("check", "first_look.yaml")
    assert check.returncode == 0, check.stdout
    calibration = installed("calibrate", "first_look.yaml")
    assert calibration.returncode == 0, calibration.stderr
    assert list(tmp_path.glob("logs/*/report.html"))
