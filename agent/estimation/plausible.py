"""What no motion and no body can be: said, with the likeliest reason, before a model is made of it.

Signals are looked at first: dead channels, units, signs. Then a plain rigid arm with Coulomb and viscous friction and
offsets, free in all its parameters, is fitted to a few hundred samples, and again to what the log would be had one
thing in it been mistaken: gravity, a unit, a sign, two joints. What is held out decides (`rigid_fit`). On the healthy
logs that the limits were set on (three real arms, and simulated ones of two simulators) no mistake gained more than
0.7. Where torques cannot tell gravity's directions apart, the description's own masses may (`gravity_check`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from agent.core import InputError
from agent.estimation.filtering import FilterSettings, motions, resolve_cutoff
from agent.estimation.gravity_check import described_gravity_doubts, gravity_directions, gravity_text
from agent.estimation.range_check import slide_doubts, swap_in_range, unit_doubt
from agent.estimation.rigid_fit import FOLDS, Bodies, FitSamples, HeldOutFit, overfitted, solved
from agent.estimation.strength_check import too_heavy, too_strong
from agent.estimation.velocity_check import velocity_doubts
from agent.recording import Log
from agent.robot import RobotDescription

_CUTOFF = 10.0  # Hz
_SAMPLES = 600  # of all logs together
_UNEXPLAINED = 0.5  # of the torque of all joints, root mean square
_GAIN = 1.0  # of a mistake that is named, see rigid_fit
_SLIDE_GAIN = 4.0  # the same of a slide in the place of a turning joint: other columns, which may fit a bad log better
_CERTAIN = 2.5  # standard errors of that gain over the folds, and
_AS_GOOD = 0.5  # less gain than the best: as good, so the likelier one is named
_EXACT = 0.01  # of the torque: a fit that leaves less is right, and what is left may be anything
_DRIVING = 0.15  # of a joint's torque, by which friction and inertia together must push the wrong way
_SIGNIFICANT = 5.0  # standard deviations of that push, and
_SAMPLES_PER_PARAMETER = 4.0  # independent samples for each parameter: a short log tells no mistake from chance
_MAX_LAG = 0.2  # rad or m that a joint that is asked to go does not stay behind, however weak its servo
_MOVING = 1e-2  # rad or m that a joint travels to count as moving
_SLOW, _NOISE = 0.005, 0.1  # of a joint's highest speed, and of a velocity's square: below and above it none goes
_ONE_WAY = 0.02  # of the time in motion that a joint goes the other way: less tells no friction from an offset
_NOTHING = 1e-12  # N·m or N by which no torque changes that is one


_Regressor = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
#: What it is, the torque channel of every joint without it, its sign, and the joints (from 0) that it is about.
_Mistake = tuple[str, np.ndarray, np.ndarray, tuple[int, ...]]


@dataclass(frozen=True, eq=False)
class _Fit:
    """unexplained: part of the torque that is left, per joint (n,) and of all; gravity (S, n) torque along
    the samples; pushing (n,): part of each joint's
    torque by which friction, and by which its own inertia, drives it on, and how far that is known; positive ones are
    wrong. enough: whether the samples are many enough for their parameters to compare fits."""

    joints: np.ndarray
    unexplained: float
    gravity: np.ndarray
    pushing: np.ndarray
    deviation: np.ndarray
    enough: bool


def plausibility_warnings(robot: RobotDescription, logs: Sequence[Log], beside: Sequence[Log] = ()) -> list[str]:
    """Why these logs cannot be of this robot, the likeliest reason first; empty where nothing speaks against them.

    A mistake that only fits better than the log as it is has to do so with logs of the same recorder `beside` as well:
    few seconds of slow motion tell it badly from chance.
    """
    logs = [log for log in logs if log.effort is not None]
    if not logs:
        return []  # that there is no torque is said where it is needed
    found = list(_signals(robot, logs)) or list(velocity_doubts(robot, logs)) or list(_stuck(robot, logs))
    found = found or list(slide_doubts(robot, logs))
    samples = None if found else _samples(logs)
    more = [*logs, *(log for log in beside if log.effort is not None)] if beside else []
    found = found if samples is None else list(_mechanics(robot, samples, more))
    return found or list(too_heavy(robot, logs))


def _signals(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    names = np.array(robot.joint_names)
    turning = ~np.array([joint.prismatic for joint in robot.joints])
    low, high = (np.array([f(log.position, axis=0) for log in logs]) for f in (np.min, np.max))
    moving = high.max(axis=0) - low.min(axis=0) > _MOVING
    efforts = [log.effort for log in logs if log.effort is not None]
    weakest, strongest = (np.array([f(e, axis=0) for e in efforts]) for f in (np.min, np.max))
    strong = np.max([np.quantile(np.abs(e), 0.99, axis=0) for e in efforts], axis=0)
    dead = moving & (strongest.max(axis=0) - weakest.min(axis=0) <= _NOTHING)
    if dead.any():
        yield f"the torque of {', '.join(names[dead])} never changes while it moves: its channel is dead"
    for which, unit, looks in ((turning, "rad", "degrees"), (~turning, "m", "mm")):
        if doubt := unit_doubt(robot, logs, which & moving, unit, looks):
            yield doubt
    if doubt := too_strong(robot, turning, moving, strong):
        yield doubt
    unsigned = unsigned_torque(logs)
    if unsigned.any():
        yield (
            f"the torque of {', '.join(names[unsigned])} is never negative, whichever way it moves: it is an amount "
            "without a sign, as some drives report their current"
        )


def unsigned_torque(logs: Sequence[Log]) -> np.ndarray:
    """(n,) joints whose torque is an amount without a sign; all of the logs have torque."""
    low, high = (np.array([f(log.position, axis=0) for log in logs]) for f in (np.min, np.max))
    moving = high.max(axis=0) - low.min(axis=0) > _MOVING
    efforts = [log.effort for log in logs if log.effort is not None]
    weakest, strongest = (np.array([f(e, axis=0) for e in efforts]) for f in (np.min, np.max))
    live = moving & (strongest.max(axis=0) - weakest.min(axis=0) > _NOTHING)
    unsigned = live & (weakest.min(axis=0) >= 0)
    # one joint of several that carries its load one way may come near nothing; one that turns back at it does not
    least, near = (0.05, 0.1) if unsigned.sum() == live.sum() else (0.02, 0.02)
    return np.asarray(
        unsigned & [_comes_to_nothing(logs, efforts, k, least, near) for k in range(len(unsigned))], dtype=bool
    )


def _stuck(robot: RobotDescription, logs: Sequence[Log]) -> Iterator[str]:
    for k, name in enumerate(robot.joint_names):
        set_points = [log.reference_position for log in logs if log.reference_position is not None]
        if any(np.ptp(log.position[:, k]) > 0 for log in logs):
            continue
        if any(_travel(asked[:, k]) > _MAX_LAG for asked in set_points):
            yield f"{name} is stuck, or its position is not recorded: it never changes while its set-points move"
        elif any(_goes(robot, log, k) and _travel(_path(log, k)) > _MAX_LAG for log in logs):
            yield f"{name} is stuck, or its position is not recorded: it never changes while its velocity says it moves"


def _goes(robot: RobotDescription, log: Log, joint: int) -> bool:
    """Whether a velocity is that of a motion: neither noise, which changes from sample to sample, nor a bias of it."""
    if log.velocity is None:
        return False
    speed = log.velocity[:, joint]
    slowest = _SLOW * robot.max_velocity[joint]
    return bool(np.mean(np.diff(speed) ** 2) < _NOISE * np.mean(speed**2) and np.abs(speed).max() > slowest)


def _path(log: Log, joint: int) -> np.ndarray:
    """(S,) [rad] that a joint has gone by its velocity since the first sample of each part without gaps."""
    assert log.velocity is not None
    parts = []
    for first, stop in log.segments:
        t, speed = log.t[first:stop], log.velocity[first:stop, joint]
        parts.append(np.append(0.0, np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(t))))
    return np.concatenate(parts)


def _travel(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.ptp(known)) if len(known) else 0.0


def _comes_to_nothing(
    logs: Sequence[Log], efforts: Sequence[np.ndarray], joint: int, least: float, near: float
) -> bool:
    """Whether a joint that moves both ways has torque down to nothing: carrying a load one way is no explanation.

    That is where the quantile `least` of its torque is below the part `near` of its largest.
    """
    way = np.concatenate([np.diff(log.position[:, joint]) for log in logs])
    both = min(way[way > 0].sum(), -way[way < 0].sum()) > 0.2 * np.abs(way).sum()
    values = np.concatenate([effort[:, joint] for effort in efforts])
    return bool(both and np.quantile(values, least) < near * np.quantile(values, 0.99))


def _samples(logs: Sequence[Log]) -> FitSamples | None:
    """Samples of all logs that are long enough to be filtered; None where that leaves too few."""
    parts, folds, independent = [], [], 0.0
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
            folds.append(np.arange(len(parts[-1])) * FOLDS // max(len(parts[-1]), 1))
            independent += 2 * cutoff * float(np.ptp(motion.time[motion.kept]))
    rows = np.concatenate(parts) if parts else np.empty((0, 5))
    every = max(1, -(-len(rows) // _SAMPLES))
    rows, fold = rows[::every], np.concatenate([*folds, np.empty(0, dtype=int)])[::every]
    if len(rows) * rows.shape[1] // 5 < 100:
        return None
    q, qd, qdd, torque, direction = np.split(rows, 5, axis=1)
    return FitSamples(q, qd, qdd, torque, direction, fold, independent)


def _mechanics(robot: RobotDescription, samples: FitSamples, more: Sequence[Log]) -> Iterator[str]:
    """What a fit to the samples says; of what only fits better, where one to `more` logs, if any, has a doubt too."""
    plain = _fit(robot, samples)
    names = robot.joint_names
    if not plain.enough or overfitted(robot, samples, plain.joints):
        return
    pushed = _driven_on(plain)
    still = np.flatnonzero(np.ptp(samples.q, axis=0) < 1e-6)
    share = f"a rigid arm explains {100 * max(0.0, 1 - plain.unexplained):.0f} % of the torque, whatever its parameters"
    size = np.std(samples.torque, axis=0)
    for k in still:
        if plain.joints[k] > _UNEXPLAINED and size[k] > 0.1 * size.max():
            yield f"{names[k]} is stuck: its position never changes, and its torque is not that of a joint that stands"
            return
    fits = plain.joints.mean() < _EXACT and not len(pushed)
    likeliest = None if fits else _likeliest(robot, samples, pushed, plain.pushing)
    if plain.unexplained > _UNEXPLAINED:
        likeliest = likeliest or "torque and motion do not belong together, and no mistake tried here explains them"
        yield f"{likeliest}: {share}"
    elif len(pushed):
        whose = ", ".join(names[k] for k in pushed)
        likeliest = likeliest or f"torque and motion of {whose} have opposite signs"
        push = 100 * plain.pushing.max()
        yield f"{likeliest}: friction and inertia would drive {whose} on, by {push:.0f} % of its torque"
    elif likeliest and not _refuted(robot, more):
        yield f"{likeliest}: much more of the torque would be explained"
    else:
        yield from described_gravity_doubts(robot, samples.q, plain.gravity, samples.torque)


def _refuted(robot: RobotDescription, more: Sequence[Log]) -> bool:
    """Whether nothing speaks against so many logs together; never of none."""
    samples = _samples(more)
    return samples is not None and not any(_mechanics(robot, samples, ()))


def _driven_on(fit: _Fit) -> np.ndarray:
    return np.flatnonzero(fit.pushing > np.maximum(_DRIVING, _SIGNIFICANT * fit.deviation))


def _likeliest(robot: RobotDescription, samples: FitSamples, pushed: np.ndarray, pushing: np.ndarray) -> str | None:
    """The mistake that explains clearly more of what is held out than the log as it is; None where none does.

    Where joints are `pushed` on, it is one that is about one of them; one that flips the torque or the position of a
    joint against the other is none where friction and inertia brake that joint.
    """
    bodies = Bodies(robot)
    precision = bodies.precision(samples)
    plain = HeldOutFit(bodies, samples, precision)
    before = plain.errors(np.arange(robot.dof), np.ones(robot.dof))
    tried = []
    for fit, mistakes in _mistakes(bodies, samples, plain, precision, pushing > 0):
        for what, order, sign, about in mistakes:
            if len(pushed) and not set(pushed.tolist()) & set(about):
                continue
            after = fit.errors(order, sign)
            gains = np.log(before / after).sum(axis=1)
            whole = fit is not plain and np.any(order != np.arange(robot.dof))
            least = _SLIDE_GAIN if whole and len({robot.joints[k].prismatic for k in about}) > 1 else _GAIN
            if gains.mean() > max(least, _CERTAIN * gains.std(ddof=1) / np.sqrt(FOLDS)):
                tried.append((float(gains.mean()), what, fit.bodies.robot, fit.undone(order, sign)))
    tried = [each for each in tried if not len(_driven_on(_fit(*each[2:])))]  # else it is no better an arm
    best = max((gain for gain, *_ in tried), default=0.0)
    return next((what for gain, what, *_ in tried if gain > best - _AS_GOOD), None)


def _mistakes(
    bodies: Bodies, s: FitSamples, plain: HeldOutFit, precision: np.ndarray, driven: np.ndarray
) -> Iterator[tuple[HeldOutFit, list[_Mistake]]]:
    """Fits to the motion as it would be without a mistake, each with the mistakes it can undo, the likelier first."""
    robot = bodies.robot
    names, n = robot.joint_names, robot.dof
    everyone = tuple(range(n))
    given: np.ndarray = np.arange(n)
    signs: np.ndarray = np.ones(n)
    turning = ~np.array([joint.prismatic for joint in robot.joints])

    def fit(of: Bodies = bodies, scale: np.ndarray = signs, order: np.ndarray = given) -> HeldOutFit:
        return HeldOutFit(of, moved(scale, order), precision)

    def moved(scale: np.ndarray, order: np.ndarray) -> FitSamples:
        q, qd, qdd = (values[:, order] * scale for values in (s.q, s.qd, s.qdd))
        return replace(s, q=q, qd=qd, qdd=qdd, direction=s.direction[:, order] * np.sign(scale))

    for other in gravity_directions(robot):
        text = f"gravity in the base frame looks like {gravity_text(other)}"
        yield fit(Bodies(other)), [(text, given, signs, everyone)]
    degrees = np.where(turning, np.pi / 180, 1.0)
    yield fit(scale=degrees), [("positions look like degrees", given, signs, everyone)]
    for k in range(n):
        sign = np.where(given == k, -1.0, 1.0)
        turned: list[_Mistake] = [(f"position and torque of {names[k]} look flipped", given, sign, (k,))]
        if driven[k]:
            yield plain, [(f"the torque of {names[k]} looks flipped", given, sign, (k,))]
            turned.insert(0, (f"the position of {names[k]} looks flipped", given, signs, (k,)))
        yield fit(scale=sign), turned
    for a, b in combinations(range(n), 2):
        order = given.copy()
        order[[a, b]] = b, a
        who = f"{names[a]} and {names[b]}"
        yield plain, [(f"the torques of {who} look swapped", order, signs, (a, b))]
        both: list[_Mistake] = [(f"the positions of {who} look swapped", given, signs, (a, b))]
        if turning[a] == turning[b]:
            both.append((f"{who} look swapped", order, signs, (a, b)))
        yield fit(order=order), both
        if turning[a] != turning[b] and swap_in_range(robot, s.q.min(axis=0), s.q.max(axis=0), a, b):
            undone = moved(signs, order)  # its parameters have other sizes: force and torque are of other units
            sizes = bodies.precision(replace(undone, torque=s.torque[:, order]))
            yield HeldOutFit(bodies, undone, sizes), [(f"{who} look swapped", order, signs, (a, b))]


def _fit(robot: RobotDescription, s: FitSamples) -> _Fit:
    """What the log leaves unexplained as it is, and whether what explains it would drive the joints on."""
    bodies = Bodies(robot)
    fit = solved(bodies, s)
    count, n = s.q.shape
    total = np.linalg.norm(s.torque)
    independent, known = n * min(count, s.independent), np.count_nonzero(fit.known)
    push = _push(robot, s, fit.columns, bodies.regressor) / fit.scale[:, None] / fit.length
    variance = max(float(np.mean(fit.joints**2)), _EXACT**4) * count * n / max(independent - known, 1e-9)
    # with what the torques could hold, or directions that few seconds leave open would push by any amount
    information = (fit.directions.T * fit.sizes**2) @ fit.directions / variance
    precision = information + np.diag(bodies.precision(s) * min(1.0, s.independent / count) / fit.length**2)
    likely = np.linalg.solve(precision, information @ (fit.solution * fit.length))
    scatter = np.sqrt(np.maximum(np.sum(push * np.linalg.solve(precision, push.T).T, axis=1), 0.0))
    return _Fit(
        fit.joints,
        float(np.linalg.norm(fit.error) / total) if total > 0 else 0.0,
        bodies.regressor(s.q, 0 * s.q, 0 * s.q) @ fit.solution[: 11 * n],
        push @ likely,
        scatter,
        bool(independent > _SAMPLES_PER_PARAMETER * known),
    )


def _push(robot: RobotDescription, s: FitSamples, columns: np.ndarray, rigid: _Regressor) -> np.ndarray:
    """(n, p): torque by which each joint drives itself on, by friction and by its own inertia, a unit of parameter."""
    n = robot.dof
    bodies = columns.shape[2] - 3 * n
    push = np.zeros((n, columns.shape[2]))
    some = s.q[:: max(1, len(s.q) // 10)]
    at_rest = rigid(some, 0 * some, 0 * some)
    for k in range(n):
        speed = max(float(np.sqrt(np.mean(s.qd[:, k] ** 2))), 1e-12)
        rub = np.mean(columns[:, k] * s.qd[:, k, None], axis=0) / speed
        moving = s.direction[:, k][np.abs(s.direction[:, k]) > 0.5]
        if len(moving) and min(np.mean(moving > 0), np.mean(moving < 0)) > _ONE_WAY:
            push[k, bodies : bodies + 2 * n] = -rub[bodies : bodies + 2 * n]
        inertia = (rigid(some, 0 * some, np.tile(np.eye(n)[k], (len(some), 1))) - at_rest)[:, k]
        push[k, :bodies] = -np.mean(inertia, axis=0) * np.sqrt(np.mean(s.qdd[:, k] ** 2))
    return push
