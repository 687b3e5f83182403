"""Runs: the moves of a program from one standstill to the next, planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.compiled import tcp_rates
from agent.motion.fly import rules
from agent.motion.fly.blend import Corner, corner_between
from agent.motion.fly.blocks import plan_blocks
from agent.motion.fly.fly_parameters import FlyParameters
from agent.motion.fly.move_geometry import CartesianSegment, JointSegment, Segment, label_of
from agent.motion.fly.path import Path, build_path
from agent.motion.fly.profile import ArmLimits, PathShape, shape_of
from agent.motion.fly.setpoints import Run, plan_run
from agent.motion.interpolator import BindingLimit, MotionError
from agent.robot import RobotDescription, parse_configuration

#: Largest number of attempts at a path, with smaller joint-space blends or more knots, and largest factor of knots.
_ATTEMPTS, _FINEST = 10, 32.0
#: A path whose error between knots exceeds the tolerated one by this factor nearly touches a singularity: refused.
_ROUGHEST = 30.0
#: Normalised distance from a singularity that $SING_CARE asks for.
_SING_CARE = 0.05
#: One sample in this many is examined. A run is slowed down below this part of its programmed speed.
_EVERY, _REACHED = 5, 0.995
#: A limit is in force above this part of it.
_FULL = 0.7
#: Slack on joint limits [rad or m], for round-off only.
_SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class RunPlanner:
    """Plans runs for one arm at one period."""

    robot: RobotDescription
    limits: ArmLimits
    period: float
    parameters: FlyParameters

    def plan(self, segments: Sequence[Segment], start: np.ndarray) -> list[Run]:
        """Runs over `segments` from rest at `start` (n,): one, or more where a corner cannot be flown.

        Raises:
            MotionError: out of reach, through a singularity, beyond a joint limit, or too long.
        """
        corners = [corner_between(before, after, self.parameters) for before, after in pairwise(segments)]
        runs: list[Run] = []
        for part, inner in _parts(segments, corners):
            q = runs[-1].shape.path.q[-1] if runs else start
            runs += self._quickest(part, inner, q)
        return runs

    def _quickest(self, segments: Sequence[Segment], corners: list[Corner], start: np.ndarray) -> list[Run]:
        """The blended run; where FLY_NORM takes part and stopping at its corners is quicker, runs that stop there."""
        blended = self._run(segments, corners, start)
        if not any(corner.overlap for corner in corners):
            return [blended]
        stopping: list[Run] = []
        try:
            for part, inner in _parts(segments, [None if corner.overlap else corner for corner in corners]):
                stopping.append(self._run(part, inner, stopping[-1].shape.path.q[-1] if stopping else start))
        except MotionError:
            return [blended]  # the corner itself may be where the arm cannot be, and the blend passes it by
        return stopping if sum(len(run.samples.s) - 1 for run in stopping) < len(blended.samples.s) - 1 else [blended]

    def timed(self, shape: PathShape, segments: Sequence[Segment]) -> Run:
        """The samples along a path.

        Raises:
            MotionError: no speed on it keeps the limits.
        """
        plan = plan_blocks if self.parameters.ramps == "blocks" else plan_run
        return plan(shape, segments, self.limits, self.period, self.parameters)

    def binding_limits(self, runs: Sequence[tuple[float, Run]]) -> tuple[BindingLimit, ...]:
        """The limits in force where runs, each from its `begin` [s] on, are slower than programmed."""
        return tuple(limit for begin, run in runs for limit in _slowing(run, begin, self))

    def _run(self, segments: Sequence[Segment], corners: list[Corner], start: np.ndarray) -> Run:
        shape = self._path(segments, corners, start)
        self._check_positions(shape.path, segments)
        self._check_care(shape.path, segments)
        return self.timed(shape, segments)

    def _path(self, segments: Sequence[Segment], corners: Sequence[Corner], start: np.ndarray) -> PathShape:
        """The path of a run with blends no wider than allowed, and as many knots as it needs."""
        fineness = 1.0
        for attempt in range(_ATTEMPTS):
            last = attempt == _ATTEMPTS - 1
            try:
                path = build_path(segments, corners, start, self.limits.speed, self.parameters, fineness)
            except MotionError as error:
                # Near a singularity joints may turn fast without leaving their branch: more knots tell.
                if error.limit != "branch" or fineness >= _FINEST or last:
                    raise
                fineness = min(8.0 * fineness, _FINEST)
                continue
            if max(path.deviations, default=0.0) > 1.0 and not last:
                corners = [
                    corner if deviation <= 1.0 else corner.scaled(0.95 / deviation)
                    for corner, deviation in zip(corners, path.deviations, strict=True)
                ]
                continue
            shape = shape_of(path, self.parameters.blend == "polynomial")
            roughness, roughest = shape.roughness()
            if roughness <= 1.0 or fineness >= _FINEST or last:
                break
            fineness = min(1.2 * fineness * roughness**0.25, _FINEST)
        if roughness > _ROUGHEST:
            move = int(path.move[roughest])
            raise MotionError(
                f"{label_of(segments, move)}: joints turn too fast along the path: it all but touches a singularity; "
                "move the point or turn the tool",
                move,
                "singularity",
                float(np.log10(roughness / _ROUGHEST)),
            )
        return shape

    def _check_positions(self, path: Path, segments: Sequence[Segment]) -> None:
        lower, upper = self.robot.position_limits
        beyond = np.maximum(path.q - upper, lower - path.q)
        knot, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        amount = float(beyond[knot, joint])
        if amount <= _SLACK:
            return
        move, name = int(path.move[knot]), self.robot.joint_names[joint]
        label = label_of(segments, move)
        excess = f"{1e3 * amount:.3g} mm" if self.robot.joints[joint].prismatic else f"{np.degrees(amount):.3g} degrees"
        raise MotionError(
            f"{label}: {name} would go {excess} beyond its limit; move the point or choose another configuration",
            move,
            f"{name} position",
            amount / float(min(upper[joint] - lower[joint], 2.0 * np.pi)),
        )

    def _check_care(self, path: Path, segments: Sequence[Segment]) -> None:
        """What $CNFG_CARE, $TURN_CARE and $SING_CARE ask for."""
        for segment in segments:
            samples = np.flatnonzero(path.move == segment.move)
            if len(samples) == 0:
                continue
            wanted = segment.configuration if isinstance(segment, CartesianSegment) else ""
            configuration = segment.kinematics.configuration_text(path.q[samples[-1]]) if wanted else ""
            if configuration:
                care, asked, has = segment.settings, parse_configuration(wanted), parse_configuration(configuration)
                turned = care.turn_care and asked.turns != has.turns
                if turned or (care.configuration_care and asked.signs != has.signs):
                    raise MotionError(
                        f"{segment.label}: the arm arrives in configuration '{has}' and the target says '{asked}'; a "
                        "LINEAR or CIRCULAR move keeps its configuration: change it with a JOINT move before",
                        segment.move,
                        "configuration",
                        1.0,
                    )
            if segment.settings.singularity_care and not isinstance(segment, JointSegment):
                distance = float(segment.kinematics.singularity(path.q[samples]).min())
                if distance < _SING_CARE:
                    raise MotionError(
                        f"{segment.label}: the path comes within {distance:.3g} of a singularity and $SING_CARE allows "
                        f"{_SING_CARE:g} (1 is far away); move the point or turn the tool",
                        segment.move,
                        "singularity",
                        1.0 - distance / _SING_CARE,
                    )


def _parts(
    segments: Sequence[Segment], corners: Sequence[Corner | None]
) -> list[tuple[Sequence[Segment], list[Corner]]]:
    """The segments between corners that are stops, with the corners inside."""
    parts, first = [], 0
    for last in range(len(segments)):
        if last == len(corners) or corners[last] is None:
            parts.append((segments[first : last + 1], [corner for corner in corners[first:last] if corner is not None]))
            first = last + 1
    return parts


def _slowing(run: Run, begin: float, planner: RunPlanner) -> list[BindingLimit]:
    """The limits in force where the run is slower than programmed, the fullest one at each time; `begin` [s].

    Stress and overrides reduce a limit, so the limit that is named may be below the arm's own.
    """
    limits, period = planner.limits, planner.period
    samples, path = run.samples, run.shape.path
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
    rates = tcp_rates(samples.rows, len(samples.q))[:, pick]
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
    names = [f"{name} {what}" for what in ("speed", "acceleration", "jerk") for name in planner.robot.joint_names]
    names += [
        "linear speed",
        "rotational speed",
        "linear acceleration",
        "rotational acceleration",
        "FLY_NORM overlap",
    ]
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
