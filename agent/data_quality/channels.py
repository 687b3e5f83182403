"""Checks of single channels: order, dead, stuck and unsigned signals, velocities, samples that are spoiled."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from agent.data_quality.faults import MOVING, QualityFinding, Recordings, travel
from agent.recording import Log
from agent.robot import RobotDescription

_NOTHING = 1e-12  # N·m or N by which no torque changes that is one
_MAX_LAG = 0.2  # rad or m that a joint that is asked to go does not stay behind, however weak its servo
_SLOW, _NOISE = 0.005, 0.1  # of a joint's highest speed, and of a velocity's square: below and above it none moves
_RATES = (0.7, 1.4)  # velocity over derivative of position: between them filters and lag
_COMMON = 0.88  # of all joints alike, or its inverse; 39 logs of four arms have 0.92 to 1.05
_DEGREE = 180 / np.pi
_TIMES, _LATE = 5.0, 0.010  # of the highest speed, and s: as the reader allows for stamps that are late
_JUMPS = 0.01  # of the samples; fewer are repaired by the reader
_ROUGH = 0.5  # of a step, by which it differs from the one before: a motion that is only too fast differs less
_SLOWEST_RATE = 2.0  # Hz; a cut-off follows from it that no motion of an arm stays below
_STILL, _POSTURES = 0.1, 0.5  # of the way to the next row by its velocity: it stands; part of the rows that do
_RUN = 4  # equal samples in a row, or jumps from posture to posture
_STEPS = 3  # of the resolution that a torque jumps by where it was held
_HELD = 0.02  # of the samples in such runs, from where on it is said
_ZERO = 0.1  # of a torque's root mean square, to which it returns after a dropout
_SPOILED = 0.002  # of the samples, at the largest torque or dropped out, from where on it is said
_LEVELS = 50  # of a torque, or it is in coarse steps, which stand at zero and at their largest anyway
_OFTEN = 3  # times as many samples at the largest torque, or at zero, as at any of the values next to it


def discontinuous_positions(of: Recordings) -> Iterator[QualityFinding]:
    """Positions that go to and fro by more than the arm can move: two motions in one topic, or rows out of order."""
    for log in of.logs:
        if len(_between_postures(log)):
            continue
        step, time = np.diff(log.position, axis=0), np.diff(log.t)[:, None]
        jumps = np.abs(step) > of.robot.max_velocity * (_TIMES * time + _LATE)
        back = jumps[1:] & (np.abs(np.diff(step, axis=0)) > _ROUGH * np.abs(step[1:]))
        places, whose = np.flatnonzero(back.any(axis=1)) + 2, of.named(np.flatnonzero(back.any(axis=0)))
        if len(places) <= _JUMPS * len(log.t):
            continue
        where = f"{log.name}: " if len(of.logs) > 1 else ""
        jumping = f"positions of {', '.join(whose)} jump to and fro {len(places)} times (first at"
        jumping += f" {log.t[places[0]]:.3f} s) by more than they can move"
        second = _second_motion(log, of.robot)
        if second is None:
            text = f"{where}{jumping}: rows are out of order, or their stamps belong to other rows"
            advice = "sort the rows by the controller's own time, or export the log again"
            yield QualityFinding(text, whose, len(places) / len(log.t), advice)
            continue
        at = "zero" if not log.position[second].any() else "another motion"
        yield QualityFinding(
            f"{where}two publishers write to one topic: {second.sum()} of {len(log.t)} samples "
            f"({100 * second.mean():.1f} %) are {at}, and {jumping}",
            whose,
            float(second.mean()),
            "find them (`ros2 topic info -v TOPIC`), stop or rename one, or give each arm its namespace; record again",
        )


def _second_motion(log: Log, robot: RobotDescription) -> np.ndarray | None:
    """(S,) samples of the rarer of two motions that alternate, each within what the arm can do; None where there are
    no such two."""
    rows = log.position / robot.max_velocity  # s at the highest speed
    last, at = [rows[0], None], [log.t[0], 0.0]
    track, lost = np.zeros(len(rows), int), 0
    for k in range(1, len(rows)):
        distance = [np.inf if p is None else np.max(np.abs(rows[k] - p)) for p in last]
        allowed = [_TIMES * (log.t[k] - since) + _LATE for since in at]
        nearest = int(distance[1] < distance[0])
        if distance[nearest] > allowed[nearest]:
            lost += last[1] is not None
            nearest = 1 if last[1] is None else nearest
        track[k], last[nearest], at[nearest] = nearest, rows[k], log.t[k]
    second = track == int(2 * track.sum() <= len(track))
    return second if lost <= _JUMPS * len(rows) and second.any() else None


def static_postures(of: Recordings) -> Iterator[QualityFinding]:
    """Rows that are postures at standstill, each recorded once or several times: no motion can be derived from them."""
    for log in of.logs:
        step = np.abs(np.diff(log.position, axis=0))
        apart, slow = step.max(axis=1) > MOVING, log.sample_rate < _SLOWEST_RATE
        if not len(jumps := _between_postures(log)) and log.velocity is not None and not slow:
            if any(_velocity_ratio(log, joint) is not None for joint in range(of.robot.dof)):
                continue  # a motion whose velocity is in another unit
            speed = np.maximum(np.abs(log.velocity[1:]), np.abs(log.velocity[:-1])) * np.diff(log.t)[:, None]
            apart &= np.all(speed < _STILL * step.max(axis=1, keepdims=True), axis=1)
        elif not len(jumps) and not slow:
            continue
        if len(jumps) or np.mean(apart) > _POSTURES:
            where, count = f"{log.name}: " if len(of.logs) > 1 else "", len(jumps) + 1 if len(jumps) else len(log.t)
            text = f"{where}these are {count} postures at standstill, {np.ptp(log.t) / (count - 1):.3g} s apart, and no"
            text += " motion: nothing says how the arm went from one to the next"
            advice = "record a motion through them at 50 Hz or more; the arm may stop at each"
            yield QualityFinding(text, of.robot.joint_names, 1.0, advice)


def _between_postures(log: Log) -> np.ndarray:
    """Rows after which a stationary arm has moved elsewhere and is stationary again; empty for a motion."""
    step = np.abs(np.diff(log.position, axis=0))
    far, way = step.max(axis=1) > MOVING, step.sum(axis=1)
    jumps = np.flatnonzero(far & ~np.append(False, far[:-1]) & ~np.append(far[1:], False))
    is_motion = len(jumps) < _RUN or (way.sum() - way[jumps].sum()) > _STILL * way[jumps].sum()
    return jumps[:0] if is_motion else jumps


def dead_channels(of: Recordings) -> Iterator[QualityFinding]:
    """Torque that never changes while its joint moves."""
    weakest, strongest = (f([f(e, axis=0) for e in of.efforts], axis=0) for f in (np.min, np.max))
    if dead := of.named(of.moving & (strongest - weakest <= _NOTHING)):
        text = f"the torque of {', '.join(dead)} never changes while it moves: its channel is dead"
        yield QualityFinding(text, dead, advice="check the topic, the map or the driver's configuration")


def unsigned_channels(of: Recordings) -> Iterator[QualityFinding]:
    """Torque that is an amount without a sign."""
    if unsigned := of.named(unsigned_torque(of.logs)):
        text = (
            f"the torque of {', '.join(unsigned)} is never negative, whichever way it moves: it is an amount "
            "without a sign, as some drives report their current"
        )
        yield QualityFinding(text, unsigned)


def unsigned_torque(logs: Sequence[Log]) -> np.ndarray:
    """(n,) joints whose torque is an amount without a sign; all of the logs have torque.

    Carrying a load one way is no explanation for a joint that moves both ways and whose torque comes near zero.
    """
    effort = np.concatenate([log.effort for log in logs if log.effort is not None])
    way = np.concatenate([np.diff(log.position, axis=0) for log in logs])
    forward, backward = np.maximum(way, 0).sum(axis=0), np.maximum(-way, 0).sum(axis=0)
    live = (travel(logs) > MOVING) & (np.ptp(effort, axis=0) > _NOTHING)
    unsigned = live & (effort.min(axis=0) >= 0)
    # one joint of several that carries its load one way may come near zero; one that turns back at it does not
    least, near_zero = (0.05, 0.1) if unsigned.sum() == live.sum() else (0.02, 0.02)
    reaches_zero = np.quantile(effort, least, axis=0) < near_zero * np.quantile(effort, 0.99, axis=0)
    return np.asarray(unsigned & (np.minimum(forward, backward) > 0.2 * (forward + backward)) & reaches_zero)


def stuck_joints(of: Recordings) -> Iterator[QualityFinding]:
    """Positions that never change while set-points or velocities say that the joint moves."""
    ranges = np.max([np.ptp(log.position, axis=0) for log in of.logs], axis=0)
    constant = ranges <= np.finfo(float).eps  # rad or m: no finer change of an angle of 1 rad can be written down
    for k in np.flatnonzero(constant).tolist():
        name = of.robot.joint_names[k]
        asked = (log.reference_position for log in of.logs)
        if any(values is not None and _ptp(values[:, k]) > _MAX_LAG for values in asked):
            while_ = "its set-points move"
        elif any(_moves(of.robot, log, k) and _ptp(_path(log, k)) > _MAX_LAG for log in of.logs):
            while_ = "its velocity says it moves"
        else:
            continue
        text = f"{name} is stuck, or its position is not recorded: it never changes while {while_}"
        yield QualityFinding(text, (name,))


def _moves(robot: RobotDescription, log: Log, joint: int) -> bool:
    """Whether a velocity is that of a motion: neither noise, which changes from sample to sample, nor a bias of it."""
    if log.velocity is None:
        return False
    speed = log.velocity[:, joint]
    slowest = _SLOW * robot.max_velocity[joint]
    return bool(np.mean(np.diff(speed) ** 2) < _NOISE * np.mean(speed**2) and np.abs(speed).max() > slowest)


def _path(log: Log, joint: int) -> np.ndarray:
    """(S,) [rad or m] travelled by the velocity since the first sample of each part without gaps."""
    assert log.velocity is not None
    parts = []
    for first, stop in log.segments:
        t, speed = log.t[first:stop], log.velocity[first:stop, joint]
        parts.append(np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))))
    return np.concatenate(parts)


def _ptp(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0


def velocity_mismatch(of: Recordings) -> Iterator[QualityFinding]:
    """Velocities that are not the derivative of their position, with the likeliest reason."""
    for log in of.logs:
        if log.velocity is None:
            continue
        ratios = {name: _velocity_ratio(log, k) for k, name in enumerate(log.joint_names)}
        known = {name: r for name, r in ratios.items() if r is not None}
        wrong = {name: r for name, r in known.items() if not _RATES[0] <= r <= _RATES[1]}
        if known and (max(known.values()) < _COMMON or min(known.values()) > 1 / _COMMON):
            wrong = known
        if wrong:
            ratio = float(np.median(list(wrong.values())))
            slides = {joint.name for joint in of.robot.joints if joint.prismatic}
            where = f"{log.name}: " if len(of.logs) > 1 else ""
            yield QualityFinding(
                f"{where}the velocity of {', '.join(wrong)} is {ratio:.3g} times the derivative of its position: "
                f"{_velocity_reason(ratio, slides.isdisjoint(wrong), slides.issuperset(wrong))}",
                tuple(wrong),
            )
            return


def _velocity_reason(ratio: float, turning: bool, slides: bool) -> str:
    inverse = 1 / ratio if ratio else np.inf
    if ratio < 0:
        return "one of the two is flipped"
    for kind, low, high, unit, name in (
        (turning, _DEGREE / 1.4, 1.4 * _DEGREE, "deg/s", "degrees"),
        (slides, 700.0, 1400.0, "mm/s", "mm"),
    ):
        if kind and low < ratio < high:
            return f"is its unit {unit}?"
        if kind and low < inverse < high:
            return f"is the position in {name}?"
    return "the stamps, or the rate it was made with, are wrong"


def _velocity_ratio(log: Log, joint: int) -> float | None:
    """Displacement by velocity over displacement by position, over tenths of a second; None where they disagree in
    shape or nothing moves."""
    window = max(2, int(0.1 * log.sample_rate))
    path = _path(log, joint)
    steps = [(np.diff(log.position[a:b:window, joint]), np.diff(path[a:b:window])) for a, b in log.segments]
    x, y = (np.concatenate(values) for values in zip(*steps, strict=True))
    if len(x) < 10 or np.abs(x).sum() < 10 * MOVING or not y.any():
        return None
    slope = float(x @ y / (x @ x))
    y /= np.abs(y).max()  # the square of a tiny value would be zero
    correlation = float(x @ y / np.sqrt((x @ x) * (y @ y)))
    return slope if abs(correlation) > 0.95 else None


def spoiled_samples(of: Recordings) -> Iterator[QualityFinding]:
    """Torque that drops to zero, holds its value or is clipped for part of the samples."""
    for log in of.logs:
        assert log.effort is not None
        spoiled: dict[tuple[str, str, str], list[int]] = {}
        for joint in range(of.robot.dof):
            for share, text, advice in _spoiled(log.effort[:, joint], log.position[:, joint]):
                spoiled.setdefault((f"{100 * share:.1f}", text, advice), []).append(joint)
        for (percent, text, advice), joints in spoiled.items():
            whose = of.named(np.array(joints))
            remark = f"{log.name}: the torque of {', '.join(whose)} {text.format(f'{percent} % of the samples')}"
            yield QualityFinding(remark, whose, float(percent) / 100, advice, refuses=False)


def _spoiled(torque: np.ndarray, position: np.ndarray) -> Iterator[tuple[float, str, str]]:
    """Share of the samples, what it is and what to do, of a torque (S,) and position (S,)."""
    levels, counts = np.unique(torque, return_counts=True)
    if len(levels) < 3 or len(torque) < 2 * _RUN:
        return
    fine = len(levels) > _LEVELS
    gaps = np.diff(levels)
    resolution = float(np.min(gaps[gaps > 1e-6 * (levels[-1] - levels[0])]))
    starts = np.flatnonzero(np.append(True, np.diff(torque) != 0))
    length = np.diff(np.append(starts, len(torque)))
    value, jump = torque[starts], np.abs(np.diff(torque[starts]))
    before, after = np.append(jump[:1], jump), np.append(jump, jump[-1:])
    smaller_step = np.minimum(before, after)
    ends = starts + length - 1
    size = float(np.sqrt(np.mean(torque**2)))
    sides = np.where(length >= _RUN, np.maximum(before, after), smaller_step)  # a friction step is no dropout
    dropped = (
        fine & (not _zero_is_a_level(levels, counts)) & (value == 0) & (sides > max(_STEPS * resolution, _ZERO * size))
    )
    largest, rows = np.unique(np.abs(torque), return_counts=True)
    clipped = fine and rows[-1] > _OFTEN * rows[-4:-1].max(initial=0)
    held = ~dropped & (length >= _RUN) & (smaller_step > _STEPS * resolution) & (position[starts] != position[ends])
    held &= ~(clipped & (np.abs(value) == largest[-1]))
    for samples, least, text, advice in (
        (
            length[dropped].sum(),
            _SPOILED,
            "is exactly zero for {} between values that are not: the recorder drops out, or another publisher writes "
            "zeros",
            "leave those rows out, or record again",
        ),
        (
            rows[-1] * clipped,
            _SPOILED,
            "stays at its largest value for {}: it looks clipped, and what happens there is not seen",
            "record slower motions, or raise the limit of the channel",
        ),
        (
            length[held].sum(),
            _HELD,
            "holds its value for {} while the joint moves: it is updated more slowly than it is recorded",
            "record at the rate at which the controller updates torque",
        ),
    ):
        if samples > least * len(torque):
            yield float(samples) / len(torque), text, advice


def _zero_is_a_level(levels: np.ndarray, counts: np.ndarray) -> bool:
    """Whether zero is no more frequent among the rising levels of a torque than the levels next to it."""
    zero = int(np.searchsorted(levels, 0.0))
    if zero == len(levels) or levels[zero] != 0:
        return False
    around = [int(counts[k]) for k in (zero - 1, zero + 1) if 0 <= k < len(levels)]
    return int(counts[zero]) <= _OFTEN * max(around, default=0)
