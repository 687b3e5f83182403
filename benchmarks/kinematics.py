"""CPU time of kinematics and base parameters.

    python benchmarks/kinematics.py [ROBOT]

One thread; the smallest mean of five rounds.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from agent.robot import kinematics_for, load_robot
from agent.robot.base_parameters import base_parameters

SAMPLES = 5000


def cpu_time(call: Callable[[], object]) -> float:
    """Smallest mean CPU time [s] of a call over five rounds of a quarter second."""
    call()
    best = np.inf
    for _ in range(5):
        calls, start = 0, time.process_time()
        while (spent := time.process_time() - start) < 0.25:
            call()
            calls += 1
        best = min(best, spent / calls)
    return best


def main() -> None:
    """Print one line per operation."""
    robot = load_robot(sys.argv[1] if len(sys.argv) > 1 else "comau_ns16")
    kinematics = kinematics_for(robot)
    t = np.linspace(0.0, 1.0, SAMPLES)[:, None]
    middle = kinematics.middle + 0.4
    q = middle + 0.15 * np.sin(2 * np.pi * t * np.arange(1, robot.dof + 1))
    poses = kinematics.forward(q)
    twist = np.ones((SAMPLES, 6))
    operations: dict[str, Callable[[], object]] = {
        "forward": lambda: kinematics.forward(q),
        "jacobian": lambda: kinematics.jacobian(q),
        "joint_rates": lambda: kinematics.joint_rates(q, twist),
        "singularity": lambda: kinematics.singularity(q),
        "follow": lambda: kinematics.follow(poses, q[0]),
        "inverse (100 poses)": lambda: kinematics.inverse(poses[:: SAMPLES // 100]),
        "solve (one pose)": lambda: kinematics.solve(poses[0], q[0]),
        "base_parameters": lambda: base_parameters(robot),
    }
    print(f"{robot.name}, {type(kinematics).__name__}, {SAMPLES} samples where not said otherwise, CPU time")
    for name, call in operations.items():
        print(f"{name:22s}{cpu_time(call) * 1e3:10.3f} ms")


if __name__ == "__main__":
    main()
