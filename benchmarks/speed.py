"""Processor time and memory of this tree, next to another commit.

    python benchmarks/speed.py [--against WORKTREE] [--full]

CPU times (user and system) and peak memory of processes on one thread. Trees take turns and the best of two rounds
counts, because other jobs on a machine only ever add. `--against` is a checkout of another commit (`git worktree add
../before HEAD~1`). `--full` runs the quickstart as it is. Ratios of rows do not depend on the machine: one above its
bar (`BARS`) ends the benchmark with an error.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RECIPE = ROOT / "recipes/ns16_quickstart.yaml"
ROUNDS = 2
_COMMAND = """
import atexit, json, runpy, sys, time

def tell():
    with open("/proc/self/status") as status:
        peak = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    with open(note, "w") as file:
        json.dump([time.process_time(), peak / 1024], file)

note = sys.argv.pop(1)
sys.path.insert(0, "")
atexit.register(tell)
runpy.run_module("agent", run_name="__main__")
"""
Table = dict[str, dict[str, float]]  # by tree and row
#: At most this many times the CPU time of another row. Do not raise one without a reason.
BARS = (
    ("diagnose, 4 logs of 20 s", "estimate, 3 logs of 20 s", 1.7),
    ("diagnose, 9 logs of 20 s", "diagnose, 4 logs of 20 s", 2.0),
)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="a checkout of another commit")
    parser.add_argument("--full", action="store_true", help="the whole quickstart: minutes")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        print(json.dumps(candidate_ms()))
        return
    trees = {"here": ROOT} | ({} if given.against is None else {"before": given.against.resolve()})
    with tempfile.TemporaryDirectory() as name:
        candidates(trees)
        commands(trees, Path(name))
        job(trees, Path(name), given.full)


def candidates(trees: dict[str, Path]) -> None:
    """A candidate of the search and its parts."""
    best: Table = {tree: {} for tree in trees}
    for _ in range(ROUNDS):
        for tree, root in trees.items():
            worker = [sys.executable, __file__, "--worker"]
            run = subprocess.run(worker, cwd=root, env=environment(root), stdout=subprocess.PIPE, text=True, check=True)
            for row, value in json.loads(run.stdout.splitlines()[-1]).items():
                best[tree][row] = min(best[tree].get(row, np.inf), value)
    table("one candidate of the search, COMAU NS16 [ms]", trees, best)


def candidate_ms() -> dict[str, float]:
    """In a process of its own, with the agent of the tree it runs in: mean CPU [ms] of the parts."""
    from agent.core import one_blas_thread
    from agent.excitation import Candidates, Criterion
    from agent.excitation.scoring import Scorer
    from agent.pipeline.planning.plan import loop_problem
    from agent.recipe import load_recipe

    recipe = load_recipe(RECIPE)
    problem = loop_problem(recipe, recipe.motion.speed)
    found, criterion = Candidates(problem), Criterion(recipe.robot, recipe.tool)
    genomes = np.random.default_rng(0).random((21, problem.genes))
    together = 7  # as many as a search hands to a process at once
    with one_blas_thread():
        loops = [found.loop(genome).trajectory for genome in genomes]
        tenths = [(loop.q[::10], loop.qd[::10], loop.qdd[::10]) for loop in loops]
        return {
            "all of it": cpu(Scorer(problem), np.split(genomes, len(genomes) // together)) / together,
            "  interpolation, all samples": cpu(found.loop, list(genomes)),
            "  cell, all samples": cpu(lambda loop: found._cell.check(loop, 0.02), loops),
            "  regressor and determinant": cpu(lambda tenth: criterion(*tenth), tenths),
        }


def commands(trees: dict[str, Path], folder: Path) -> None:
    """Commands on a minute of log, process start included."""
    minute, model, known = folder / "minute.mcap", folder / "model.json", folder / "known.json"
    write(minute, 60.0)
    whole, short = [folder / f"whole{k}.mcap" for k in range(3)], [folder / f"stribeck{k}.mcap" for k in range(9)]
    for k, log in enumerate(whole):
        write(log, 20.0, seed=k)
    for k, log in enumerate(short):
        write(log, 20.0, seed=20 + k, stribeck=250.0)
    calls = {
        "estimate": ["estimate", "--robot", "comau_ns16", "-o", str(model), str(minute)],
        "validate": ["validate", "--model", str(model), str(minute)],
        "check": ["check", str(RECIPE)],
        "diagnose, 3 logs of 20 s, no gap": ["diagnose", "--robot", "comau_ns16", *map(str, whole)],
        "diagnose, 3 logs of 20 s, a gap of one joint": ["diagnose", "--model", str(model), *map(str, short[:3])],
        "estimate, 3 logs of 20 s": ["estimate", "--robot", "comau_ns16", "-o", str(known), *map(str, whole)],
        "diagnose, 4 logs of 20 s": ["diagnose", "--model", str(known), *map(str, short[:4])],
        "diagnose, 9 logs of 20 s": ["diagnose", "--model", str(known), *map(str, short)],
        "--help": ["--help"],
    }
    seconds: Table = {tree: {} for tree in trees}
    memory: Table = {tree: {} for tree in trees}
    for _ in range(ROUNDS):
        for tree, root in trees.items():
            for name, call in calls.items():
                spent, memory[tree][name] = measured(root, call)
                seconds[tree][name] = min(seconds[tree].get(name, np.inf), spent)
    table("a minute of log, six joints, process start included [s of CPU]", trees, seconds)
    table("the same, peak memory [MiB]", trees, memory)
    here = seconds["here"]
    over = [(*bar, ratio) for bar in BARS if (ratio := here[bar[0]] / here[bar[1]]) > bar[2]]
    if over:
        raise SystemExit("\n".join("{0}: {3:.2f} times {1}, and {2} is the bar".format(*found) for found in over))


def job(trees: dict[str, Path], folder: Path, full: bool) -> None:
    """The quickstart against the emulated controller, two processes: as it is, or with a tenth of its work."""
    text = RECIPE.read_text(encoding="utf-8")
    if not full:
        text = text.replace("population: 50, generations: 40", "population: 20, generations: 10")
        text = text.replace("motions: 30", "motions: 3")
    values: Table = {tree: {} for tree in trees}
    for tree, root in trees.items():
        command = [sys.executable, "-m", "fake_controller", "--robot", "comau_ns16", "--port", "0", "--seed", "7"]
        options: dict[str, Any] = {"env": environment(root), "cwd": folder, "stdout": subprocess.PIPE, "text": True}
        controller = subprocess.Popen([*command, "--clock", "fast"], **options)
        try:
            address = controller.stdout.readline().split(" at ")[1].split(", clock")[0]
            recipe = folder / "quickstart.yaml"
            recipe.write_text(text.replace("127.0.0.1:9100", address), encoding="utf-8")
            begin = time.monotonic()
            calibrate = [sys.executable, "-m", "agent", "calibrate", str(recipe), "--yes", "-q"]
            _, status, used = os.wait4(subprocess.Popen(calibrate, **options).pid, 0)
            spent = time.monotonic() - begin
        finally:
            controller.terminate()
            _, _, other = os.wait4(controller.pid, 0)
        if status:
            raise SystemExit("agent calibrate failed")
        values[tree] = {
            "from start to end": spent,
            "CPU of the agent": used.ru_utime + used.ru_stime,
            "CPU of the emulated controller": other.ru_utime + other.ru_stime,
        }
    table(f"calibrate, {'the quickstart' if full else 'a tenth of the quickstart'} [s]", trees, values)


def cpu(call: Callable[[Any], object], arguments: list) -> float:
    """Mean CPU time [ms] of a call: for each argument the best of three, after one to warm up."""
    call(arguments[0])
    best = np.full(len(arguments), np.inf)
    for _ in range(3):
        for k, argument in enumerate(arguments):
            begin = time.process_time()
            call(argument)
            best[k] = min(best[k], time.process_time() - begin)
    return float(1e3 * best.mean())


def measured(root: Path, call: list[str]) -> tuple[float, float]:
    """CPU time [s] since its start and peak memory [MiB] of one command of the agent in a tree."""
    with tempfile.NamedTemporaryFile() as note:
        command = [sys.executable, "-c", _COMMAND, note.name, *call]
        run = subprocess.run(command, cwd=root, env=environment(root), capture_output=True, text=True, check=False)
        if run.returncode == 1 or not (text := Path(note.name).read_text()):
            raise SystemExit(f"agent {' '.join(call)} failed:\n{run.stderr}")
    spent, peak = json.loads(text)
    return spent, peak


def environment(root: Path) -> dict[str, str]:
    """One thread, and the agent of this tree."""
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)}


def table(title: str, trees: dict[str, Path], values: Table) -> None:
    """One row a figure, one column a tree, and the ratio of before to here."""
    print(f"\n{title:60}" + "".join(f"{tree:>10}" for tree in trees) + ("     ratio" if len(trees) > 1 else ""))
    for row in values["here"]:
        cells = [values[tree].get(row, np.nan) for tree in trees]
        ratio = f"{cells[1] / cells[0]:10.2f}" if len(cells) > 1 else ""
        print(f"{row:60}" + "".join(f"{cell:10.2f}" for cell in cells) + ratio, flush=True)


def write(path: Path, seconds: float, seed: int = 0, stribeck: float = 0.0) -> None:
    """A log of the emulated arm on a random loop, with Stribeck friction on joint 2 up to a level [N·m]."""
    from agent.pipeline.planning.plan import loop_problem
    from agent.recipe import load_recipe
    from agent.recording import write_log
    from benchmarks.evidence.emulation import repeated
    from benchmarks.evidence.loops import LocalLoops, random_loops
    from fake_controller.plant import Plant

    recipe = load_recipe(RECIPE)
    candidates = LocalLoops(loop_problem(recipe, recipe.motion.speed))
    (loop,) = random_loops(candidates, 1, np.random.default_rng(seed))
    effect = {"effect": "stribeck", "joints": ["joint_2"], "parameters": {"rise": stribeck, "speed": 0.1}}
    log = repeated(Plant(recipe.robot, 7, [effect] if stribeck else []), loop, seconds)
    write_log(path, replace(log, path=path, metadata={"robot": recipe.robot.name, "motion": "cost"}))


if __name__ == "__main__":
    sys.path.insert(0, os.environ.get("PYTHONPATH", str(ROOT)).split(os.pathsep)[0])
    main()
