"""Robust estimation: iteratively re-weighted least squares with Huber's weights.

A residual beyond 1.345 robust standard deviations counts linearly instead of quadratically (Huber, Annals of
Mathematical Statistics 35, 1964): knocks, dropped samples and contacts pull less. The scale of each joint, moving or at
standstill, is 1.4826 times the median absolute residual.
"""

from __future__ import annotations

import numpy as np

from agent.estimation.moments import collect, standstill
from agent.estimation.problem import Estimate, Problem

_TUNING = 1.345
_ROUNDS = 4


def huber(problem: Problem) -> Estimate:
    """Huber's M-estimate with a scale per joint."""
    observation = problem.observation
    still = standstill(observation)
    moments, weights = problem.moments, problem.weights()
    parameters = problem.solve(weights)
    share = 0.0
    for _ in range(_ROUNDS):
        rows = problem.residuals(parameters)
        scale = _scales(rows, still)
        trusted = [
            1 / np.maximum(1, np.abs(block) / (_TUNING * scale[stop.astype(int), np.arange(block.shape[1])]))
            for block, stop in zip(rows, still, strict=True)
        ]
        moments = collect(observation, problem.partition, problem.terms, problem.friction(), trusted)
        weights = 1 / scale**2
        parameters = problem.solver(moments.weighted(weights))
        share = float(np.mean(np.concatenate(trusted) < 1))
    note = f"Huber weights below 1 on {100 * share:.0f} % of the rows."
    return problem.estimate(weights, note, moments=moments)


def _scales(rows: list[np.ndarray], still: list[np.ndarray]) -> np.ndarray:
    """(2, n) robust standard deviations, moving and at standstill."""
    residual, stopped = np.concatenate(rows), np.concatenate(still)
    scale = np.empty((2, residual.shape[1]))
    for joint in range(residual.shape[1]):
        moving = residual[~stopped[:, joint], joint]
        standing = residual[stopped[:, joint], joint]
        moving, standing = (part if len(part) else residual[:, joint] for part in (moving, standing))
        scale[0, joint] = 1.4826 * np.median(np.abs(moving))
        scale[1, joint] = max(scale[0, joint], 1.4826 * np.median(np.abs(standing)))
    return np.maximum(scale, 1e-9 * np.sqrt(np.mean(residual**2)) + 1e-15)
