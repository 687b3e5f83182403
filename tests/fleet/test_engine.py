"""Tasks on a real Dask: workers and scheduler are killed in the middle, and nothing is lost or done twice."""

import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from agent.core import AgentError, Console, DaskEngine, InProcess, InputError, on_dask, swept_folder
from agent.excitation import LoopProblem, search
from agent.fleet import make_question, run_fleet
from agent.motion import Pdl2Settings, ViaRegions
from agent.robot import load_robot
from tests.conftest import end_with_tests, patience
from tests.fleet.conftest import DaskProcesses, a_run_each, estimate, rows_of


def _answers(engine, tasks: int, disturb=lambda done: None) -> list[tuple[int, int]]:
    def square(number: int) -> int:  # within a function, so that it travels by value
        import time

        time.sleep(0.01)
        return number * number

    found = []
    for done in engine.map(square, range(tasks)):
        assert not done.lost
        found.append((done.number, done.answer))
        disturb(len(found))
    return sorted(found)


def test_the_in_process_engine_gives_the_same_rows():
    with InProcess() as engine:
        assert _answers(engine, 5) == [(k, k * k) for k in range(5)]


def test_a_killed_worker_does_not_change_the_answers():
    """Two local processes, one of them killed with -9 among the tasks."""
    with DaskEngine(workers=2) as engine:

        def kill(done: int) -> None:
            if done == 15:
                os.kill(min(engine._client.run(os.getpid).values()), signal.SIGKILL)

        assert _answers(engine, 60, kill) == [(k, k * k) for k in range(60)]


@pytest.mark.verify
def test_a_killed_worker_does_not_change_the_rows(plant: Path, estimated: Path, tmp_path: Path):
    """Two local processes, one of them killed with -9 in the middle of a real estimate."""
    killed = []

    class Killing(Console):
        def progress(self, text: str, done: float | None = None) -> None:
            if text.startswith("2 of"):
                killed.append(random.Random(1).choice(sorted(engine._client.run(os.getpid).values())))
                os.kill(killed[0], signal.SIGKILL)

    engine, here, out = DaskEngine(workers=2), a_run_each(plant, tmp_path / "plant"), tmp_path / "out"
    run_fleet(str(here), make_question("estimate", None, None), str(out), lambda _: engine, Killing(-1))
    assert killed
    rows = {row["run"]: row for row in rows_of(out)}
    assert rows == {row["run"]: row for row in rows_of(estimated) if row["run"] in rows}
    assert len(rows) == 5
    names = {row["model"] for row in rows.values()} - {None}
    assert names == {f"_models/{path.name}" for path in (out / "_models").iterdir()}
    assert not any((out / "_done").iterdir())


def test_removes_the_temporary_files_of_a_killed_process(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    holding = (
        "from agent.core import swept_folder\nwith swept_folder('agent-fleet-') as f: print(f, flush=True); input()"
    )
    command = [sys.executable, "-c", holding]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, stdin=-1, stdout=-1, env=environment, preexec_fn=end_with_tests) as process:
        folder = Path(process.stdout.readline().decode().strip())
        (folder / "log").write_text("", encoding="utf-8")
        os.utime(folder, (0, 0))
        with swept_folder("agent-fleet-") as own:
            assert {*tmp_path.iterdir()} == {own, folder}, "it is in use"
        process.kill()
    with swept_folder("agent-fleet-") as own:
        assert [*tmp_path.iterdir()] == [own]
    assert not any(tmp_path.iterdir())


def test_ctrl_c_reaches_the_main_process_only():
    def struck(number: int) -> int:
        import os
        import signal

        os.kill(os.getpid(), signal.SIGINT)
        return number

    with DaskEngine(workers=1) as engine:
        assert [done.answer for done in engine.map(struck, range(2))] == [0, 1]


@pytest.mark.verify
def test_a_search_on_dask_finds_the_same_loop():
    regions = ViaRegions.from_box(6, [1.0, 0.0, 1.0], [0.3] * 3, [0.0, np.pi, 0.0], 0.3)
    problem = LoopProblem(load_robot("comau_ns16"), regions, Pdl2Settings(linear_speed=0.5))
    asked = {"population": 12, "generations": 2, "seed": 3}
    with DaskEngine(workers=2) as engine:
        there = search(problem, **asked, engine=engine)
    here = search(problem, **asked, engine=InProcess())
    assert there.to_dict() == here.to_dict()


def test_a_killed_scheduler_ends_the_run_with_the_command_to_continue(cluster: DaskProcesses, monkeypatch):
    monkeypatch.setattr(on_dask, "_CONNECT", patience(4.0))
    with DaskEngine(cluster.address) as engine, pytest.raises(AgentError, match="run the same command again"):
        _answers(engine, 400, lambda done: cluster.kill("scheduler") if done == 15 else None)


def test_a_run_that_is_ended_is_continued_by_the_same_command(plant: Path, estimated: Path, tmp_path: Path):
    class Ending(Console):
        def progress(self, text: str, done: float | None = None) -> None:
            if text.startswith("2 of"):
                raise KeyboardInterrupt

    here, out = a_run_each(plant, tmp_path / "plant"), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        estimate(here, out, Ending(-1))
    assert not (out / "rows.parquet").exists(), "nothing is in place before all of it is"
    summary = estimate(here, out)
    assert (summary.done, summary.kept) == (3, 2)
    rows = {row["run"]: row for row in rows_of(out)}
    assert rows == {row["run"]: row for row in rows_of(estimated) if row["run"] in rows}


def test_an_unreachable_scheduler_is_a_usage_error(monkeypatch):
    monkeypatch.setattr(on_dask, "_CONNECT", 0.2)
    with pytest.raises(InputError, match="no Dask scheduler answers there"), DaskEngine("tcp://127.0.0.1:1"):
        pass


def test_an_invalid_address_is_a_usage_error_and_leaves_no_thread():
    before = set(threading.enumerate())
    with pytest.raises(InputError, match="missing port"), DaskEngine("nonsense"):
        pass
    assert set(threading.enumerate()) == before, "the process would not end"


@pytest.mark.verify
def test_reports_a_task_that_kills_its_workers_and_finishes_the_others():
    def hog(number: int) -> int:
        import os
        import signal

        if number == 3:
            os.kill(os.getpid(), signal.SIGKILL)  # as the limit of memory does
        return number

    with DaskEngine(workers=1, memory="1GiB") as engine:
        found = {done.number: done for done in engine.map(hog, range(6))}
    assert [found[k].answer for k in range(6)] == [0, 1, 2, None, 4, 5]
    assert "memory" in found[3].lost
    assert "1GiB" in found[3].lost


@pytest.mark.verify
def test_exceeding_the_memory_limit_fails_that_task_only(measured):
    def hog(number: int) -> int:
        import time

        kept = []
        for _ in range(200 if number == 3 else 0):
            kept.append(bytearray(os.urandom(1) * 20_000_000))
            time.sleep(0.01)
        return number

    with DaskEngine(workers=2, memory="600MiB") as engine:
        found = {done.number: done for done in engine.map(hog, range(10))}
    assert [found[k].answer for k in range(10)] == [0, 1, 2, None, *range(4, 10)]
    measured("a task that takes 4 GB under a limit of 600 MiB: others done", 9, "of 9", "9", True)


@pytest.mark.verify
def test_twenty_killed_workers_do_not_change_the_rows(plant: Path, estimated: Path, tmp_path: Path, measured):
    draw, right = random.Random(time.time()), 0
    for moment in range(20):
        out = tmp_path / str(moment)
        with DaskEngine(workers=2) as engine:
            delay = draw.uniform(0.0, 4.0)

            def kill(engine=engine) -> None:
                victims = [worker.process.pid for worker in engine._cluster.workers.values()]
                os.kill(draw.choice(victims), signal.SIGKILL)

            timer = threading.Timer(delay, kill)
            timer.start()
            question = make_question("estimate", None, None)
            run_fleet(str(plant), question, str(out), lambda _, engine=engine: nullcontext(engine), Console(-1))
            timer.join()
        right += rows_of(out) == rows_of(estimated)
    measured("kill -9 of a worker at random moments: results equal row by row", right, "of 20", "20", right == 20)
    assert right == 20
