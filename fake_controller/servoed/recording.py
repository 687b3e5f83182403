"""The plant of an arm under position servos, and the frames that a teleoperation loop records of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fake_controller.actuation.drive import Drive
from fake_controller.actuation.machine import Machine
from fake_controller.servoed.arms import DrawnArm

_RATE, _RATE_WITH_GEARS = 2000.0, 4000.0  # Hz of the steps
_SETTLING = 1.5  # s at the first set-point before a recording begins


@dataclass(frozen=True)
class Recorder:
    """Loop of `rate` [Hz]: a frame is read and its command sent at once, `jitter` [s] off the stamp.

    A command further than `nearest` [rad] from the position is cut to that, and `late` [s], of all joints or (n,), is
    added on the way. What is stored is the command as it was wanted.
    """

    rate: float
    jitter: float
    nearest: float
    late: float | np.ndarray


@dataclass(frozen=True)
class ServoFault:
    """What a servo does that no number of a file says; nothing by default.

    `integral` [1/s]: it integrates its error, `of` its joint alone. `sag` [1/N·m]: kp falls with the torque of all.
    """

    of: int = 0
    integral: float = 0.0
    sag: float = 0.0


def record(
    arm: DrawnArm, machine: Machine, set_points: np.ndarray, recorder: Recorder, fault: ServoFault, seed: int
) -> np.ndarray:
    """(S, n) positions of the frames at which set-points (S, n) were sent, in encoder steps of the arm [rad]."""
    rng = np.random.default_rng([seed, 22])
    rate = _RATE_WITH_GEARS if machine.gears else _RATE
    dt, n, drive = 1.0 / rate, len(arm.kp), Drive(machine)
    jitter = rng.normal(0, recorder.jitter, len(set_points)).clip(-0.3 / recorder.rate, 0.3 / recorder.rate)
    frames = np.round((_SETTLING + np.arange(len(set_points)) / recorder.rate + jitter) * rate).astype(int)
    waits = np.round(np.broadcast_to(arm.late + recorder.late, n) * rate).astype(int).tolist()
    reading = dict(zip(frames.tolist(), range(len(frames)), strict=True))
    arriving = [dict[int, float]() for _ in range(n)]
    low, high = arm.start - arm.half, arm.start + arm.half
    dynamics = machine.dynamics()
    accelerate = dynamics.acceleration_function(np.where(drive.rigid, machine.reflected_rotors, 0.0))
    q, v, a = set_points[0].copy(), np.zeros(n), np.zeros(n)
    gravity = dynamics.inverse_dynamics(q[None], v[None], v[None])[0]
    torque, q = gravity.tolist(), q - gravity / arm.kp
    drive.reset(q.tolist(), torque)
    command, whole, offset = set_points[0].tolist(), [0.0] * n, arm.offset.tolist()
    smoothing, loads = dt / (dt + arm.lag), list(machine.joint_loads.items())
    gains = list(zip(arm.kp.tolist(), arm.kv.tolist(), arm.limit.tolist(), arm.top_speed.tolist(), strict=True))
    step, positions = arm.encoder, np.empty_like(set_points)
    for k in range(int(frames[-1]) + 1):
        predicted = v + 0.5 * dt * a
        link, speed = q.tolist(), predicted.tolist()
        encoder, turning = (link, speed) if arm.on_link else drive.motors(link, speed)
        counted = [step * round(angle / step) for angle in encoder]
        if (frame := reading.get(k)) is not None:
            positions[frame] = counted
            sent = np.clip(set_points[frame], positions[frame] - recorder.nearest, positions[frame] + recorder.nearest)
            for of_joint, wait, value in zip(arriving, waits, np.clip(sent, low, high).tolist(), strict=True):
                of_joint[k + wait] = value
        command = [of_joint.pop(k, before) for of_joint, before in zip(arriving, command, strict=True)]
        weaker = 1.0 / (1.0 + fault.sag * sum(map(abs, torque)))
        for j, (kp, kv, limit, top) in enumerate(gains):
            error = command[j] + offset[j] - counted[j]
            if fault.integral and j == fault.of:
                whole[j] += fault.integral * error * dt
            wanted = weaker * kp * (error + whole[j]) - kv * turning[j]
            most = limit * max(1.0 - abs(turning[j]) / top, 0.0)  # a motor is weaker the faster it turns
            torque[j] += smoothing * (min(max(wanted, -most), most) - torque[j])
        pull = np.array(drive.step(k * dt, link, speed, torque, dt))
        for j, acting_loads in loads:
            for load in acting_loads:
                pull[j] += load.torque(link[j], speed[j], dt)
        a = accelerate(q, predicted, pull)
        v = v + dt * a
        q = q + dt * v
    return positions


def reaches(arm: DrawnArm, rate: float, seconds: float, fastest: float, rng: np.random.Generator) -> np.ndarray:
    """(S, n) set-points of a person who leads the arm: minimum-jerk reaches, pauses, tremor, at the leader's encoder.

    Flash, Hogan (J. Neuroscience, 1985). Now and then a joint is led beyond its range, which its servo does not follow.
    """
    count = round(seconds * rate)
    time, n = np.arange(count) / rate, len(arm.kp)
    path, at, begins = np.repeat(arm.start[None], count, axis=0), arm.start.copy(), 0.3
    while begins < seconds:
        goal = arm.start + rng.uniform(-0.6, 0.6, n) * arm.half * (rng.random(n) < 0.75)
        if rng.random() < 0.1:
            k = int(rng.integers(n))
            goal[k] = arm.start[k] + rng.choice([-1.02, 1.02]) * arm.half[k]
        duration = max(rng.uniform(0.7, 1.8), 1.9 * float(np.abs(goal - at).max()) / fastest)
        share = np.clip((time - begins) / duration, 0.0, 1.0)[:, None]
        path += (goal - at) * share**3 * (10 - 15 * share + 6 * share**2)
        at, begins = goal, begins + duration + rng.choice([0.0, rng.uniform(0.1, 0.8)])
    slow = np.cumsum(rng.normal(size=(count, n)), axis=0) / np.sqrt(rate)
    smooth = slow - np.stack([np.convolve(column, np.ones(9) / 9, mode="same") for column in slow.T], axis=1)
    tremor = 2e-3 * smooth / max(float(smooth.std()), 1e-9)
    return np.round((path + tremor) / (2 * np.pi / 4096)) * (2 * np.pi / 4096)


def change_over_limit(arm: DrawnArm, runs: Sequence[np.ndarray], others: Sequence[np.ndarray]) -> float:
    """Largest root mean square change of a joint's position by effects, as torque of its servo over its limit."""
    change = np.concatenate([run - other for run, other in zip(runs, others, strict=True)])
    return float(np.max(np.sqrt(np.mean(change**2, axis=0)) * arm.kp / arm.limit))
