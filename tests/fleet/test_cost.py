"""Overhead of a fleet: processor time, time, and memory of scheduler and client."""

import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import pytest

from agent.core import Console, DaskEngine
from agent.fleet import make_question, run_fleet, simulate_fleet

#: Estimates that are made up, of the size of real ones, by two local workers; prints the client's memory [MiB].
SCRIPT = """
import resource, sys
from agent.core.console import Console
from agent.core.on_dask import DaskEngine
from agent.fleet import execution, make_question, run_fleet
from agent.fleet.worker import TaskRow

def made_up(task):
    import hashlib
    from agent.fleet.worker import TaskRow
    inputs = [{"path": f.path, "size": f.size, "stamp": f.stamp, "sha256": "0" * 64} for f in task.files]
    entry = {"name": "f0_1", "unit": "N·m", "value": 1.0, "standard_deviation": 0.1}
    level = {"joint": "joint_1", "speed": 1.0, "value": 1.0, "standard_deviation": 0.1, "from_run_to_run": 0.1}
    row = {"status": "ok", "exit_code": 0, "reason": "", "joints": ["joint_1"] * 6, "rmse": [0.1] * 6,
           "normalised_rmse": [0.1] * 6, "parameters": [entry] * 60, "friction": [level] * 12}
    return TaskRow(row, inputs, hashlib.sha256(task.run.encode()).digest() * 4000, 0.0, 0)

made_up.__module__ = "__main__"
if __name__ == "__main__":
    execution.run_task = made_up
    run_fleet(sys.argv[1], make_question("estimate", "comau_ns16", None), sys.argv[2],
              lambda _: DaskEngine(workers=2), Console(-1))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10)
"""


def _memory(folder: Path, runs: int) -> int:
    for number in range(runs):
        run = folder / f"plant_{runs}" / f"robot_{number:05d}"
        run.mkdir(parents=True)
        (run / "a.mcap").write_bytes(b"x")
    script = folder / "script.py"
    script.write_text(SCRIPT, encoding="utf-8")
    command = [sys.executable, str(script), str(folder / f"plant_{runs}"), str(folder / f"out_{runs}")]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.verify
def test_memory_of_scheduler_and_client_is_flat(tmp_path: Path, measured):
    """Models of 128 kB and rows of 5 kB: two hundred times what may be added would come together."""
    few, many = _memory(tmp_path, 100), _memory(tmp_path, 10_000)
    measured("scheduler and client, 100 rows", few, "MiB")
    measured("scheduler and client, 10 000 rows", many, "MiB", "at most 100 MiB more", many - few <= 100)
    assert many - few <= 100


@pytest.mark.verify
def test_two_workers_against_one(arm: str, tmp_path: Path, measured):
    """Both are there before the clock is started; each has loaded what it needs."""
    simulate_fleet(arm, 60, 1, 1, str(tmp_path / "plant"), rows=False)
    simulate_fleet(arm, 4, 1, 2, str(tmp_path / "warm"), rows=False)
    seconds, work = {}, {}
    for workers in (1, 2):
        with DaskEngine(workers=workers) as engine:
            question = make_question("estimate", None, None)
            for place in ("warm", "plant"):
                began = time.monotonic()
                out = str(tmp_path / f"{place}_{workers}")
                summary = run_fleet(
                    str(tmp_path / place), question, out, lambda _, e=engine: nullcontext(e), Console(-1)
                )
                seconds[workers], work[workers] = time.monotonic() - began, summary.cpu_s
    ratio, overhead = seconds[1] / seconds[2], 100 * (seconds[1] / work[1] - 1)
    measured("two local workers against one", ratio, "x", "at least 1.8", ratio >= 1.8)
    measured(
        "one worker, all that is not its work (needs a quiet machine)", overhead, "%", "at most 5 %", overhead <= 5
    )
