"""Checks by fits of a rigid arm: gravity, units, signs and swapped joints.

A plain rigid arm with Coulomb and viscous friction and offsets, free in all its parameters, is fitted to a few hundred
samples, and again to what the log would be had one thing in it been mistaken: gravity, a unit, a sign, two joints. What
is held out decides (`rigid_fit`). On the healthy logs that the limits were set on (three real arms, and simulated ones
of two simulators) no mistake gained more than 0.7. Where torques alone cannot tell, as gravity on a pendulum, the
description's own masses may.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from agent.data_quality.described import (
    MEND_GRAVITY,
    WITH_GRAVITY,
    described_gravity,
    gravity_axes,
    gravity_text,
    with_gravity,
)
from agent.data_quality.finding import QualityFinding, Recordings
from agent.data_quality.ranges import swap_in_range
from agent.data_quality.rigid_fit import (
    FOLDS,
    Bodies,
    FitSamples,
    HeldOutFit,
    fit_samples,
    fitted_gravity,
    overfitted,
    solved,
)
from agent.recording import Log
from agent.robot import RobotDescription

_UNEXPLAINED = 0.5  # of the torque of all joints, root mean square
_GAIN = 1.0  # of a mistake that is named, see rigid_fit
_SLIDE_GAIN = 4.0  # the same of a slide in the place of a turning joint: other columns, which may fit a bad log better
_CERTAIN = 2.5  # standard errors of that gain over the folds, and
_AS_GOOD = 0.5  # less gain than the best: as good, so the likelier one is named
_EXACT = 0.01  # of the torque: a fit that leaves less is right, and what is left may be anything
_DRIVING = 0.15  # of a joint's torque, by which friction and inertia together must push the wrong way
_SIGNIFICANT = 5.0  # standard deviations of that push, and
_SAMPLES_PER_PARAMETER = 4.0  # independent samples for each parameter: a short log tells no mistake from chance
_ONE_WAY = 0.02  # of the time in motion that a joint goes the other way: less tells no friction from an offset
_LENGTHS = (0.8, 1.25, 0.65, 0.7, 0.75, 0.85, 0.9, 1.1, 1.15, 1.2, 1.35, 1.5)  # times the described: the first two test
_LENGTH_GAIN = 0.2  # of a length that is named: of six real arms and simulated ones the right lengths gain 0.06 at most
_UNISON = 0.98  # correlation of two joints beyond which neither can be told from the other
_TILT = np.radians(3.0)  # of gravity from the described direction: a smaller one is within what descriptions leave open


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


def implausible_mechanics(of: Recordings) -> Iterator[QualityFinding]:
    """What a fit to the samples says; of what only fits better, where one to more logs, if any, has a doubt too."""
    samples = of.samples
    if samples is not None:
        more = [*of.logs, *(log for log in of.others if log.effort is not None)] if of.others else []
        found = list(_mechanics(of.robot, samples, more))
        yield from found
        if not any(finding.refuses for finding in found):
            together = list(_wrong_lengths(of.robot, samples))
            clearest = None if together or len(of.logs) == 1 else _clearest(of)
            yield from together if clearest is None else _wrong_lengths(of.robot, clearest, samples)


def _mechanics(robot: RobotDescription, samples: FitSamples, more: Sequence[Log]) -> Iterator[QualityFinding]:
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
            text = f"{names[k]} is stuck: its position never changes, and its torque is not that of a joint that stands"
            yield QualityFinding(text, (names[k],))
            return
    fits = plain.joints.mean() < _EXACT and not len(pushed)
    likeliest = None if fits else _likeliest(robot, samples, pushed, plain.pushing)
    if plain.unexplained > _UNEXPLAINED:
        found = likeliest or QualityFinding(
            "torque and motion do not belong together, and no mistake tried explains it"
        )
        yield replace(found, text=f"{found.text}: {share}")
    elif len(pushed):
        whose = ", ".join(names[k] for k in pushed)
        found = likeliest or QualityFinding(f"torque and motion of {whose} have opposite signs", robot.joint_names)
        push = f"friction and inertia would drive {whose} on, by {100 * plain.pushing.max():.0f} % of its torque"
        yield replace(found, text=f"{found.text}: {push}")
    elif likeliest and not _refuted(robot, more):
        yield replace(likeliest, text=f"{likeliest.text}: much more of the torque would be explained")
    else:
        yield from described_gravity(robot, samples, plain.gravity, plain.unexplained)


def _refuted(robot: RobotDescription, more: Sequence[Log]) -> bool:
    """Whether nothing speaks against these logs together; False where there are none."""
    samples = fit_samples(more)
    return samples is not None and not any(f.refuses for f in _mechanics(robot, samples, ()))


def _clearest(of: Recordings) -> FitSamples | None:
    """Samples of the log whose accelerations are largest relative to what a rigid arm leaves of its torque.

    Lengths of links show in accelerations, and what is not modelled in another log would hide them.
    """
    each = [samples for log in of.logs if (samples := fit_samples([log])) is not None]
    largest = of.robot.max_acceleration

    def clarity(samples: FitSamples) -> float:
        left = max(float(_fit(of.robot, samples).joints.mean()), _EXACT)
        return float(np.sqrt(np.mean((samples.qdd / largest) ** 2))) / left

    return max(each, key=clarity, default=None)


def _wrong_lengths(
    robot: RobotDescription, samples: FitSamples, together: FitSamples | None = None
) -> Iterator[QualityFinding]:
    """The distance between two joints that explains clearly more with another length than the description has.

    Where `samples` are of one log, that length must not explain less of all logs `together`: one motion alone excites
    little, and another length may stand for its friction.
    """
    plain = _fit(robot, samples)
    if not plain.enough or overfitted(robot, samples, plain.joints):
        return
    gain = _gain_by_length(robot, samples)
    of_all = None if together is None else _gain_by_length(robot, together)
    tried = [(*gain(joint, times), joint, times) for joint in range(1, robot.dof) for times in _LENGTHS[:2]]
    better = [(mean, joint, times) for mean, error, joint, times in tried if mean > max(_LENGTH_GAIN, _CERTAIN * error)]
    better = [entry for entry in better if of_all is None or of_all(*entry[1:])[0] > 0]
    if better:
        joint = max(better)[1]
        times = max(_LENGTHS, key=lambda times: gain(joint, times)[0])
        pair = robot.joint_names[joint - 1], robot.joint_names[joint]
        yield QualityFinding(
            f"the distance from {pair[0]} to {pair[1]} in the description looks wrong: these motions and torques fit "
            f"clearly better with about {times:g} times that length",
            pair,
            advice="compare the joint origins of the URDF with the data sheet",
            refuses=False,
        )


def _gain_by_length(robot: RobotDescription, samples: FitSamples) -> Callable[[int, float], tuple[float, float]]:
    """Return what another distance of a joint (from 0) from the one before gains: mean over folds, standard error."""
    bodies = Bodies(robot)
    precision = bodies.precision(samples)
    order, sign = np.arange(robot.dof), np.ones(robot.dof)
    before = HeldOutFit(bodies, samples, precision).errors(order, sign)

    def gain(joint: int, times: float) -> tuple[float, float]:
        other = _with_length(robot, joint, times)
        if other is None:
            return -np.inf, 0.0
        gains = np.log(before / HeldOutFit(Bodies(other), samples, precision).errors(order, sign)).sum(axis=1)
        return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(FOLDS))

    return gain


def _with_length(robot: RobotDescription, joint: int, times: float) -> RobotDescription | None:
    """The robot with a joint this many times as far from the one before; None where they have one origin."""
    root = ElementTree.fromstring(robot.urdf)
    origin = root.find(f"joint[@name='{robot.joint_names[joint]}']/origin")
    place = np.array([float(x) for x in ("0" if origin is None else origin.get("xyz", "0")).split()])
    if origin is None or not place.any():
        return None
    origin.set("xyz", " ".join(map(str, times * place)))
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))


def _driven_on(fit: _Fit) -> np.ndarray:
    return np.flatnonzero(fit.pushing > np.maximum(_DRIVING, _SIGNIFICANT * fit.deviation))


def _likeliest(
    robot: RobotDescription, samples: FitSamples, pushed: np.ndarray, pushing: np.ndarray
) -> QualityFinding | None:
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
                tried.append((float(gains.mean()), what, about, fit.bodies.robot, fit.undone(order, sign)))
    tried = [each for each in tried if not len(_driven_on(_fit(*each[3:])))]  # else it is no better an arm
    best = max((gain for gain, *_ in tried), default=0.0)
    for gain, what, about, mended, _ in tried:
        if gain > best - _AS_GOOD:
            advice = ""
            if mended.gravity != robot.gravity:
                advice = MEND_GRAVITY if any(mended.gravity) else WITH_GRAVITY
            return QualityFinding(what, tuple(robot.joint_names[k] for k in about), advice=advice)
    return None


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

    for other in (*gravity_axes(robot), *_tilted(bodies, s)):
        yield fit(Bodies(other)), [(gravity_text(robot, other), given, signs, everyone)]
    weightless = replace(robot, gravity=(0.0, 0.0, 0.0))
    yield fit(Bodies(weightless)), [("these torques carry no gravity", given, signs, everyone)]
    degrees = np.where(turning, np.pi / 180, 1.0)
    if np.abs(s.q[:, turning]).max(initial=0.0) > np.pi:
        yield fit(scale=degrees), [("positions look like degrees", given, signs, everyone)]
    alike = _in_unison(s.q)
    for k in np.flatnonzero(~alike.any(axis=0)).tolist():
        sign = np.where(given == k, -1.0, 1.0)
        turned: list[_Mistake] = [(f"position and torque of {names[k]} look flipped", given, sign, (k,))]
        if driven[k]:
            yield plain, [(f"the torque of {names[k]} looks flipped", given, sign, (k,))]
            turned.insert(0, (f"the position of {names[k]} looks flipped", given, signs, (k,)))
        yield fit(scale=sign), turned
    for a, b in combinations(range(n), 2):
        if alike[a].any() or alike[b].any():
            continue
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


def _tilted(bodies: Bodies, samples: FitSamples) -> Iterator[RobotDescription]:
    """The robot with the direction of gravity that fits best, where it is none of what was tried anyway."""
    robot = bodies.robot
    gravity = fitted_gravity(bodies, samples)
    described = np.array(robot.gravity)
    size = float(np.linalg.norm(described))
    if size > 0 and gravity @ described < np.cos(_TILT) * size**2:
        yield with_gravity(robot, gravity)


def _in_unison(q: np.ndarray) -> np.ndarray:
    """(n, n) pairs of joints that move alike, so that what one does cannot be told from what the other does."""
    moved = np.ptp(q, axis=0) > 0
    alike = np.zeros((q.shape[1], q.shape[1]), bool)
    if moved.sum() > 1:
        alike[np.ix_(moved, moved)] = np.abs(np.corrcoef(q[:, moved].T)) > _UNISON
    np.fill_diagonal(alike, False)
    return alike


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
