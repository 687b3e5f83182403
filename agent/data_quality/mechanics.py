"""Checks by fits of a rigid arm: gravity, units, signs, swapped joints, lengths.

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
    RigidFit,
    fit_samples,
    fitted_gravity,
    overfitted,
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
_UNISON = 0.98  # correlation of two joints beyond which they cannot be distinguished
_TILT = np.radians(3.0)  # of gravity from the described direction: a smaller one is within what descriptions leave open


@dataclass(frozen=True, eq=False)
class _Mistake:
    """text: what it is; fit, torque (S, n): motion and torque without it; about: its joints, from 0; gain: the least
    with which it is named."""

    text: str
    fit: RigidFit
    torque: np.ndarray
    about: tuple[int, ...]
    gain: float = _GAIN


@dataclass(frozen=True, eq=False)
class _Fit:
    """left (n,), unexplained: part of the torque that is left, per joint and of all; pushing (n,): part of each joint's
    torque by which friction, or its own inertia, drives it on, and the deviation of that; positive ones are wrong."""

    left: np.ndarray
    unexplained: float
    gravity: np.ndarray  # (S, n) torque along the samples
    pushing: np.ndarray
    deviation: np.ndarray

    @property
    def driven_on(self) -> np.ndarray:
        """Joints (from 0) that are clearly driven on."""
        return np.flatnonzero(self.pushing > np.maximum(_DRIVING, _SIGNIFICANT * self.deviation))


def implausible_mechanics(of: Recordings) -> Iterator[QualityFinding]:
    """Findings of a fit to the samples. A mistake that only fits better must also do so with further logs, if any."""
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
    plain = RigidFit(Bodies(robot), samples)
    if not _says_something(plain):
        return
    fit = _fitted(plain, samples.torque)
    pushed, names = fit.driven_on, robot.joint_names
    still = np.flatnonzero(np.ptp(samples.q, axis=0) < 1e-6)
    share = f"a rigid arm explains {100 * max(0.0, 1 - fit.unexplained):.0f} % of the torque, whatever its parameters"
    size = np.std(samples.torque, axis=0)
    for k in still:
        if fit.left[k] > _UNEXPLAINED and size[k] > 0.1 * size.max():
            text = f"{names[k]} is stuck: its position never changes, and its torque is not that of a joint that stands"
            yield QualityFinding(text, (names[k],))
            return
    right = fit.left.mean() < _EXACT and not len(pushed)
    likeliest = None if right else _likeliest(plain, fit)
    if fit.unexplained > _UNEXPLAINED:
        found = likeliest or QualityFinding(
            "torque and motion do not belong together, and no mistake tried explains it"
        )
        yield replace(found, text=f"{found.text}: {share}")
    elif len(pushed):
        whose = ", ".join(names[k] for k in pushed)
        found = likeliest or QualityFinding(f"torque and motion of {whose} have opposite signs", names)
        push = f"friction and inertia would drive {whose} on, by {100 * fit.pushing.max():.0f} % of its torque"
        yield replace(found, text=f"{found.text}: {push}")
    elif likeliest and not _refuted(robot, more):
        yield replace(likeliest, text=f"{likeliest.text}: much more of the torque would be explained")
    else:
        yield from described_gravity(robot, samples, fit.gravity, fit.unexplained)


def _says_something(plain: RigidFit) -> bool:
    """Whether samples are many enough for their parameters, and what is held out is predicted, to compare fits."""
    s = plain.samples
    rows = plain.columns.reshape(s.q.size, -1)
    length = np.linalg.norm(rows, axis=0)
    known = np.linalg.matrix_rank(rows / np.where(length > 0, length, 1.0), rtol=1e-7)
    independent = s.q.shape[1] * min(len(s.q), s.independent)
    return independent > _SAMPLES_PER_PARAMETER * known and not overfitted(plain, s.torque)


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
        left = RigidFit(Bodies(of.robot), samples).solution(samples.torque).left
        return float(np.sqrt(np.mean((samples.qdd / largest) ** 2))) / max(float(left.mean()), _EXACT)

    return max(each, key=clarity, default=None)


def _wrong_lengths(
    robot: RobotDescription, samples: FitSamples, together: FitSamples | None = None
) -> Iterator[QualityFinding]:
    """The distance between two joints that explains clearly more with another length than the description has.

    Where `samples` are of one log, that length must not explain less of all logs `together`: one motion alone excites
    little, and another length may stand for its friction.
    """
    plain = RigidFit(Bodies(robot), samples)
    if not _says_something(plain):
        return
    gain = _gain_by_length(plain)
    of_all = None if together is None else _gain_by_length(RigidFit(Bodies(robot), together))
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


def _gain_by_length(plain: RigidFit) -> Callable[[int, float], tuple[float, float]]:
    """Return what another distance of a joint (from 0) from the one before gains: mean over folds, standard error."""
    samples, robot = plain.samples, plain.bodies.robot
    before, precision = plain.errors(samples.torque), plain.bodies.precision(samples)

    def gain(joint: int, times: float) -> tuple[float, float]:
        other = _with_length(robot, joint, times)
        if other is None:
            return -np.inf, 0.0
        return _gain(before, RigidFit(Bodies(other), samples, precision).errors(samples.torque))

    return gain


def _gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Mean over folds of the gain from squared errors (FOLDS, n), and its standard error."""
    gains = (np.log(before) - np.log(after)).sum(axis=1)
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(FOLDS))


def _with_length(robot: RobotDescription, joint: int, times: float) -> RobotDescription | None:
    """The robot with a joint this many times as far from the one before; None where they have one origin."""
    root = ElementTree.fromstring(robot.urdf)
    origin = root.find(f"joint[@name='{robot.joint_names[joint]}']/origin")
    place = np.array([float(x) for x in ("0" if origin is None else origin.get("xyz", "0")).split()])
    if origin is None or not place.any():
        return None
    origin.set("xyz", " ".join(map(str, times * place)))
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))


def _likeliest(plain: RigidFit, fit: _Fit) -> QualityFinding | None:
    """The mistake that explains clearly more of what is held out than the log as it is; None where none does.

    Where joints are pushed on, it is one that is about one of them; one that flips the torque or the position of a
    joint against the other is none where friction and inertia brake that joint.
    """
    before, pushed = plain.errors(plain.samples.torque), set(fit.driven_on.tolist())
    tried: list[tuple[float, _Mistake]] = []
    for mistake in _mistakes(plain, fit.pushing > 0):
        if pushed and not pushed & set(mistake.about):
            continue
        gain, error = _gain(before, mistake.fit.errors(mistake.torque))
        # one without which joints are driven on is no better an arm
        if gain > max(mistake.gain, _CERTAIN * error) and not len(_fitted(mistake.fit, mistake.torque).driven_on):
            tried.append((gain, mistake))
    best = max((gain for gain, _ in tried), default=0.0)
    for gain, mistake in tried:
        if gain > best - _AS_GOOD:
            robot, mended = plain.bodies.robot, mistake.fit.bodies.robot
            advice = ""
            if mended.gravity != robot.gravity:
                advice = MEND_GRAVITY if any(mended.gravity) else WITH_GRAVITY
            return QualityFinding(mistake.text, tuple(robot.joint_names[k] for k in mistake.about), advice=advice)
    return None


def _mistakes(plain: RigidFit, driven: np.ndarray) -> Iterator[_Mistake]:
    """Mistakes and what the log would be without them, the likelier first."""
    bodies, s = plain.bodies, plain.samples
    robot, torque, precision = bodies.robot, s.torque, bodies.precision(s)
    names, n = robot.joint_names, robot.dof
    everyone = tuple(range(n))
    given: np.ndarray = np.arange(n)
    turning = ~np.array([joint.prismatic for joint in robot.joints])

    def moved(scale: np.ndarray | float = 1.0, order: np.ndarray = given) -> RigidFit:
        q, qd, qdd = (values[:, order] * scale for values in (s.q, s.qd, s.qdd))
        motion = replace(s, q=q, qd=qd, qdd=qdd, direction=s.direction[:, order] * np.sign(scale))
        return RigidFit(bodies, motion, precision)

    for other in (*gravity_axes(robot), *_tilted(bodies, s)):
        yield _Mistake(gravity_text(robot, other), RigidFit(Bodies(other), s, precision), torque, everyone)
    weightless = Bodies(replace(robot, gravity=(0.0, 0.0, 0.0)))
    yield _Mistake("these torques carry no gravity", RigidFit(weightless, s, precision), torque, everyone)
    if np.abs(s.q[:, turning]).max(initial=0.0) > np.pi:
        yield _Mistake("positions look like degrees", moved(np.where(turning, np.pi / 180, 1.0)), torque, everyone)
    alike = _in_unison(s.q)
    for k in np.flatnonzero(~alike.any(axis=0)).tolist():
        sign = np.where(given == k, -1.0, 1.0)
        flipped = moved(sign)
        if driven[k]:
            yield _Mistake(f"the torque of {names[k]} looks flipped", plain, torque * sign, (k,))
            yield _Mistake(f"the position of {names[k]} looks flipped", flipped, torque, (k,))
        yield _Mistake(f"position and torque of {names[k]} look flipped", flipped, torque * sign, (k,))
    for a, b in combinations(np.flatnonzero(~alike.any(axis=0)).tolist(), 2):
        order = given.copy()
        order[[a, b]] = b, a
        who = f"{names[a]} and {names[b]}"
        yield _Mistake(f"the torques of {who} look swapped", plain, torque[:, order], (a, b))
        swapped = moved(order=order)
        yield _Mistake(f"the positions of {who} look swapped", swapped, torque, (a, b))
        if turning[a] == turning[b]:
            yield _Mistake(f"{who} look swapped", swapped, torque[:, order], (a, b))
        elif swap_in_range(robot, s.q.min(axis=0), s.q.max(axis=0), a, b):
            # its parameters have other sizes: force and torque are of other units
            undone = replace(swapped.samples, torque=torque[:, order])
            yield _Mistake(f"{who} look swapped", RigidFit(bodies, undone), undone.torque, (a, b), _SLIDE_GAIN)


def _tilted(bodies: Bodies, samples: FitSamples) -> Iterator[RobotDescription]:
    """The robot with the direction of gravity that fits best, unless it is nearly the described one."""
    robot = bodies.robot
    gravity = fitted_gravity(bodies, samples)
    described = np.array(robot.gravity)
    size = float(np.linalg.norm(described))
    if size > 0 and gravity @ described < np.cos(_TILT) * size**2:
        yield with_gravity(robot, gravity)


def _in_unison(q: np.ndarray) -> np.ndarray:
    """(n, n) pairs of joints that move alike and so cannot be distinguished."""
    moved = np.ptp(q, axis=0) > 0
    alike = np.zeros((q.shape[1], q.shape[1]), bool)
    if moved.sum() > 1:
        alike[np.ix_(moved, moved)] = np.abs(np.corrcoef(q[:, moved].T)) > _UNISON
    np.fill_diagonal(alike, False)
    return alike


def _fitted(fit: RigidFit, torque: np.ndarray) -> _Fit:
    """The part of a torque (S, n) that a rigid arm leaves, and whether the fit would drive joints on."""
    s, bodies = fit.samples, fit.bodies
    solution = fit.solution(torque)
    square = np.sum(torque**2, axis=0)
    scale = np.sqrt(np.where(square > 0, square, len(torque)) / len(torque))
    push = _push(fit) / scale[:, None]
    scatter = np.sqrt(np.maximum(np.sum((push @ solution.covariance) * push, axis=1), 0.0))
    unexplained = float(np.sqrt(np.sum(solution.left**2 * square) / max(float(square.sum()), 1e-300)))
    gravity = bodies.regressor(s.q, 0 * s.q, 0 * s.q) @ solution.parameters[: 11 * bodies.robot.dof]
    return _Fit(solution.left, unexplained, gravity, push @ solution.parameters, scatter)


def _push(fit: RigidFit) -> np.ndarray:
    """(n, p): torque by which each joint drives itself on, by friction and by its own inertia, a unit of parameter."""
    s, columns, n = fit.samples, fit.columns, fit.bodies.robot.dof
    friction = slice(11 * n, 13 * n)
    push = np.zeros((n, columns.shape[2]))
    some = s.q[:: max(1, len(s.q) // 10)]
    at_rest = fit.bodies.regressor(some, 0 * some, 0 * some)
    for k in range(n):
        speed = max(float(np.sqrt(np.mean(s.qd[:, k] ** 2))), 1e-12)
        moving = s.direction[:, k][np.abs(s.direction[:, k]) > 0.5]
        if len(moving) and min(np.mean(moving > 0), np.mean(moving < 0)) > _ONE_WAY:
            push[k, friction] = -np.mean(columns[:, k, friction] * s.qd[:, k, None], axis=0) / speed
        inertia = (fit.bodies.regressor(some, 0 * some, np.tile(np.eye(n)[k], (len(some), 1))) - at_rest)[:, k]
        push[k, : 11 * n] = -np.mean(inertia, axis=0) * np.sqrt(np.mean(s.qdd[:, k] ** 2))
    return push
