"""Torques that no drive and no arm of this size has: they look like N·mm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.recording import Log
from agent.robot import Dynamics, RobotDescription

_TOO_STRONG = 100.0  # times what the description says of the drive
_HEAVIEST = 1000.0  # kg for each square metre of reach: of 13 arms, real and simulated, the heaviest has 510


def too_strong(robot: RobotDescription, turning: np.ndarray, moving: np.ndarray, strong: np.ndarray) -> str | None:
    """Torques `strong` (n,) [N·m] a hundred times what the drives of turning joints that move can do."""
    drives = np.array([np.nan if joint.max_torque is None else joint.max_torque for joint in robot.joints])
    drives = np.where(drives > 0, drives, robot.nominal_torque)
    here = turning & moving & (strong > 0)
    times = (strong / np.where(drives > 0, drives, np.nan))[here]
    times = times[np.isfinite(times)]
    if len(times) and np.median(times) > _TOO_STRONG:
        return f"torques look like N·mm: they are {np.median(times):.3g} times what the drives can do"
    return None


def too_heavy(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    """Torque for more weight than an arm of this reach has; the last doubt, as a force for a torque looks alike.

    An arm is as long as its joints are apart, wherever its tip is: that of a surgical arm is near where its axes meet.
    """
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    efforts = [log.effort[:, turning] for log in logs if log.effort is not None]
    torque = max(float(np.quantile(np.abs(effort), 0.99, axis=0).max(initial=0)) for effort in efforts)
    q = np.random.default_rng(0).uniform(-2, 2, (50, robot.dof)) * turning
    dynamics = Dynamics(robot)
    apart = np.linalg.norm(dynamics.chain[1][1:], axis=1).sum()
    reach = max(float(np.linalg.norm(dynamics.tip_pose(q)[:, :3, 3], axis=1).max()), float(apart))
    mass = 2 * torque / (9.81 * reach) if reach > 0 else 0.0
    if mass > _HEAVIEST * reach**2:
        yield (
            f"torques look like N·mm: to need {torque:.3g} N·m at a reach of {reach:.2g} m an arm would weigh "
            f"{mass:.2g} kg, more than any of its reach ({_HEAVIEST * reach**2:.2g} kg)"
        )
