"""What no motion and no body can be: said, with the likeliest reason, before a model is made of it.

Signals are looked at first: dead channels, units, signs. Then a plain rigid arm with Coulomb and viscous friction and
offsets, free in all its parameters, is fitted to a few hundred samples, and again to what the log would be had one
thing in it been mistaken: gravity, a unit, a sign, two joints. On healthy logs of three real arms and one simulated no
mistake left less than 0.89 of what is unexplained; a real one left at most 0.29.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from agent.core.errors import InputError
from agent.estimation.filtering import FilterSettings, motions, resolve_cutoff
from agent.recording.log import Log
from agent.robot import RobotDescription

_CUTOFF = 10.0  # Hz
_SAMPLES, _TRIED = 500, 125  # of all logs together, for a fit and for each of the mistakes tried
_UNEXPLAINED = 0.5  # of the torque of all joints, root mean square
_BETTER = 0.6  # of what was left unexplained, that a mistake must leave at most to be named
_EXACT = 0.01  # of the torque: a fit that leaves less is right, and what is left may be anything
_STEEL = 7850.0  # kg/m³
_TOO_STRONG = 100.0  # times what the description says of the drive
_TOO_FAR = 5.0  # times the joint's range
_TOO_FAST = 10.0  # times its highest speed
_RATES = (0.7, 1.4)  # velocity over derivative of position: between them filters and lag
_DRIVING = 0.15  # of a joint's torque, by which friction and inertia together must push the wrong way
_MOVING = 1e-2  # rad or m that a joint travels to count as moving


@dataclass(frozen=True, eq=False)
class _Samples:
    """S low-passed samples: q, qd, qdd, torque and the direction of motion, all (S, n)."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    torque: np.ndarray
    direction: np.ndarray


_Mistake = tuple[str, RobotDescription, _Samples]


@dataclass(frozen=True, eq=False)
class _Fit:
    """unexplained: part of the torque that is left, per joint (n,) and of all; pushing (n,): part of each joint's
    torque by which friction, and by which its own inertia, drives it on; positive ones are wrong."""

    joints: np.ndarray
    unexplained: float
    pushing: np.ndarray


def doubts(robot: RobotDescription, logs: Sequence[Log]) -> list[str]:
    """Why these logs cannot be of this robot, the likeliest reason first; empty where nothing speaks against them."""
    logs = [log for log in logs if log.effort is not None]
    found = list(_signals(robot, logs)) or list(_velocities(logs)) or list(_stuck(robot, logs))
    if found:
        return found
    samples = _samples(logs)
    return [] if samples is None else list(_mechanics(robot, samples))


def _signals(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    names = np.array(robot.joint_names)
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    low, high = (np.array([f(log.position, axis=0) for log in logs]) for f in (np.min, np.max))
    moving = high.max(axis=0) - low.min(axis=0) > _MOVING
    efforts = [log.effort for log in logs if log.effort is not None]
    weakest, strongest = (np.array([f(e, axis=0) for e in efforts]) for f in (np.min, np.max))
    strong = np.max([np.quantile(np.abs(e), 0.99, axis=0) for e in efforts], axis=0)
    dead = moving & (strongest.max(axis=0) == weakest.min(axis=0))
    if dead.any():
        yield f"the torque of {', '.join(names[dead])} never changes while it moves: its channel is dead"
    if degrees := _degrees(robot, logs, turning & moving):
        yield degrees
    if too_strong := _too_strong(robot, turning, moving, strong):
        yield too_strong
    live = moving & ~dead
    if live.any() and np.all(weakest.min(axis=0)[live] >= 0) and _swings(logs, efforts, live):
        yield (
            f"the torque of {', '.join(names[live])} is never negative, whichever way it moves: it is an amount "
            "without a sign, as some drives report their current"
        )


def _stuck(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    for k, name in enumerate(robot.joint_names):
        set_points = [log.reference_position for log in logs if log.reference_position is not None]
        still = all(np.ptp(log.position[:, k]) == 0 for log in logs)
        if still and any(np.ptp(_known(asked[:, k])) > _MOVING for asked in set_points):
            yield f"{name} is stuck, or its position is not recorded: it never changes while its set-points move"


def _known(values: np.ndarray) -> np.ndarray:
    return np.append(values[np.isfinite(values)], 0.0)[:-1] if np.isfinite(values).any() else np.zeros(1)


def _swings(logs: Sequence[Log], efforts: Sequence[np.ndarray], live: np.ndarray) -> bool:
    """Whether torque that carries a load one way only is no explanation: several joints move both ways, or it comes
    down to nothing."""
    if np.count_nonzero(live) > 1:
        return True
    joint = int(np.argmax(live))
    values = np.concatenate([effort[:, joint] for effort in efforts])
    return bool(np.quantile(values, 0.05) < 0.02 * np.quantile(values, 0.99))


def _degrees(robot: RobotDescription, logs: Sequence[Log], moving: np.ndarray) -> str | None:
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
    if (len(known) and np.median(known) > _TOO_FAR) or np.median(fast) > _TOO_FAST:
        k = int(np.flatnonzero(moving)[np.argmax(fast)])
        return (
            f"positions look like degrees: {robot.joint_names[k]} comes to {furthest[k]:.4g} rad and moves at "
            f"{np.max(fast):.3g} times its highest speed"
        )
    return None


def _too_strong(robot: RobotDescription, turning: np.ndarray, moving: np.ndarray, strong: np.ndarray) -> str | None:
    from agent.robot.dynamics import Dynamics

    drives = np.array([np.nan if joint.max_torque is None else joint.max_torque for joint in robot.joints])
    drives = np.where(drives > 0, drives, robot.nominal_torque)
    here = turning & moving & (strong > 0)
    times = (strong / np.where(drives > 0, drives, np.nan))[here]
    times = times[np.isfinite(times)]
    if len(times) and np.median(times) > _TOO_STRONG:
        return f"torques look like N·mm: they are {np.median(times):.3g} times what the drives can do"
    q = np.random.default_rng(0).uniform(-2, 2, (50, robot.dof)) * turning
    reach = float(np.linalg.norm(Dynamics(robot).tip_pose(q)[:, :3, 3], axis=1).max())
    if not here.any() or reach <= 0:
        return None
    mass = 2 * float(strong[here].max()) / (9.81 * reach)
    if mass > _STEEL * reach**3:
        return (
            f"torques look like N·mm: to need {strong[here].max():.3g} N·m at a reach of {reach:.2g} m "
            f"an arm would weigh {mass:.2g} kg, more than a block of steel of its size"
        )
    return None


def _velocities(logs: Sequence[Log]) -> Iterator[str]:
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
            elif 40 < ratio < 80:
                why = "is its unit deg/s?"
            yield (
                f"{log.name}: the velocity of {', '.join(wrong)} is {ratio:.3g} times the derivative of its position: "
                f"{why}"
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
    correlation = float(x @ y / np.sqrt((x @ x) * (y @ y)))
    return slope if abs(correlation) > 0.95 else None


def _samples(logs: Sequence[Log]) -> _Samples | None:
    """Samples of all logs that are long enough to be filtered; None where that leaves too few."""
    parts = []
    for log in logs:
        cutoff = min(_CUTOFF, resolve_cutoff(log, FilterSettings()))
        try:
            found = list(motions(log, FilterSettings(cutoff)))
        except InputError:
            continue
        for motion in found:
            assert motion.torque is not None
            still = 0.01 * np.maximum(np.abs(motion.qd).max(axis=0), 1e-9)
            signals = (motion.q, motion.qd, motion.qdd, motion.torque, np.tanh(motion.qd / still))
            parts.append(motion.low_pass(np.hstack(signals)))
            log.scratch.release()
    rows = np.concatenate(parts) if parts else np.empty((0, 5))
    rows = rows[:: max(1, len(rows) // _SAMPLES)]
    if len(rows) * rows.shape[1] // 5 < 100:
        return None
    return _Samples(*np.split(rows, 5, axis=1))


def _mechanics(robot: RobotDescription, samples: _Samples) -> Iterator[str]:
    plain = _fit(robot, samples)
    names = robot.joint_names
    pushed = np.flatnonzero(plain.pushing > _DRIVING)
    still = np.flatnonzero(np.ptp(samples.q, axis=0) < 1e-6)
    share = f"a rigid arm explains {100 * max(0.0, 1 - plain.unexplained):.0f} % of the torque, whatever its parameters"
    size = np.std(samples.torque, axis=0)
    for k in still:
        if plain.joints[k] > _UNEXPLAINED and size[k] > 0.1 * size.max():
            yield f"{names[k]} is stuck: its position never changes, and its torque is not that of a joint that stands"
            return
    fits = plain.joints.mean() < _EXACT and not len(pushed)
    likeliest = None if fits else _likeliest(robot, samples)
    if plain.unexplained > _UNEXPLAINED:
        likeliest = likeliest or "torque and motion do not belong together, and no mistake tried here explains them"
        yield f"{likeliest}: {share}"
    elif len(pushed):
        whose = ", ".join(names[k] for k in pushed)
        likeliest = likeliest or f"torque and motion of {whose} have opposite signs"
        push = 100 * plain.pushing.max()
        yield f"{likeliest}: friction and inertia would drive {whose} on, by {push:.0f} % of its torque"
    elif likeliest:
        yield f"{likeliest}: much more of the torque would be explained"


def _likeliest(robot: RobotDescription, samples: _Samples) -> str | None:
    """The mistake that explains clearly more than the log as it is; None where none does."""
    every = max(1, len(samples.q) // _TRIED)
    some = [values[::every] for values in (samples.q, samples.qd, samples.qdd, samples.torque, samples.direction)]
    as_it_is = _fit(robot, _Samples(*some)).joints
    tried = [(what, _fit(here, thin).joints) for what, here, thin in _thinned(_mistakes(robot, samples), every)]
    what, left = min(tried, key=lambda entry: entry[1].mean())
    return what if left.mean() < _BETTER * as_it_is.mean() else None


def _thinned(mistakes: Iterator[_Mistake], every: int) -> Iterator[_Mistake]:
    for what, robot, s in mistakes:
        yield what, robot, _Samples(*(values[::every] for values in (s.q, s.qd, s.qdd, s.torque, s.direction)))


def _other_gravity(robot: RobotDescription, samples: _Samples) -> Iterator[_Mistake]:
    size = float(np.linalg.norm(robot.gravity)) or 9.80665
    for direction in (*np.eye(3), *-np.eye(3)):
        x, y, z = (float(size * value) for value in direction)
        text = ", ".join(f"{value + 0.0:.4g}" for value in (x, y, z))
        yield f"gravity in the base frame looks like ({text})", replace(robot, gravity=(x, y, z)), samples


def _mistakes(robot: RobotDescription, s: _Samples) -> Iterator[_Mistake]:
    names, n = robot.joint_names, robot.dof
    yield from _other_gravity(robot, s)
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    scale = np.where(turning, np.pi / 180, 1.0)
    yield "positions look like degrees", robot, replace(s, q=s.q * scale, qd=s.qd * scale, qdd=s.qdd * scale)
    for k in range(n):
        sign = np.where(np.arange(n) == k, -1.0, 1.0)
        yield f"the torque of {names[k]} looks flipped", robot, replace(s, torque=s.torque * sign)
        turned = replace(s, q=s.q * sign, qd=s.qd * sign, qdd=s.qdd * sign, direction=s.direction * sign)
        yield f"the position of {names[k]} looks flipped", robot, turned
        yield f"position and torque of {names[k]} look flipped", robot, replace(turned, torque=s.torque * sign)
    for a, b in combinations(range(n), 2):
        order = np.arange(n)
        order[[a, b]] = b, a
        who = f"{names[a]} and {names[b]}"
        yield f"the torques of {who} look swapped", robot, replace(s, torque=s.torque[:, order])
        swapped = replace(s, q=s.q[:, order], qd=s.qd[:, order], qdd=s.qdd[:, order], direction=s.direction[:, order])
        yield f"the positions of {who} look swapped", robot, swapped
        yield f"{who} look swapped", robot, replace(swapped, torque=s.torque[:, order])


def _fit(robot: RobotDescription, s: _Samples) -> _Fit:
    """Rigid links, rotors, Coulomb, viscous and offset, by least squares with every joint weighted alike."""
    from agent.robot.drivetrain import rotor_regressor
    from agent.robot.dynamics import Dynamics

    count, n = s.q.shape
    dynamics = Dynamics(robot)

    def rigid(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        return np.concatenate([dynamics.regressor(q, qd, qdd), rotor_regressor(robot, qdd)], axis=2)

    own = np.eye(n)[None]
    coupling = robot.coupling.T[None]
    axle = s.qd @ robot.coupling.T, s.direction
    friction = [coupling * column[:, None, :] for column in (axle[1], axle[0])]
    columns = np.concatenate([rigid(s.q, s.qd, s.qdd), *friction, np.broadcast_to(own, (count, n, n))], axis=2)
    scale = np.sqrt(np.mean(s.torque**2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    a = (columns / scale[None, :, None]).reshape(count * n, -1)
    length = np.linalg.norm(a, axis=0)
    length[length == 0] = 1.0
    solution = np.linalg.lstsq(a / length, (s.torque / scale).ravel(), rcond=1e-7)[0] / length
    error = s.torque - columns @ solution
    bodies = columns.shape[2] - 3 * n
    braking = np.concatenate([np.zeros(bodies), solution[bodies : bodies + 2 * n], np.zeros(n)])
    rub = columns @ braking
    power = np.mean(rub * s.qd, axis=0) / np.maximum(np.sqrt(np.mean(s.qd**2, axis=0)), 1e-12)
    push = np.empty(n)
    some = s.q[:: max(1, count // 10)]
    at_rest = rigid(some, 0 * some, 0 * some)
    for k in range(n):
        unit = np.tile(np.eye(n)[k], (len(some), 1))
        inertia = (rigid(some, 0 * some, unit) - at_rest)[:, k] @ solution[:bodies]
        own_torque = np.mean(inertia) * np.sqrt(np.mean(s.qdd[:, k] ** 2))
        push[k] = -(power[k] + own_torque)
    total = np.linalg.norm(s.torque)
    joints = np.linalg.norm(error, axis=0) / (scale * np.sqrt(count))
    return _Fit(joints, float(np.linalg.norm(error) / total) if total > 0 else 0.0, push / scale)
