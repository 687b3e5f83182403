"""Positions against the ranges and speeds that the description gives: degrees, mm, slides that are turning joints."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.recording import Log
from agent.robot import RobotDescription

_TOO_FAR = {"degrees": 5.0, "mm": 100.0}  # times the joint's range: a tenth of what the unit makes of it, at most
_TOO_FAST = {"degrees": 10.0, "mm": 100.0}  # times its highest speed
_BEYOND = 0.2  # of its range, by which a slide comes out of it that is none
_WITHIN = 0.02  # likewise, where it is still taken to be inside


def slide_doubts(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    """A slide or a turning joint far out of its range, where swapped with the one other joint of the other kind that
    brings both into theirs."""
    low, high = (
        pick(np.array([pick(log.position, axis=0) for log in logs]), axis=0) if logs else np.zeros(robot.dof)
        for pick in (np.min, np.max)
    )
    beyond = _beyond(robot, low, high)
    slides = [k for k, joint in enumerate(robot.joints) if joint.prismatic]
    turning = [k for k, joint in enumerate(robot.joints) if not joint.prismatic]
    for slide in slides:
        others = [k for k in turning if swap_in_range(robot, low, high, slide, k)]
        if len(others) != 1 or max(beyond[slide], beyond[others[0]]) < _BEYOND:
            continue
        a, b = sorted((slide, others[0]))
        far = slide if beyond[slide] >= beyond[others[0]] else others[0]
        joint = robot.joints[far]
        yield (
            f"{robot.joint_names[a]} and {robot.joint_names[b]} look swapped: {joint.name} goes from {low[far]:.3g} to "
            f"{high[far]:.3g}, and its range is {joint.lower:.3g} to {joint.upper:.3g}; each is within the other's"
        )


def swap_in_range(robot: RobotDescription, low: np.ndarray, high: np.ndarray, a: int, b: int) -> bool:
    """Whether what joints a and b did, between `low` and `high` (n,), is within the other's range."""
    order = np.arange(robot.dof)
    order[[a, b]] = b, a
    return bool(np.all(_beyond(robot, low[order], high[order])[[a, b]] <= _WITHIN))


def _beyond(robot: RobotDescription, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(n,) how far positions come out of a joint's range, as part of it; zero on a joint without limits."""
    lower, upper = robot.position_limits
    width = np.where(np.isfinite(upper - lower), upper - lower, np.inf)
    return np.asarray(np.maximum(np.maximum(lower - low, high - upper), 0.0) / width)


def unit_doubt(robot: RobotDescription, logs: Sequence[Log], moving: np.ndarray, unit: str, looks: str) -> str | None:
    """Whether the joints that are `moving` (n,) bool, all slides or none, go or run so far beyond the description that
    what is taken for their `unit` looks like another."""
    if not moving.any():
        return None
    furthest = np.max([np.abs(log.position).max(axis=0) for log in logs], axis=0)
    ranges = np.array(
        [np.nan if j.lower is None or j.upper is None else max(abs(j.lower), abs(j.upper)) for j in robot.joints]
    )
    ranges = np.where(ranges > 0, ranges, np.nan)
    speeds = []
    for log in logs:
        every = max(1, int(0.05 * log.sample_rate))
        step, time = np.abs(np.diff(log.position[::every], axis=0)), np.diff(log.t[::every])
        if len(time):
            speeds.append(np.quantile(step / time[:, None], 0.98, axis=0))
    far = (furthest / ranges)[moving]
    fast = (np.max(speeds, axis=0) / robot.max_velocity)[moving] if speeds else np.zeros(1)
    known = far[np.isfinite(far)]
    if (len(known) and np.median(known) > _TOO_FAR[looks]) or np.median(fast) > _TOO_FAST[looks]:
        k = int(np.flatnonzero(moving)[np.argmax(fast)])
        return (
            f"positions look like {looks}: {robot.joint_names[k]} comes to {furthest[k]:.4g} {unit} and moves at "
            f"{np.max(fast):.3g} times its highest speed"
        )
    return None
