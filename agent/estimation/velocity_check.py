"""Whether the velocity of a log belongs to its position."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.recording import Log
from agent.robot import RobotDescription

_RATES = (0.7, 1.4)  # velocity over derivative of position: between them filters and lag
_DEGREE = 180 / np.pi
_MOVING = 1e-2  # rad or m that a joint travels to count as moving


def velocity_doubts(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    """Which joints' velocity is not the derivative of their position, and the likeliest reason."""
    slides = {joint.name for joint in robot.joints if joint.prismatic}
    for log in logs:
        if log.velocity is None:
            continue
        wrong = {}
        for k, name in enumerate(log.joint_names):
            ratio = _velocity_ratio(log, k)
            if ratio is not None and not _RATES[0] <= ratio <= _RATES[1]:
                wrong[name] = ratio
        if wrong:
            ratio = float(np.median(list(wrong.values())))
            why = "the stamps, or the rate it was made with, are wrong"
            if ratio < 0:
                why = "one of the two is flipped"
            elif slides.isdisjoint(wrong) and _DEGREE / 1.4 < ratio < 1.4 * _DEGREE:
                why = "is its unit deg/s?"
            elif slides.isdisjoint(wrong) and _DEGREE / 1.4 < 1 / ratio < 1.4 * _DEGREE:
                why = "is the position in degrees?"
            elif slides.issuperset(wrong) and 700 < ratio < 1400:
                why = "is its unit mm/s?"
            elif slides.issuperset(wrong) and 700 < 1 / ratio < 1400:
                why = "is the position in mm?"
            where = f"{log.name}: " if len(logs) > 1 else ""
            yield (
                f"{where}the velocity of {', '.join(wrong)} is {ratio:.3g} times the derivative of its position: {why}"
            )
            return


def _velocity_ratio(log: Log, joint: int) -> float | None:
    """Displacement by velocity over displacement by position, over tenths of a second; None where they disagree in
    shape or nothing moves."""
    assert log.velocity is not None
    travelled, by_velocity = [], []
    window = max(2, int(0.1 * log.sample_rate))
    for first, stop in log.segments:
        t, q, qd = (values[first:stop] for values in (log.t, log.position[:, joint], log.velocity[:, joint]))
        path = np.append(0.0, np.cumsum(0.5 * (qd[1:] + qd[:-1]) * np.diff(t)))
        travelled.append(q[window::window] - q[:-window:window][: len(q[window::window])])
        by_velocity.append(path[window::window] - path[:-window:window][: len(path[window::window])])
    x, y = np.concatenate(travelled), np.concatenate(by_velocity)
    if len(x) < 10 or np.abs(x).sum() < 10 * _MOVING or not y.any():
        return None
    slope = float(x @ y / (x @ x))
    y /= np.abs(y).max()  # what is next to nothing has a square of nothing
    correlation = float(x @ y / np.sqrt((x @ x) * (y @ y)))
    return slope if abs(correlation) > 0.95 else None
