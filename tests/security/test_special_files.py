"""What is no regular file, or too long, under the name of every kind of file that the agent reads: one message."""

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.core import LARGEST_JSON, LARGEST_PROGRAM, LARGEST_ROBOT_FILE, InputError, sha256_file
from agent.fleet.tasks import make_question
from agent.model import IdentifiedModel
from agent.recipe import load_recipe
from agent.recording import read_log
from agent.robot import load_robot

#: Memory that a reader may take beyond what is there [bytes].
MEMORY = 2 << 30
ROBOT = """name: arm
urdf: {urdf}
tip_frame: flange
joints: [{{name: a, gear_ratio: 1, max_velocity: 1, max_acceleration: 1}}]
"""


def robot_with(path: Path) -> object:
    description = path.with_name("robot.yaml")
    description.write_text(ROBOT.format(urdf=path.name))
    return load_robot(str(description))


def simulator(path: Path) -> object:
    from agent.simulators import load_arm

    return load_arm(path)


def program(path: Path) -> object:
    from agent.core import read_text

    return read_text(path, LARGEST_PROGRAM)


#: What reads a file, its usual ending, and a length in bytes that is too much; 0: it reads as much as there is.
READERS: dict[str, tuple[Callable[[Path], object], str, int]] = {
    "URDF of a robot": (robot_with, ".urdf", LARGEST_ROBOT_FILE),
    "robot.yaml": (lambda path: load_robot(str(path)), ".yaml", 1 << 20),
    "URDF alone": (simulator, ".urdf", LARGEST_ROBOT_FILE),
    "MJCF": (simulator, ".xml", LARGEST_ROBOT_FILE),
    "model": (IdentifiedModel.load, ".json", LARGEST_JSON),
    "recipe": (load_recipe, ".yaml", 1 << 20),
    "program": (program, ".pdl", LARGEST_PROGRAM),
    "log": (read_log, ".mcap", 0),
    "checksum": (sha256_file, ".bin", 0),
    "model of a fleet": (lambda path: make_question("validate", None, str(path)), ".json", 0),
}


@pytest.fixture(autouse=True)
def little_memory():
    """So that a reader that goes on fails, and does not take the machine with it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


@pytest.mark.parametrize("make", [pipe, endless])
@pytest.mark.parametrize("name", READERS)
def test_what_is_no_regular_file_is_refused(tmp_path, name, make):
    read, ending, _ = READERS[name]
    path = tmp_path / f"given{ending}"
    make(path)
    with pytest.raises((InputError, OSError), match=r"not a regular file|no such model file"):
        read(path)


@pytest.mark.parametrize("name", [name for name, (*_, size) in READERS.items() if size])
def test_a_file_that_is_too_long_is_refused(tmp_path, name):
    read, ending, size = READERS[name]
    path = tmp_path / f"given{ending}"
    path.touch()
    os.truncate(path, size + 1)
    with pytest.raises(InputError, match=r"longer than \d+ [KM]iB"):
        read(path)


def test_warnings_of_libraries_do_not_reach_the_terminal():
    """Neither from the command nor from processes that it starts."""
    warn = "import numpy; numpy.log(numpy.zeros(1))"
    code = (
        "import subprocess, sys\nfrom agent.cli import entry_point\n"
        f"def called():\n    {warn}\n    subprocess.run([sys.executable, '-c', {warn!r}], check=True)\n"
        "entry_point._called = called\nentry_point.main()"
    )
    clean = {key: value for key, value in os.environ.items() if key != "PYTHONWARNINGS"}
    ended = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
