from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.excitation.scoring import LoopScore
from agent.excitation.workers import Workers

ROOT = Path(__file__).parents[2]
GENOMES = np.arange(21.0).reshape(7, 3)
SUM = "lambda genome: __import__('agent.excitation.scoring', fromlist=['LoopScore']).LoopScore(float(genome.sum()))"
REFUSED = "lambda genome: __import__('agent.robot', fromlist=['x']).load_robot('less')"


@pytest.mark.parametrize("count", [1, 2])
def test_scores_come_in_the_order_of_the_genomes(count: int) -> None:
    with Workers(eval, SUM, count) as workers:
        for genomes in (GENOMES, GENOMES[::-1], GENOMES[:1]):
            assert workers.evaluate(genomes) == [LoopScore(float(genome.sum())) for genome in genomes]


@pytest.mark.parametrize(
    ("problem", "message"),
    [
        ("lambda genome: 1 / 0", "ZeroDivisionError"),
        ("nonsense", "NameError"),
        ("lambda genome: __import__('os')._exit(3)", "killed"),
    ],
)
def test_a_worker_that_fails_says_why(problem: str, message: str) -> None:
    with pytest.raises(RuntimeError, match=message), Workers(eval, problem, 1 + 1) as workers:
        workers.evaluate(GENOMES)


@pytest.mark.parametrize("count", [1, 2])
def test_a_users_error_arrives_as_one(count: int) -> None:
    with pytest.raises(InputError, match="less"), Workers(eval, REFUSED, count) as workers:
        workers.evaluate(GENOMES)


SEARCH = f"""
import sys
from agent.excitation.workers import Workers
import numpy as np
if __name__ == "__main__":
    with Workers(eval, {SUM!r}, 2) as workers:
        workers.evaluate(np.ones((4, 3)))
        print("working", flush=True)
        while True:
            workers.evaluate(np.ones((4, 3)))
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_the_search(tmp_path: Path, how: signal.Signals) -> None:
    script = tmp_path / "endless.py"
    script.write_text(SEARCH, encoding="utf-8")
    main = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    )
    assert main.stdout is not None
    assert main.stdout.readline() == "working\n"
    main.send_signal(how)
    # The workers share its pipes: these end when the last of them does.
    main.communicate(timeout=60)
    assert main.returncode != 0


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}
