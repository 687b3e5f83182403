"""Healthy motions on every wire, in real time, on a machine that has other things to do: none is stopped."""

import itertools
import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fake_controller.servers import WIRES
from tests.conftest import ROOT, end_with_tests, environment, mosquitto

MOTIONS = 10  # on each wire in a piece
PIECES = 4
DRIVERS = (*WIRES, "ur")


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, *arguments]
    return subprocess.Popen(
        command, env=environment(), stdout=subprocess.PIPE, text=True, cwd=ROOT, preexec_fn=end_with_tests
    )


def run(wire: str, first: int) -> list[dict]:
    """How the motions on one wire ended."""
    worker = start(str(Path(__file__).with_name("healthy.py")), wire, str(first), str(first + MOTIONS - 1))
    return [json.loads(line) for line in worker.communicate()[0].splitlines()]


@pytest.mark.verify
@pytest.mark.parametrize("piece", range(PIECES))
def test_no_healthy_motion_is_stopped_on_a_loaded_machine(piece, measured):
    """Two wires at a time, each with an agent and an emulator, while a loop keeps each core busy.

    `cnr_comau` needs a broker, and is left out where there is none.
    """
    drivers = [driver for driver in DRIVERS if driver != "cnr_comau" or mosquitto()]
    firsts = itertools.count(piece * MOTIONS * len(DRIVERS), MOTIONS)
    busy = [start("-c", "while True: pass") for _ in range(os.cpu_count() or 1)]
    try:
        with ThreadPoolExecutor(2) as two:
            ended = list(itertools.chain.from_iterable(two.map(run, drivers, firsts)))
    finally:
        for process in busy:
            process.kill()
            process.wait()
    stopped = [one for one in ended if one["code"] != 0]
    measured(
        f"healthy motions on {', '.join(drivers)}, real time, loaded machine, piece {piece + 1} of {PIECES}: stopped",
        len(stopped),
        f"of {len(ended)}",
        "none",
        not stopped,
    )
    assert len(ended) == MOTIONS * len(drivers)
    assert stopped == []
