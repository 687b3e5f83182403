"""Checks of positions and torques against the ranges, speeds, drives and reach that the description gives."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from agent.data_quality.finding import QualityFinding, Recordings
from agent.robot import Dynamics, RobotDescription

_TOO_FAR = {"degrees": 5.0, "mm": 100.0}  # times the joint's range: a tenth of what the unit makes of it, at most
_TOO_FAST = {"degrees": 10.0, "mm": 100.0}  # times its highest speed
_LEAST = {"degrees": np.pi, "mm": 0.0}  # rad or m that some joint comes to, at least
_TOO_STRONG = 100.0  # times what the description says of the drive
_HEAVIEST = 1000.0  # kg for each square metre of reach: of 13 arms, real and simulated, the heaviest has 510


def position_units(of: Recordings) -> Iterator[QualityFinding]:
    """Degrees or mm: joints that go or run so far beyond the description that the unit must be another."""
    joints = of.robot.joints
    ends = [np.nan if j.lower is None or j.upper is None else max(abs(j.lower), abs(j.upper)) for j in joints]
    ranges = np.where(np.array(ends) > 0, ends, np.nan)
    speeds = np.array([_speed(log.t, log.position, log.sample_rate) for log in of.logs]).max(axis=0)
    for which, unit, looks in ((of.turning, "rad", "degrees"), (~of.turning, "m", "mm")):
        there = which & of.moving
        if not there.any() or of.furthest[there].max() <= _LEAST[looks]:
            continue
        far, fast = (of.furthest / ranges)[there], (speeds / of.robot.max_velocity)[there]
        far = far[np.isfinite(far)]
        if (len(far) and np.median(far) > _TOO_FAR[looks]) or np.median(fast) > _TOO_FAST[looks]:
            k = int(np.flatnonzero(there)[np.argmax(fast)])
            yield QualityFinding(
                f"positions look like {looks}: {joints[k].name} comes to {of.furthest[k]:.4g} {unit} and moves at "
                f"{np.max(fast):.3g} times its highest speed",
                of.named(there),
            )
            return


def _speed(t: np.ndarray, position: np.ndarray, rate: float) -> np.ndarray:
    """(n,) 98 % quantile of the mean speed over 0.05 s; 0 in a log that is too short."""
    every = max(1, int(0.05 * rate))
    step, time = np.abs(np.diff(position[::every], axis=0)), np.diff(t[::every])
    return np.quantile(step / time[:, None], 0.98, axis=0) if len(time) else np.zeros(position.shape[1])


def drive_torque(robot: RobotDescription) -> np.ndarray:
    """(n,) what the description says that a drive can do [N·m or N]: its limit, else nominal; NaN where unknown."""
    drives = np.array([np.nan if joint.max_torque is None else joint.max_torque for joint in robot.joints])
    drives = np.where(drives > 0, drives, robot.nominal_torque)
    return np.where(drives > 0, drives, np.nan)


def excessive_torque(of: Recordings) -> Iterator[QualityFinding]:
    """Torque a hundred times what the drives of turning joints that move can do."""
    strong = np.max([np.quantile(np.abs(effort), 0.99, axis=0) for effort in of.efforts], axis=0)
    times = (strong / drive_torque(of.robot))[of.turning & of.moving & (strong > 0)]
    times = times[np.isfinite(times)]
    if len(times) and np.median(times) > _TOO_STRONG:
        text = f"torques look like N·mm: they are {np.median(times):.3g} times what the drives can do"
        yield QualityFinding(text, of.robot.joint_names, scale=True)


def excessive_weight(of: Recordings) -> Iterator[QualityFinding]:
    """Torque for more weight than an arm of this reach has; the last doubt, as a force for a torque looks alike.

    An arm is as long as its joints are apart, wherever its tip is: that of a surgical arm is near where its axes meet.
    """
    torque = max(float(np.quantile(np.abs(e[:, of.turning]), 0.99, axis=0).max(initial=0)) for e in of.efforts)
    q = np.random.default_rng(0).uniform(-2, 2, (50, of.robot.dof)) * of.turning
    dynamics = Dynamics(of.robot)
    apart = np.linalg.norm(dynamics.chain[1][1:], axis=1).sum()
    reach = max(float(np.linalg.norm(dynamics.tip_pose(q)[:, :3, 3], axis=1).max()), float(apart))
    mass = 2 * torque / (9.81 * reach) if reach > 0 else 0.0
    if mass > _HEAVIEST * reach**2:
        yield QualityFinding(
            f"torques look like N·mm: to need {torque:.3g} N·m at a reach of {reach:.2g} m an arm would weigh "
            f"{mass:.2g} kg, more than any of its reach ({_HEAVIEST * reach**2:.2g} kg)",
            of.named(of.turning),
            scale=True,
        )
