"""Which limit keeps a run below its programmed speed, and when."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from agent.compiled import tcp_rates
from agent.motion.fly.profile import ArmLimits
from agent.motion.fly.setpoints import Run
from agent.motion.path import rules
from agent.motion.trajectory import BindingLimit

#: Every so many samples are looked at; slower than this part of the programmed speed is slowed down.
_EVERY, _REACHED = 5, 0.995
#: A limit is in force from this part of it on.
_FULL = 0.7


def binding_limits(
    run: Run, limits: ArmLimits, joint_names: tuple[str, ...], begin: float, period: float
) -> list[BindingLimit]:
    """The limits in force where the run is slower than programmed, the fullest one at each time; `begin` [s].

    A limit is as full as the part of it that stress and overrides leave, so what is named may be below the arm's own.
    """
    samples, path = run.samples, run.path
    pick = slice(None, None, _EVERY)
    s, speed = samples.s[pick] + path.s[0], samples.speed[pick]
    knot = np.clip(np.searchsorted(path.s, s), 0, len(path.s) - 1)
    rule = path.rules[knot]
    with np.errstate(divide="ignore", invalid="ignore"):
        joint_full = np.max(np.abs(run.shape.q1[:, knot]) / limits.speed[:, None], axis=0)
        turning = rule[:, rules.ROTATIONAL] / run.shape.turn[knot]
        programmed = rule[:, rules.LINEAR] / run.shape.travel[knot]
        programmed = np.where(np.isfinite(programmed), programmed, turning)
        joint = np.where(rule[:, rules.JOINT] < 1.0, rule[:, rules.JOINT] / joint_full, np.inf)
        programmed = np.minimum(programmed, joint)
    allowed = rule[:, rules.STRESS] * np.maximum(rule[:, rules.ACCELERATION], rule[:, rules.DECELERATION])
    qd, qdd = samples.qd[:, pick], samples.qdd[:, pick]
    jerk = np.zeros_like(qdd)
    jerk[:, 1:] = (qdd[:, 1:] - samples.qdd[:, _EVERY - 1 :: _EVERY][:, : jerk.shape[1] - 1]) / period
    rates = tcp_rates(samples.rows, samples.joints)[:, pick]
    cartesian = limits.cartesian
    ceilings = (
        cartesian.linear_speed,
        cartesian.rotational_speed,
        cartesian.linear_acceleration * allowed / rule[:, rules.STRESS],
        cartesian.rotational_acceleration * allowed / rule[:, rules.STRESS],
    )
    full = np.concatenate(
        (
            np.abs(qd) / limits.speed[:, None],
            np.abs(qdd) / (limits.acceleration[:, None] * allowed),
            np.abs(jerk) / limits.jerk[:, None],
            rates / (np.stack([np.broadcast_to(ceiling, len(s)) for ceiling in ceilings]) * rule[:, rules.CARTESIAN]),
            np.where(path.overlap[knot] < 0.999, speed / np.maximum(programmed * path.overlap[knot], 1e-12), 0.0)[None],
            (speed / turning)[None],
        )
    )
    names = [f"{name} {what}" for what in ("speed", "acceleration", "jerk") for name in joint_names]
    names += ["linear speed", "rotational speed", "linear acceleration", "rotational acceleration", "FLY_NORM overlap"]
    names += ["programmed rotational speed"]
    slowed = speed < _REACHED * programmed
    slowed[[0, -1]] = len(s) > 2 and slowed[1], len(s) > 2 and slowed[-2]
    # Between two limits, where the acceleration changes its sign, none is full: the nearest one that was counts.
    certain = np.flatnonzero(slowed & (full.max(axis=0) > _FULL))
    nearest = np.arange(len(s))
    if len(certain):
        after = np.minimum(np.searchsorted(certain, nearest), len(certain) - 1)
        before = np.maximum(after - 1, 0)
        nearer = nearest - certain[before] <= certain[after] - nearest
        nearest = certain[np.where(nearer, before, after)]
    worst = np.where(slowed, np.argmax(full, axis=0)[nearest], -1)
    edges = np.concatenate(([0], 1 + np.flatnonzero(np.diff(worst)), [len(worst)]))
    end = begin + (len(samples.s) - 1) * period
    return [
        BindingLimit(names[worst[a]], begin + a * _EVERY * period, min(begin + b * _EVERY * period, end))
        for a, b in pairwise(edges)
        if worst[a] >= 0
    ]
