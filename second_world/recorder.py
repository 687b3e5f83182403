"""What a recorder leaves of a motion: clean, or as real ones do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from agent.recording import Log, write_log
from second_world.arms import Arm
from second_world.motions import RATE

EVERY = 2  # of the servo's samples one is recorded: 500 Hz
_STAMP = 1.7e9  # s


def write_motion(
    path: Path,
    arm: Arm,
    motion: Mapping[str, np.ndarray],
    torque: np.ndarray,
    cycles: tuple[float, ...],
    seed: int,
    as_recorded: bool,
    began: float = 0.0,
) -> None:
    """Sample one motion that `began` [s] in the session, with noise.

    `as_recorded` rounds positions to 1e-4 rad, stamps rows late by 0.4 ms on the average (exponential, in the order of
    arrival) and loses 3 % of them.
    """
    rng = np.random.default_rng([seed, 8])
    position, velocity, effort = (values[::EVERY] for values in (motion["position"], motion["velocity"], torque))
    samples = len(position)
    effort = effort + 0.004 * arm.torque * rng.normal(size=effort.shape)
    velocity = velocity + 0.001 * arm.speed * rng.normal(size=velocity.shape)
    t = np.arange(samples) * EVERY / RATE
    if as_recorded:
        position = np.round(position, 4)
        late = t + rng.exponential(4e-4, samples)
        t = np.maximum.accumulate(late) + 1e-7 * np.arange(samples)
        kept = rng.random(samples) >= 0.03
        t, position, velocity, effort = t[kept], position[kept], velocity[kept], effort[kept]
    else:
        position = np.round(position / 2e-6) * 2e-6
    start = t[0]
    log = Log(
        path=path,
        joint_names=tuple(arm.joint_names),
        t=t - start,
        position=position,
        velocity=velocity,
        effort=effort,
        reference_position=None,
        planned_position=None,
        sample_rate=RATE / EVERY,
        stamp=_STAMP + began + start,
        segments=((0, len(t)),),
        cycle_starts=cycles,
        metadata={"robot": arm.build.name, "motion": path.stem},
    )
    write_log(path, log)
