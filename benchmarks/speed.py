"""What things cost, beside the commit before and beside figaroh, in one run.

    python benchmarks/speed.py [--against WORKTREE] [--figaroh PYTHON] [--full]

CPU times (user and system) and peak memory of processes on one thread; trees take turns and the best of the rounds
counts, because other jobs on a machine only ever add. `--against` is a checkout of another commit (`git worktree add
../before HEAD~1`), `--figaroh` the Python of an environment with figaroh. `--full` runs the quickstart as it is.
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
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RECIPE = ROOT / "recipes/ns16_quickstart.yaml"
RATE = 500.0
ROUNDS = 2
_TURN = float(np.pi / 2)
#: Origin [m] and roll [rad] of each joint, which turns about z: an offset wrist, and a shoulder of three joints.
#: Neither has a closed-form inverse here.
SIX = [
    (0, 0, 0.1, 0),
    (0, 0, 0.09, _TURN),
    (-0.42, 0, 0, 0),
    (-0.39, 0, 0, 0),
    (0, 0, 0.11, _TURN),
    (0, 0, 0.09, -_TURN),
]
SEVEN = [
    (0, 0, 0.33, 0),
    (0, 0, 0, -_TURN),
    (0, -0.32, 0, _TURN),
    (0.08, 0, 0, _TURN),
    (-0.08, 0.38, 0, -_TURN),
    (0, 0, 0, _TURN),
    (0.09, 0, 0, _TURN),
]
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


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="a checkout of another commit")
    parser.add_argument("--figaroh", type=Path, help="the Python of an environment with figaroh")
    parser.add_argument("--full", action="store_true", help="the whole quickstart: minutes")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        work()
        return
    trees = {"here": ROOT} | ({} if given.against is None else {"before": given.against.resolve()})
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        parts(trees)
        commands(trees, folder)
        job(trees, folder, given.full)
    if given.figaroh is not None:
        subprocess.run([sys.executable, ROOT / "benchmarks/against_figaroh.py", "--python", given.figaroh], check=False)


def parts(trees: dict[str, Path]) -> None:
    """A candidate of the search and its parts."""
    best: dict[str, dict[str, float]] = {tree: {} for tree in trees}
    for _ in range(ROUNDS):
        for tree, root in trees.items():
            run = subprocess.run(
                [sys.executable, __file__, "--worker"],
                cwd=root,
                env=environment(root),
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            for row, value in json.loads(run.stdout.splitlines()[-1]).items():
                best[tree][row] = min(best[tree].get(row, np.inf), value)
    table("one candidate of the search [ms]", trees, best)


def work() -> None:
    """In a process of its own, with the agent of the tree it runs in: mean CPU [ms] of the parts, as JSON."""
    from agent.excitation import Candidates, Criterion, LoopProblem
    from agent.excitation.criterion import one_blas_thread
    from agent.excitation.loop_search import Scorer
    from agent.motion import ViaRegions
    from agent.pipeline.plan import loop_problem
    from agent.recipe import load_recipe

    recipe = load_recipe(RECIPE)
    problem = loop_problem(recipe, recipe.motion.speed)
    candidates, criterion = Candidates(problem), Criterion(recipe.robot, recipe.tool)
    genomes = np.random.default_rng(0).random((21, problem.genes))
    together = 7  # as many as a search hands to a process at once
    with one_blas_thread():
        loops = [candidates.loop(genome).trajectory for genome in genomes]
        tenths = [(loop.q[::10], loop.qd[::10], loop.qdd[::10]) for loop in loops]
        rows = {
            "COMAU NS16, closed-form inverse": cpu(Scorer(problem), np.split(genomes, len(genomes) // together))
            / together,
            "  interpolation, all samples": cpu(candidates.loop, list(genomes)),
            "  cell, all samples": cpu(lambda loop: candidates._cell.check(loop, 0.02), loops),
            "  regressor and determinant": cpu(lambda tenth: criterion(*tenth), tenths),
        }
        for what, count in (("six joints, offset wrist", 6), ("seven joints", 7)):
            region = ViaRegions.from_box(6, [0.45, 0.1, 0.4], [0.2] * 3, [0.0, np.pi, 0.0], np.radians(30))
            scorer = Scorer(LoopProblem(arm(count), region, problem.settings.changed(linear_speed=0.4)))
            kept = np.array([genome for genome in genomes if scorer(genome[None])[0].feasible])
            rows[f"{what}, numerical inverse"] = cpu(scorer, [kept[:together], kept[-together:]]) / together
    print(json.dumps(rows))


def commands(trees: dict[str, Path], folder: Path) -> None:
    """Commands on a minute of log, process start included."""
    log, model = folder / "minute.mcap", folder / "model.json"
    write(log, 60.0)
    whole, short = [folder / f"whole{k}.mcap" for k in range(3)], [folder / f"stribeck{k}.mcap" for k in range(3)]
    for k in range(3):
        write(whole[k], 20.0, seed=k)
        write(short[k], 20.0, seed=k, stribeck=0.1)
    calls = {
        "estimate": ["estimate", "--robot", "comau_ns16", "-o", str(model), str(log)],
        "validate": ["validate", "--model", str(model), str(log)],
        "check": ["check", str(RECIPE)],
        "diagnose, 3 logs of 20 s, no gap": ["diagnose", "--robot", "comau_ns16", *map(str, whole)],
        "diagnose, 3 logs of 20 s, a gap of one joint": ["diagnose", "--model", str(model), *map(str, short)],
        "--help": ["--help"],
    }
    seconds: dict[str, dict[str, float]] = {tree: {} for tree in trees}
    memory: dict[str, dict[str, float]] = {tree: {} for tree in trees}
    for _ in range(2):
        for tree, root in trees.items():
            for name, call in calls.items():
                spent, peak = measured(root, call)
                seconds[tree][name] = min(seconds[tree].get(name, np.inf), spent)
                memory[tree][name] = peak
    table("a minute of log, six joints, process start included [s of CPU]", trees, seconds)
    table("the same, peak memory [MiB]", trees, memory)


def job(trees: dict[str, Path], folder: Path, full: bool) -> None:
    """The quickstart against the emulated controller, two processes: as it is, or with a tenth of its work."""
    text = RECIPE.read_text(encoding="utf-8")
    if not full:
        text = text.replace("population: 50, generations: 40", "population: 20, generations: 10")
        text = text.replace("motions: 30", "motions: 3")
    values: dict[str, dict[str, float]] = {tree: {} for tree in trees}
    for tree, root in trees.items():
        command = [sys.executable, "-m", "fake_controller", "--robot", "comau_ns16", "--port", "0", "--seed", "7"]
        options: dict[str, Any] = {"env": environment(root), "cwd": folder, "stdout": subprocess.PIPE, "text": True}
        controller = subprocess.Popen([*command, "--clock", "fast"], **options)
        try:
            address = controller.stdout.readline().split(" at ")[1].split(", clock")[0]
            recipe = folder / "quickstart.yaml"
            recipe.write_text(text.replace("127.0.0.1:9100", address), encoding="utf-8")
            begin = time.monotonic()
            agent = subprocess.Popen(
                [sys.executable, "-m", "agent", "calibrate", str(recipe), "--yes", "-q"], **options
            )
            _, status, used = os.wait4(agent.pid, 0)
            spent = time.monotonic() - begin
        finally:
            controller.terminate()
            _, _, beside = os.wait4(controller.pid, 0)
        if status:
            raise SystemExit("agent calibrate failed")
        values[tree] = {
            "from start to end": spent,
            "CPU of the agent": used.ru_utime + used.ru_stime,
            "CPU of the emulated controller": beside.ru_utime + beside.ru_stime,
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


def table(title: str, trees: dict[str, Path], values: dict[str, dict[str, float]]) -> None:
    """One row a figure, one column a tree, and the ratio of before to here."""
    print(f"\n{title:60}" + "".join(f"{tree:>10}" for tree in trees) + ("     ratio" if len(trees) > 1 else ""))
    for row in values["here"]:
        cells = [values[tree].get(row, np.nan) for tree in trees]
        ratio = f"{cells[1] / cells[0]:10.2f}" if len(cells) > 1 else ""
        print(f"{row:60}" + "".join(f"{cell:10.2f}" for cell in cells) + ratio, flush=True)


def arm(count: int) -> Any:
    """An arm of 1 to 7 joints without a spherical wrist."""
    from agent.robot import Joint, RobotDescription

    places = (SIX if count <= 6 else SEVEN)[:count]
    xml = ['<robot name="arm"><link name="l0"/>']
    for k, (x, y, z, roll) in enumerate(places, start=1):
        xml.append(
            f'<joint name="joint_{k}" type="revolute"><parent link="l{k - 1}"/><child link="l{k}"/>'
            f'<origin xyz="{x} {y} {z}" rpy="{roll} 0 0"/><axis xyz="0 0 1"/>'
            f'<limit lower="-3.1" upper="3.1" velocity="2.5" effort="500"/></joint><link name="l{k}"><inertial>'
            f'<origin xyz="0.02 0.01 {0.2 / k}"/><mass value="{9 / k}"/>'
            f'<inertia ixx="{0.1 / k}" ixy="0" ixz="0" iyy="{0.1 / k}" iyz="0" izz="{0.05 / k}"/></inertial></link>'
        )
    xml.append(f'<joint name="m" type="fixed"><parent link="l{count}"/><child link="tip"/>')
    xml.append('<origin xyz="0 0 0.1"/></joint><link name="tip"/></robot>')
    joints = tuple(
        Joint(f"joint_{k}", False, 100.0, 1.0, 2.5, 6.0, None, 1e-4, None, None, -3.1, 3.1) for k in range(1, count + 1)
    )
    eye = tuple(tuple(float(row == column) for column in range(count)) for row in range(count))
    return RobotDescription(f"arm_of_{count}", "".join(xml), "tip", (0.0, 0.0, -9.80665), None, joints, eye)


def write(path: Path, seconds: float, seed: int = 0, stribeck: float = 0.0) -> None:
    """A log of a rigid arm with friction and noise; Stribeck friction on joint 2 is a part of its nominal torque.

    Of more than a minute the motion repeats, the noise does not.
    """
    from agent.recording import Log, write_log
    from agent.robot import load_robot
    from agent.robot.dynamics import Dynamics

    robot = load_robot("comau_ns16")
    minute = min(seconds, 60.0)
    t = np.arange(round(minute * RATE)) / RATE
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * np.arange(1, 41) / minute  # periodic, so that minutes join
    sizes = rng.normal(size=(len(omega), robot.dof)) / omega[:, None]
    sizes *= 0.6 * robot.max_velocity / np.abs(sizes * omega[:, None]).sum(axis=0)
    angle = omega[:, None] * t[:, None, None] + rng.uniform(0, 2 * np.pi, sizes.shape)
    q = np.sum(sizes * np.sin(angle), axis=1) + np.resize([0.0, 0.5, -1.2, 0.0, 0.8, 0.0], robot.dof)
    qd = np.sum(sizes * omega[:, None] * np.cos(angle), axis=1)
    qdd = np.sum(-sizes * (omega**2)[:, None] * np.sin(angle), axis=1)
    torque = Dynamics(robot).inverse_dynamics(q, qd, qdd) + robot.nominal_torque * (
        0.1 * np.tanh(qd / 0.01) + 0.05 * qd
    )
    if stribeck:
        speed = qd[:, 1] / (0.05 * robot.max_velocity[1])
        torque[:, 1] += stribeck * robot.nominal_torque[1] * np.tanh(10.0 * speed) * np.exp(-(speed**2))
    count = round(seconds / minute)
    torque = np.tile(torque, (count, 1))
    torque += 0.005 * robot.nominal_torque * rng.standard_normal(torque.shape)
    samples = len(torque)
    log = Log(
        path=path,
        joint_names=robot.joint_names,
        t=np.arange(samples) / RATE,
        position=np.tile(q, (count, 1)),
        velocity=np.tile(qd, (count, 1)),
        effort=torque,
        reference_position=np.tile(q, (count, 1)),
        planned_position=None,
        sample_rate=RATE,
        stamp=0.0,
        segments=((0, samples),),
        cycle_starts=tuple(minute * k for k in range(count)) if count > 1 else (),
        metadata={"robot": robot.name, "motion": "cost"},
    )
    write_log(path, log)


if __name__ == "__main__":
    sys.path.insert(0, os.environ.get("PYTHONPATH", str(ROOT)).split(os.pathsep)[0])
    main()
