"""Checks by fits of a rigid arm: gravity, units, signs, swapped joints, lengths.

A plain rigid arm with Coulomb and viscous friction and offsets, free in all its parameters, is fitted to a few hundred
samples, and again to what the log would be had one thing in it been mistaken: gravity, a unit, a sign, two joints. The
held-out error decides (`rigid_fit`). On the healthy logs that the limits were set on (three real arms, and simulated
ones of two simulators) no mistake gained more than 0.7. Where torques alone cannot tell, as gravity on a pendulum, the
description's own masses may.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from agent.core import and_list
from agent.data_quality.description_fit import MEND_GRAVITY, WITH_GRAVITY, described_gravity, gravity_axes, gravity_text
from agent.data_quality.faults import QualityFinding, Recordings
from agent.data_quality.rigid_fit import FOLDS, RigidFit, fitted_gravity
from agent.data_quality.signs import passive_errors
from agent.robot import Dynamics, RobotDescription

_UNEXPLAINED = 0.5  # of the torque of all joints, root mean square
_GAIN = 1.0  # of a mistake that is named, see rigid_fit
_CERTAIN = 2.5  # standard errors of that gain over the folds, and
_AS_GOOD = 0.5  # less gain than the best: as good, so the likelier one is named
_EXACT = 0.01  # of the torque: a fit that leaves less is right, and what is left may be anything
_DRIVING = 0.15  # of a joint's torque, by which friction and inertia together must push the wrong way
_SIGNIFICANT = 5.0  # standard deviations of that push, and
_ONE_WAY = 0.02  # of the time in motion that a joint goes the other way: less tells no friction from an offset
_LENGTHS = (0.8, 1.25, 0.65, 0.7, 0.75, 0.85, 0.9, 1.1, 1.15, 1.2, 1.35, 1.5)  # times the described: the first two test
_LENGTH_GAIN = 0.2  # of a length that is named: of six real arms and simulated ones the right lengths gain 0.06 at most
_UNISON = 0.98  # correlation of two joints beyond which they cannot be distinguished
_TURNS = (0.5 * np.pi, -0.5 * np.pi, np.pi)  # by which the zeros of two tables of one joint differ
_TILT = np.radians(3.0)  # of gravity from the described direction: a smaller one is within what descriptions leave open


@dataclass(frozen=True, eq=False)
class _Mistake:
    """text: what it is; fit, torque (S, n): motion and torque without it; about: its joints, from 0; zero: theirs."""

    text: str
    fit: RigidFit
    torque: np.ndarray
    about: tuple[int, ...]
    zero: bool = False


def implausible_mechanics(of: Recordings) -> Iterator[QualityFinding]:
    """Findings of a fit to the samples. A mistake that only fits better must also do so with further logs, if any."""
    robot, samples = of.robot, of.samples
    if samples is None or not samples.moving.any():
        return
    if not (plain := RigidFit(Dynamics(robot), samples)).says_something():
        return
    solution = plain.solution(samples.torque)
    pushing, driven_on = _pushing(plain, samples.torque)
    unexplained = solution.unexplained
    right = solution.left.mean() < _EXACT and not len(driven_on)
    likeliest = None if right or of.predicted() else _likeliest(plain, pushing, driven_on)
    if unexplained > _UNEXPLAINED:
        share = f"a rigid arm explains {100 * max(0.0, 1 - unexplained):.0f} % of the torque, whatever its parameters"
        finding = likeliest or _unrelated(plain)
        yield replace(finding, text=f"{finding.text}: {share}")
    elif len(driven_on):
        whose = ", ".join(robot.joint_names[k] for k in driven_on)
        finding = likeliest or _opposite(plain, driven_on, whose)
        push = f"friction and inertia would drive {whose} on, by {100 * pushing.max():.0f} % of its torque"
        yield replace(finding, text=f"{finding.text}: {push}")
    elif likeliest and not _of_pauses(plain) and not _refuted(of):
        yield replace(likeliest, text=f"{likeliest.text}: much more of the torque would be explained")
    else:
        still = 0 * samples.q
        gravity = plain.regressor(samples.q, still, still) @ solution.parameters[: 11 * robot.dof]
        yield from described_gravity(robot, samples, gravity, unexplained)


def _unrelated(plain: RigidFit) -> QualityFinding:
    """Torque that motion hardly explains: refused unless it predicts what is held out clearly better than none does."""
    torque, fold = plain.samples.torque, plain.samples.fold
    squared_deviation = (torque - torque.mean(axis=0)) ** 2
    still = np.array([squared_deviation[fold == part].sum(axis=0) for part in range(FOLDS)])
    gain, error = _gain(still, plain.errors(torque))
    if _is_certain(gain, error):
        text, advice = (
            "most of the torque comes from neither bodies nor friction",
            "look for springs, contact and noise",
        )
        return QualityFinding(text, advice=advice, refuses=False)
    return QualityFinding("torque and motion do not belong together, and no mistake tried explains it")


def _opposite(plain: RigidFit, driven_on: np.ndarray, whose: str) -> QualityFinding:
    """Joints that are driven on: refused if turned torque of a passive arm predicts better what is held out."""
    torque, names = plain.samples.torque, plain.robot.joint_names
    turned = torque * np.where(np.isin(np.arange(plain.robot.dof), driven_on), -1.0, 1.0)
    if _gain(passive_errors(plain, torque), passive_errors(plain, turned))[0] > 0:
        return QualityFinding(f"torque and motion of {whose} have opposite signs", names)
    text = f"the sign of the torque of {whose} fits better than the opposite one, with friction that falls with speed"
    advice = "the effort has to be total motor torque, without compensation of friction"
    return QualityFinding(text, tuple(names[k] for k in driven_on), advice=advice, refuses=False)


def _of_pauses(plain: RigidFit) -> bool:
    """Whether no mistake is left without the pauses of the arm, whose stiction it would explain."""
    samples = plain.samples
    if samples.moving.all() or not (moving := RigidFit(plain.dynamics, samples.in_motion())).says_something():
        return False
    return _likeliest(moving, *_pushing(moving, moving.samples.torque)) is None


def _refuted(of: Recordings) -> bool:
    """Whether nothing speaks against the logs and the other ones together; False where there are no others."""
    together = Recordings(of.robot, [log for log in (*of.logs, *of.others) if log.effort is not None])
    doubts = (finding.refuses for finding in implausible_mechanics(together))
    return len(of.others) > 0 and together.samples is not None and not any(doubts)


def _likeliest(plain: RigidFit, pushing: np.ndarray, driven_on: np.ndarray) -> QualityFinding | None:
    """The mistake that explains clearly more of what is held out than the log as it is; None where none does.

    Where joints are driven on, it is one that is about one of them, and undoing it drives none on. None is named where
    a spring at a joint explains as much: a stiff hose would pass for gravity that is tilted, or for another zero.
    """
    torque, robot = plain.samples.torque, plain.robot
    before = plain.errors(torque)
    tried: list[tuple[float, float, _Mistake]] = []
    for mistake in _mistakes(plain, pushing > 0):
        if len(driven_on) and not set(driven_on.tolist()) & set(mistake.about):
            continue
        gain, error = _gain(before, mistake.fit.errors(mistake.torque))
        if _is_certain(gain, error) and not len(_pushing(mistake.fit, mistake.torque)[1]):
            tried.append((gain, error, mistake))
    tried = _distinct_zero(tried)
    best = max((gain for gain, *_ in tried), default=0.0)
    if tried and any(_gain(before, plain.sprung(k).errors(torque))[0] > best - _AS_GOOD for k in range(robot.dof)):
        return None
    as_good = [mistake for gain, _, mistake in tried if gain > best - _AS_GOOD]
    if not as_good:
        return None
    text, advice, likeliest = as_good[0].text, "", as_good[0]
    upright = [mistake for mistake in as_good if mistake.fit.robot.gravity != robot.gravity]
    if upright and likeliest.zero:
        text += f"; or {upright[0].text}"
    if upright and (likeliest.zero or likeliest is upright[0]):
        advice = MEND_GRAVITY if any(upright[0].fit.robot.gravity) else WITH_GRAVITY
    return QualityFinding(text, tuple(robot.joint_names[k] for k in likeliest.about), advice=advice)


def _is_certain(gain: float, error: float) -> bool:
    return gain > max(_GAIN, _CERTAIN * error)


def _distinct_zero(tried: list[tuple[float, float, _Mistake]]) -> list[tuple[float, float, _Mistake]]:
    """(gain, standard error, mistake) without zeros where those of two joints gain alike: a short motion shows none."""
    zeros = sorted((entry for entry in tried if entry[2].zero), key=lambda entry: -entry[0])
    alike = any(zeros[0][0] - gain < zeros[0][1] and other.about != zeros[0][2].about for gain, _, other in zeros)
    return [entry for entry in tried if not (alike and entry[2].zero)]


def _gain(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Mean over folds of the gain from squared errors (FOLDS, n), and its standard error."""
    gains = (np.log(before) - np.log(after)).sum(axis=1)
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(FOLDS))


def _mistakes(plain: RigidFit, driven: np.ndarray) -> Iterator[_Mistake]:
    """Mistakes and what the log would be without them, the likelier first.

    Torque or position of a joint is flipped against the other only where the joint is `driven` (n,) on.
    """
    robot, s, torque = plain.robot, plain.samples, plain.samples.torque
    names, n = robot.joint_names, robot.dof
    everyone = tuple(range(n))
    joint_numbers: np.ndarray = np.arange(n)
    turning = ~np.array([joint.prismatic for joint in robot.joints])

    def moved(scale: np.ndarray | float = 1.0, order: np.ndarray = joint_numbers) -> RigidFit:
        q, qd, qdd = (values[:, order] * scale for values in (s.q, s.qd, s.qdd))
        motion = replace(s, q=q, qd=qd, qdd=qdd, direction=s.direction[:, order] * np.sign(scale))
        return RigidFit(plain.dynamics, motion, plain.precision)

    def under(gravity: tuple[float, float, float]) -> RigidFit:
        return RigidFit(Dynamics(replace(robot, gravity=gravity)), s, plain.precision)

    for k in np.flatnonzero(turning).tolist():
        for angle in _TURNS:
            offset = np.where(joint_numbers == k, angle, 0.0)
            yield _Mistake(_zeros_text(robot, offset), _with_zeros(plain, offset), torque, (k,), True)
    for gravity in (*gravity_axes(robot), *_tilted(plain)):
        yield _Mistake(gravity_text(robot, gravity), under(gravity), torque, everyone)
    yield _Mistake("these torques carry no gravity", under((0.0, 0.0, 0.0)), torque, everyone)
    if np.abs(s.q[:, turning]).max(initial=0.0) > np.pi:
        yield _Mistake("positions look like degrees", moved(np.where(turning, np.pi / 180, 1.0)), torque, everyone)
    separate_joints = np.flatnonzero(~_in_unison(s.q).any(axis=0)).tolist()
    for k in separate_joints:
        sign = np.where(joint_numbers == k, -1.0, 1.0)
        flipped = moved(sign)
        if driven[k]:
            yield _Mistake(f"the torque of {names[k]} looks flipped", plain, torque * sign, (k,))
            yield _Mistake(f"the position of {names[k]} looks flipped", flipped, torque, (k,))
        yield _Mistake(f"position and torque of {names[k]} look flipped", flipped, torque * sign, (k,))
    yield from (mistake for mistake in _from_base(plain) if mistake.about[0] in separate_joints)
    for a, b in combinations(separate_joints, 2):
        order = joint_numbers.copy()
        order[[a, b]] = b, a
        who = f"{names[a]} and {names[b]}"
        swapped = moved(order=order)
        yield _Mistake(f"the torques of {who} look swapped", plain, torque[:, order], (a, b))
        yield _Mistake(f"the positions of {who} look swapped", swapped, torque, (a, b))
        if turning[a] == turning[b]:
            yield _Mistake(f"{who} look swapped", swapped, torque[:, order], (a, b))


def _with_zeros(plain: RigidFit, offset: np.ndarray) -> RigidFit:
    return RigidFit(plain.dynamics, replace(plain.samples, q=plain.samples.q + offset), plain.precision)


def _zeros_text(robot: RobotDescription, offset: np.ndarray) -> str:
    off = [robot.joint_names[k] for k in np.flatnonzero(offset)]
    whose = f"the zero of {off[0]} looks" if len(off) == 1 else f"the zeros of {and_list(off)} look"
    values = ", ".join(f"{value:g} deg" if value else "0" for value in np.degrees(offset))
    sizes = and_list([f"{abs(angle):g}°" for angle in dict.fromkeys(np.abs(np.degrees(offset[offset != 0])))])
    return f"{whose} {sizes} off: import with `position: {{offset: [{values}]}}`"


def _from_base(plain: RigidFit) -> Iterator[_Mistake]:
    """Positions measured from the link before the last one, as drives at the base measure them, of parallel axes."""
    robot, s, (rotation, _, axis, slides, *_) = plain.robot, plain.samples, plain.dynamics.chain
    for k in range(1, robot.dof):
        along = float(axis[k - 1] @ rotation[k] @ axis[k])
        if slides[k] or slides[k - 1] or not np.isclose(abs(along), 1.0):
            continue
        own, other = robot.joint_names[k], robot.joint_names[k - 1]
        sign, change = (1.0, "subtract") if along > 0 else (-1.0, "add")
        q, qd, qdd = (
            values - sign * np.where(np.arange(robot.dof) == k, values[:, [k - 1]], 0.0)
            for values in (s.q, s.qd, s.qdd)
        )
        direction = np.where(np.arange(robot.dof) == k, np.sign(qd), s.direction)
        relative = RigidFit(plain.dynamics, replace(s, q=q, qd=qd, qdd=qdd, direction=direction), plain.precision)
        text = (
            f"the position of {own} looks measured from the link before {other}: {change} that of {other} before the "
            "import, or write motor_coupling in robot.yaml if both drives sit there"
        )
        yield _Mistake(text, relative, s.torque, (k,))


def _tilted(plain: RigidFit) -> Iterator[tuple[float, float, float]]:
    """The direction of gravity that fits best, unless it is nearly the described one."""
    gravity, described = fitted_gravity(plain), np.array(plain.robot.gravity)
    if described.any() and gravity @ described < np.cos(_TILT) * float(np.linalg.norm(described)) ** 2:
        x, y, z = gravity.tolist()
        yield x, y, z


def _in_unison(q: np.ndarray) -> np.ndarray:
    """(n, n) pairs of joints that move alike and so cannot be distinguished."""
    moved = np.var(q, axis=0) > 0  # not of a joint whose square underflows
    alike = np.zeros((q.shape[1], q.shape[1]), bool)
    if moved.sum() > 1:
        alike[np.ix_(moved, moved)] = np.abs(np.corrcoef(q[:, moved].T)) > _UNISON
    np.fill_diagonal(alike, False)
    return alike


def _pushing(fit: RigidFit, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which joints a fit to a torque (S, n) would drive on, by friction or by their own inertia.

    Returns (n,) part of each joint's torque that does, where a positive one is wrong, and the joints (from 0) for which
    it is large and certain.
    """
    s, columns, n = fit.samples, fit.columns, fit.robot.dof
    friction = slice(11 * n, 13 * n)
    push = np.zeros((n, columns.shape[2]))  # by a unit of each parameter
    postures = s.q[:: max(1, len(s.q) // 10)]
    at_rest = fit.regressor(postures, 0 * postures, 0 * postures)
    for k in range(n):
        speed = max(float(np.sqrt(np.mean(s.qd[:, k] ** 2))), 1e-12)
        moving = s.direction[:, k][np.abs(s.direction[:, k]) > 0.5]
        if len(moving) and min(np.mean(moving > 0), np.mean(moving < 0)) > _ONE_WAY:
            push[k, friction] = -np.mean(columns[:, k, friction] * s.qd[:, k, None], axis=0) / speed
        inertia = (fit.regressor(postures, 0 * postures, np.tile(np.eye(n)[k], (len(postures), 1))) - at_rest)[:, k]
        push[k, : 11 * n] = -np.mean(inertia, axis=0) * np.sqrt(np.mean(s.qdd[:, k] ** 2))
    square = np.sum(torque**2, axis=0)
    push /= np.sqrt(np.where(square > 0, square, len(torque)) / len(torque))[:, None]
    solution = fit.solution(torque)
    pushing = push @ solution.parameters
    deviation = np.sqrt(np.maximum(np.sum((push @ solution.covariance) * push, axis=1), 0.0))
    return pushing, np.flatnonzero(pushing > np.maximum(_DRIVING, _SIGNIFICANT * deviation))


def wrong_lengths(of: Recordings) -> Iterator[QualityFinding]:
    """The distance between two joints that explains clearly more with another length than the description has, or
    zeros of one or two joints that explain still more: they may look like a length."""
    samples = of.samples
    if samples is None or not (plain := RigidFit(Dynamics(of.robot), samples)).says_something():
        return
    before = plain.errors(samples.torque)

    def gain(joint: int, times: float) -> tuple[float, float]:
        other = _with_length(of.robot, joint, times)
        if other is None:
            return -np.inf, 0.0
        return _gain(before, RigidFit(Dynamics(other), samples, plain.precision).errors(samples.torque))

    tried = [(*gain(joint, times), joint) for joint in range(1, of.robot.dof) for times in _LENGTHS[:2]]
    better = [(mean, joint) for mean, error, joint in tried if mean > max(_LENGTH_GAIN, _CERTAIN * error)]
    gained, error, offset = _best_zeros(plain) if better else (0.0, 0.0, np.zeros(0))
    if better and gained > max(_CERTAIN * error, *(mean for mean, _ in better)):
        names = tuple(of.robot.joint_names[k] for k in np.flatnonzero(offset))
        text = f"{_zeros_text(of.robot, offset)}: these motions and torques fit clearly better then"
        yield QualityFinding(text, names, refuses=gained > _GAIN)
    elif better:
        joint = max(better)[1]
        times = max(_LENGTHS, key=lambda times: gain(joint, times)[0])
        pair = of.robot.joint_names[joint - 1], of.robot.joint_names[joint]
        yield QualityFinding(
            f"the distance from {pair[0]} to {pair[1]} in the description looks wrong: these motions and torques fit "
            f"clearly better with about {times:g} times that length",
            pair,
            advice="compare the joint origins of the URDF with the data sheet",
            refuses=False,
        )


def _best_zeros(plain: RigidFit) -> tuple[float, float, np.ndarray]:
    """Gain of the zeros of one or two joints that explain most, its standard error, and what to add (n,) [rad]; of two
    only where one explains less."""
    torque = plain.samples.torque
    before, offsets = plain.errors(torque), [*_quarter_turns(plain.robot)]
    gains = [_gain(before, _with_zeros(plain, offset).errors(torque)) for offset in offsets]
    single = [k for k, offset in enumerate(offsets) if np.count_nonzero(offset) == 1]
    best, of_one = (max(candidates, key=lambda k: gains[k][0]) for candidates in (range(len(gains)), single))
    best = of_one if gains[best][0] - gains[of_one][0] < gains[best][1] else best
    return *gains[best], offsets[best]


def _quarter_turns(robot: RobotDescription) -> Iterator[np.ndarray]:
    """(n,) [rad] of one turning joint, or of two."""
    turning = [k for k, joint in enumerate(robot.joints) if not joint.prismatic]
    for count in (1, 2):
        for turned_joints, angles in product(combinations(turning, count), product(_TURNS, repeat=count)):
            offset = np.zeros(robot.dof)
            offset[list(turned_joints)] = angles
            yield offset


def _with_length(robot: RobotDescription, joint: int, times: float) -> RobotDescription | None:
    """The robot with a joint this many times as far from the one before; None where they have one origin."""
    root = ElementTree.fromstring(robot.urdf)
    origin = root.find(f"joint[@name='{robot.joint_names[joint]}']/origin")
    place = np.array([float(x) for x in ("0" if origin is None else origin.get("xyz", "0")).split()])
    if origin is None or not place.any():
        return None
    origin.set("xyz", " ".join(map(str, times * place)))
    return replace(robot, urdf=ElementTree.tostring(root, encoding="unicode"))
