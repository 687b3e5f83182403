"""Tab completes what a command takes, as a shell asks for it."""

import os
import subprocess
import sys

import pytest

from drivers import registry
from tests.conftest import ROOT


def _completed(line: str, cwd) -> list[str]:
    """What bash would offer for the last word of a line."""
    words = line.split(" ")
    env = {"_AGENT_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    command = [sys.executable, "-c", "from agent.cli.app import app; app(prog_name='agent')"]
    run = subprocess.run(
        command,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), **env},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stderr == ""
    return run.stdout.split()


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
def test_values_are_completed(line, offered, tmp_path):
    for name in ("cell.yaml", "arm.urdf", "log.mcap"):
        (tmp_path / name).touch()
    (tmp_path / "folder").mkdir()
    assert offered <= set(_completed(line, tmp_path))
    assert "log.mcap" not in _completed(line, tmp_path)
