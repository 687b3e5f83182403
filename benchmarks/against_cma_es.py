"""The same arm and position logs for a CMA-ES, as PACE runs it, and for the fit of a diagnosis.

    python benchmarks/against_cma_es.py arm.xml DATASET [GENERATIONS]

Both fit armature, damping and friction of every joint and one delay, from the numbers of the file, to all episodes but
the last, by free motion of the simulator under the recorded command; gains are the file's. The CMA-ES moves each number
from 0 to five times the file's (0 to 0.1 s of delay), with 48 motions a generation (PACE: 256 to 4096, on a GPU). The
error is that of the last episode.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from agent.diagnosis.position_logs.fitting import OutputErrorProblem, Parameters, fit_output_error, missed, usual_scale
from agent.diagnosis.position_logs.stretch import CommandedStretch, stretches_of
from agent.model import NominalModel
from agent.recording import read_recording
from agent.simulators import FreeSimulator, ServoNumbers, load_arm, load_simulator

POPULATION, LARGEST, LONGEST = 48, 5.0, 0.1  # motions; times the file's numbers; s
SETTLING = 0.5  # s


def cma_es(cost: Callable[[np.ndarray], float], size: int, generations: int, seed: int = 0) -> np.ndarray:
    """The best of points (size,) in [0, 1] (Hansen, The CMA Evolution Strategy: A Tutorial, 2016, figure 6)."""
    rng, n, count = np.random.default_rng(seed), size, POPULATION // 2
    weights = np.log(count + 0.5) - np.log(np.arange(1, count + 1))
    weights /= weights.sum()
    effective = 1 / np.sum(weights**2)
    for_sigma = (effective + 2) / (n + effective + 5)
    damping = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (n + 1)) - 1) + for_sigma
    for_path = (4 + effective / n) / (n + 4 + 2 * effective / n)
    rank_one = 2 / ((n + 1.3) ** 2 + effective)
    rank_many = min(1 - rank_one, 2 * (effective - 2 + 1 / effective) / ((n + 2) ** 2 + effective))
    usual = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    mean, sigma, matrix = np.full(n, 1 / LARGEST), 0.2, np.eye(n)
    path, step_path, best = np.zeros(n), np.zeros(n), (np.inf, mean)
    for generation in range(generations):
        values, axes = np.linalg.eigh(matrix)
        root = np.sqrt(np.maximum(values, 1e-20))
        drawn = rng.normal(size=(POPULATION, n)) * root @ axes.T
        points = np.clip(mean + sigma * drawn, 0.0, 1.0)
        costs = np.array([cost(point) for point in points])
        order = np.argsort(costs)[:count]
        best = min(best, (float(costs[order[0]]), points[order[0]]), key=lambda pair: pair[0])
        moved = (points[order] - mean) / sigma
        shift = weights @ moved
        mean = mean + sigma * shift
        whitened = axes @ ((axes.T @ shift) / root)
        step_path = (1 - for_sigma) * step_path + np.sqrt(for_sigma * (2 - for_sigma) * effective) * whitened
        length = float(np.linalg.norm(step_path))
        going = length / np.sqrt(1 - (1 - for_sigma) ** (2 * generation + 2)) < (1.4 + 2 / (n + 1)) * usual
        path = (1 - for_path) * path + going * np.sqrt(for_path * (2 - for_path) * effective) * shift
        matrix = (
            (1 - rank_one - rank_many) * matrix
            + rank_one * np.outer(path, path)
            + rank_many * (moved.T * weights) @ moved
        )
        sigma *= float(np.exp(for_sigma / damping * (length / usual - 1)))
    return best[1]


def error_of(free: FreeSimulator, numbers: ServoNumbers, stretches: list[CommandedStretch]) -> float:
    """Root mean square of the positions [rad]; large where the simulation blows up."""
    motions = [stretch.run(free, numbers) for stretch in stretches]
    lost = [np.full(1, np.pi) if m is None else missed(s, m).ravel() for s, m in zip(stretches, motions, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate(lost) ** 2)))


def main() -> None:
    """Command line."""
    path, dataset = map(Path, sys.argv[1:3])
    generations = int(sys.argv[3]) if len(sys.argv) > 3 else 150
    arm = load_arm(path)
    logs = read_recording(dataset, arm)[0]
    simulator = load_simulator(path, None, arm.joint_names)
    free, reference = FreeSimulator(simulator.arm), NominalModel(simulator.model)
    file = free.numbers
    stretches = list(stretches_of(logs, held=True, settling=SETTLING))
    fitted = [stretch for stretch in stretches if stretch.log_index < len(logs) - 1]
    held_out = [stretch for stretch in stretches if stretch.log_index == len(logs) - 1]

    def numbers(point: np.ndarray) -> ServoNumbers:
        armature, damping, friction = LARGEST * point[:-1].reshape(3, -1)
        own = file.armature * armature, file.damping * damping, np.maximum(file.friction, 1e-3 * file.kp) * friction
        late = np.full_like(file.kp, LONGEST * point[-1])
        return ServoNumbers(*own, file.kp, file.stiffness, late, file.offset)

    began = time.process_time()
    parameters = Parameters.create(usual_scale(reference, file, fitted).vector, fixed=("kp",))
    fit = fit_output_error(OutputErrorProblem(free, reference, tuple(fitted), parameters), file)
    ours, ours_s = fit.numbers, time.process_time() - began
    began = time.process_time()
    theirs = numbers(cma_es(lambda point: error_of(free, numbers(point), fitted), 3 * len(file.kp) + 1, generations))
    theirs_s = time.process_time() - began
    for name, at, seconds in (("file", file, 0.0), ("CMA-ES", theirs, theirs_s), ("ours", ours, ours_s)):
        told = (
            f"fitted {1e3 * error_of(free, at, fitted):7.3f} mrad, held out {1e3 * error_of(free, at, held_out):7.3f}"
        )
        print(f"{name:7}{told} mrad, delay {1e3 * at.delay[0]:5.1f} ms, {seconds:7.1f} CPU s")
    ratio = error_of(free, theirs, held_out) / error_of(free, ours, held_out)
    print(f"CMA-ES over ours: {ratio:.2f} times the held-out error in {theirs_s / ours_s:.1f} times the CPU time")


if __name__ == "__main__":
    main()
