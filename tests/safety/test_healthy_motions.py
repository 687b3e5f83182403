"""Healthy motions on every wire, in real time, on a machine that has other things to do: none is stopped."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from fake_controller.servers import WIRES
from tests.conftest import end_with_tests

ROOT = Path(__file__).resolve().parents[2]
MOTIONS = 40  # on each wire


def start(*arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, text=True, cwd=ROOT, preexec_fn=end_with_tests
    )


@pytest.mark.verify
def test_no_healthy_motion_is_stopped_on_a_loaded_machine(measured):
    """All wires at once, each with an agent and an emulator, beside a loop that keeps each core busy."""
    script = str(Path(__file__).with_name("healthy.py"))
    busy = [start("-c", "while True: pass") for _ in range(os.cpu_count() or 1)]
    wires = [
        start(script, wire, str(MOTIONS * place), str(MOTIONS * (place + 1) - 1)) for place, wire in enumerate(WIRES)
    ]
    try:
        ended = [json.loads(line) for wire in wires for line in wire.communicate()[0].splitlines()]
    finally:
        for process in (*busy, *wires):
            process.kill()
            process.wait()
    stopped = [one for one in ended if one["code"] != 0]
    measured(
        "healthy motions on all wires, real time, loaded machine: stopped",
        len(stopped),
        f"of {len(ended)}",
        "none",
        not stopped,
    )
    assert len(ended) == MOTIONS * len(WIRES)
    assert stopped == []
