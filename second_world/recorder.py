"""What a recorder leaves of a motion: clean, or as real ones do."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from agent.recording import Log, write_log
from second_world.motions import RATE
from second_world.world import DrawnWorld

_LAG = 0.008  # s, of a velocity channel behind the motion
_ROUNDED = 1e-4  # rad
_LATE = 4e-4  # s on average
_LOST, _TWICE = 0.03, 0.005  # of the rows
_GAP = 0.3  # s


@dataclass(frozen=True)
class Take:
    """What is recorded: signals (3, S, n) at `RATE`, set-points (S, n) executed and planned, and when it began [s]."""

    name: str
    signals: np.ndarray
    executed: np.ndarray
    planned: np.ndarray
    cycles: tuple[float, ...]
    stamp: float


def write_take(path: Path, world: DrawnWorld, take: Take, seed: int) -> None:
    """One log, with noise, by the world's sensors and recorder."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 8]))
    arm, every = world.arm, round(RATE / world.rate)
    position, velocity, effort = (values[::every] for values in take.signals)
    t = np.arange(len(position)) / world.rate
    position = np.round(position / world.encoder) * world.encoder
    effort = effort + world.noise * arm.torque * rng.normal(size=effort.shape)
    effort = np.round(effort / world.servo_rows[:, 5]) * world.servo_rows[:, 5]
    speeds: np.ndarray | None = velocity + 5e-4 * arm.speed * rng.normal(size=velocity.shape)
    if world.velocity == "lagged":
        speeds = _behind(take.signals[1])[::every]
    elif world.velocity == "missing":
        speeds = None
    if "rounded" in world.faults:
        position = np.round(position / _ROUNDED) * _ROUNDED
    rows = np.arange(len(t))
    if "lossy" in world.faults:
        rows = rows[rng.random(len(rows)) >= _LOST]
    if "gap" in world.faults:
        begin = rng.uniform(0.2, 0.8) * t[-1]
        rows = rows[(t[rows] < begin) | (t[rows] > begin + _GAP)]
    if "late" in world.faults:
        t = np.maximum.accumulate(t + rng.exponential(_LATE, len(t))) + 1e-7 * np.arange(len(t))
    if "duplicated" in world.faults:
        rows = np.sort(np.concatenate([rows, rows[rng.random(len(rows)) < _TWICE]]))
    start = t[rows[0]]
    executed, planned = (points[::every][rows] for points in (take.executed, take.planned))
    log = Log(
        path=path,
        joint_names=tuple(arm.joint_names),
        t=t[rows] - start,
        position=position[rows],
        velocity=None if speeds is None else speeds[rows],
        effort=effort[rows],
        reference_position=executed if world.tracking else None,
        planned_position=planned if world.tracking else None,
        sample_rate=world.rate,
        stamp=take.stamp + start,
        segments=((0, len(rows)),),
        cycle_starts=take.cycles,
        metadata={"robot": arm.kind.name, "motion": take.name},
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_log(path, log)


def _behind(values: np.ndarray) -> np.ndarray:
    """A first-order lag of `_LAG`."""
    slow, now = np.empty_like(values), values[0]
    share = 1.0 / (RATE * _LAG)
    for k, value in enumerate(values):
        now = now + share * (value - now)
        slow[k] = now
    return slow
