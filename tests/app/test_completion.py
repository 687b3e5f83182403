"""Tab completes what a command takes, as a shell asks for it."""

import subprocess
import sys

import pytest

from agent.cli.app import app
from drivers import registry
from tests.conftest import environment


def _asked(line: str) -> dict[str, str]:
    """What bash sets to ask for the last word of a line."""
    return {"_AGENT_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1)}


@pytest.fixture
def folder(tmp_path):
    for name in ("cell.yaml", "arm.urdf", "log.mcap"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    return tmp_path


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("agent export model.json --load u", {"ur"}),
        ("agent estimate --method pa", {"paper"}),
        ("agent estimate --effort tor", {"torque", "torque-without-gravity"}),
        ("agent emulator --robot ur5e --c", {"--clock"}),
        ("agent emulator --driver u", {"ur"}),
        ("agent init --driver ", set(registry.available())),
        ("agent diagnose --without gravity", {"gravity_spring"}),
        ("agent check ", {"cell.yaml", "folder/"}),
        ("agent estimate --robot ", {"comau_ns16", "ur5e", "arm.urdf", "cell.yaml", "folder/"}),
    ],
)
def test_values_are_completed(line, offered, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    for name, value in _asked(line).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        app(prog_name="agent")
    said = capsys.readouterr()
    assert said.err == ""
    assert offered <= set(said.out.split())
    assert "log.mcap" not in said.out.split()


def test_a_shell_is_answered_by_the_program(folder):
    asked = environment() | _asked("agent check c")
    command = [sys.executable, "-c", "from agent.cli.app import app; app(prog_name='agent')"]
    run = subprocess.run(command, cwd=folder, env=asked, capture_output=True, text=True, check=False)
    assert (run.stdout.split(), run.stderr) == (["cell.yaml"], "")
