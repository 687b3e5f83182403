"""CPU time and peak memory from a log file to a model file.

    python benchmarks/estimation_cost.py [SECONDS...]

Logs of the emulated COMAU NS16 at 500 Hz, 60 s and 20 minutes unless given, are written to a temporary folder: one
minute of motion, repeated with noise of its own. Each fit runs in a process of its own, on one thread; its time is
process time from the start of reading to the end of writing, imports included and told apart; memory is the peak of
the whole process.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

RATE = 500.0
METHODS = ("weighted", "consistent", "auto")
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

FIT = """
import json, resource, sys, time
start = time.process_time()
from agent.core.console import Console
from agent.pipeline.identify import estimate_files
import agent.estimation, agent.recording, agent.robot.dynamics, scipy.fft, scipy.special, scipy.interpolate, clarabel
imported = time.process_time()
from pathlib import Path
estimate_files("comau_ns16", [Path(sys.argv[1])], Path(sys.argv[2]), None, sys.argv[3], Console(verbosity=-1))
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps([imported - start, time.process_time() - imported, peak]))
"""


def main() -> None:
    """Print the table."""
    lengths = [float(text) for text in sys.argv[1:]] or [60.0, 1200.0]
    print(f"{'log':>8} {'method':12} {'imports':>9} {'file to model':>14} {'peak memory':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for seconds in lengths:
            log = Path(folder) / f"{seconds:g}.mcap"
            write(log, seconds)
            for method in METHODS:
                imports, fit, peak = measure(log, Path(folder) / "model.json", method)
                print(f"{seconds:6g} s {method:12} {imports:7.2f} s {fit:12.2f} s {peak:8.0f} MiB", flush=True)


def measure(log: Path, model: Path, method: str) -> tuple[float, float, float]:
    """Imports [s], fit [s], and peak memory [MiB]."""
    # a process begins with the peak of the one that started it: here that of a shell
    run = subprocess.run(
        ["sh", "-c", '"$@"; exit $?', "sh", sys.executable, "-c", FIT, str(log), str(model), method],
        cwd=ROOT,
        env={**os.environ, **ONE_THREAD},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return tuple(json.loads(run.stdout.splitlines()[-1]))


def write(path: Path, seconds: float) -> None:
    """A log of the emulated arm."""
    from agent.recording import Log, write_log
    from agent.robot import load_robot
    from fake_controller.plant import Plant

    robot = load_robot("comau_ns16")
    minute = min(seconds, 60.0)
    t = np.arange(round(minute * RATE)) / RATE
    rng = np.random.default_rng(0)
    omega = 2 * np.pi * np.arange(1, 41) / minute  # periodic, so that minutes join
    sizes = rng.normal(size=(len(omega), robot.dof)) / omega[:, None]
    sizes *= 0.6 * robot.max_velocity / np.abs(sizes * omega[:, None]).sum(axis=0)
    phases = rng.uniform(0, 2 * np.pi, sizes.shape)
    angle = omega[:, None] * t[:, None, None] + phases
    q = np.sum(sizes * np.sin(angle), axis=1) + [0.0, 0.5, -1.2, 0.0, 0.8, 0.0]
    qd = np.sum(sizes * omega[:, None] * np.cos(angle), axis=1)
    plant = Plant(robot, seed=1)
    plant.rest(q[0])
    chunks = list(plant.run(q, qd))
    position, velocity, torque = (
        np.concatenate([getattr(chunk, name) for chunk in chunks]) for name in ("position", "velocity", "torque")
    )
    count = round(seconds / minute)
    torque = np.tile(torque, (count, 1))
    torque += 0.005 * robot.nominal_torque * rng.standard_normal(torque.shape)
    samples = len(torque)
    log = Log(
        path=path,
        joint_names=robot.joint_names,
        t=np.arange(samples) / RATE,
        position=np.tile(position, (count, 1)),
        velocity=np.tile(velocity, (count, 1)),
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
    main()
