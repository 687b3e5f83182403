"""Tasks on processes of this machine."""

import os
import signal
import subprocess
import sys
from functools import partial
from operator import floordiv
from pathlib import Path

import pytest

from agent.core import InProcess, InputError, LocalProcesses
from agent.robot import load_robot
from tests.conftest import end_with_tests, environment


def test_every_result_carries_the_number_of_its_task() -> None:
    with LocalProcesses(2) as engine:
        for function in (abs, float, abs):
            for tasks in (range(-7, 0), [-5.0], []):
                found = {done.number: done.answer for done in engine.map(function, tasks)}
                assert [found[number] for number in range(len(tasks))] == [function(task) for task in tasks]


@pytest.mark.parametrize(
    ("function", "task", "message"), [(partial(floordiv, 1), 0, "ZeroDivisionError"), (os._exit, 3, "killed")]
)
def test_reports_why_a_process_failed(function, task, message: str) -> None:
    with pytest.raises(RuntimeError, match=message), LocalProcesses(2) as engine:
        list(engine.map(function, [task]))


def test_a_user_error_in_a_worker_stays_a_user_error() -> None:
    for engine in (InProcess(), LocalProcesses(2)):
        with pytest.raises(InputError, match="less"), engine:
            list(engine.map(load_robot, ["less"]))


ENDLESS = """
from agent.core import LocalProcesses
if __name__ == "__main__":
    with LocalProcesses(2) as engine:
        list(engine.map(abs, range(4)))
        print("working", flush=True)
        while True:
            list(engine.map(abs, range(4)))
"""


# its answer takes for ever to pickle: the pool takes any exception there for a task's failure, and goes on
BETWEEN_TWO_TASKS = """
from agent.core import LocalProcesses

class Answer:
    def __reduce__(self):
        print("working", flush=True)
        while True:
            pass

def answer(_):
    return Answer()

if __name__ == "__main__":
    with LocalProcesses(1) as engine:
        list(engine.map(answer, [0]))
"""


@pytest.mark.parametrize("program", [ENDLESS, BETWEEN_TWO_TASKS], ids=["in tasks", "between two tasks"])
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_worker_processes_end_with_their_parent(tmp_path: Path, how: signal.Signals, program: str) -> None:
    script = tmp_path / "endless.py"
    script.write_text(program, encoding="utf-8")
    main = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
        preexec_fn=end_with_tests,
    )
    assert main.stdout is not None
    assert main.stdout.readline() == "working\n"
    main.send_signal(how)
    try:  # the workers share its pipes: these end when the last of them does
        main.communicate(timeout=60)
    finally:
        main.kill()
    assert main.returncode != 0
