"""Runs: the moves of a program from one standstill to the next, planned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from agent.motion.fly.blend import Corner, corner_between
from agent.motion.fly.blocks import plan_blocks
from agent.motion.fly.move_geometry import CartesianSegment, JointSegment, Segment, label_of
from agent.motion.fly.parameters import FlyParameters
from agent.motion.fly.path import Path, build_path
from agent.motion.fly.profile import ArmLimits, PathShape, shape_of
from agent.motion.fly.setpoints import Run, plan_run
from agent.motion.interpolator import MotionError
from agent.robot import RobotDescription, parse_configuration

#: Largest number of attempts at a path, with smaller joint-space blends or more knots, and largest factor of knots.
_ATTEMPTS, _FINEST = 10, 32.0
#: A path whose error between knots exceeds the tolerated one by this factor nearly touches a singularity: refused.
_ROUGHEST = 30.0
#: Normalised distance from a singularity that $SING_CARE asks for.
_SING_CARE = 0.05
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
            q = runs[-1].path.q[-1] if runs else start
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
                stopping.append(self._run(part, inner, stopping[-1].path.q[-1] if stopping else start))
        except MotionError:
            return [blended]  # the corner itself may be where the arm cannot be, and the blend passes it by
        return stopping if sum(len(run.samples.s) - 1 for run in stopping) < len(blended.samples.s) - 1 else [blended]

    def _run(self, segments: Sequence[Segment], corners: list[Corner], start: np.ndarray) -> Run:
        path, shape = self._path(segments, corners, start)
        self._check_positions(path, segments)
        self._check_care(path, segments)
        plan = plan_blocks if self.parameters.ramps == "blocks" else plan_run
        return plan(path, shape, segments, self.limits, self.period, self.parameters)

    def _path(
        self, segments: Sequence[Segment], corners: Sequence[Corner], start: np.ndarray
    ) -> tuple[Path, PathShape]:
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
            roughness = shape.roughness(path)
            if roughness <= 1.0 or fineness >= _FINEST or last:
                break
            fineness = min(1.2 * fineness * roughness**0.25, _FINEST)
        if roughness > _ROUGHEST:
            move = int(path.move[shape.roughest(path)])
            raise MotionError(
                f"{label_of(segments, move)}: joints turn too fast along the path: it all but touches a singularity; "
                "move the point or turn the tool",
                move,
                "singularity",
                float(np.log10(roughness / _ROUGHEST)),
            )
        return path, shape

    def _check_positions(self, path: Path, segments: Sequence[Segment]) -> None:
        lower, upper = self.robot.position_limits
        beyond = np.maximum(path.q - upper, lower - path.q)
        knot, joint = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        amount = float(beyond[knot, joint])
        if amount <= _SLACK:
            return
        move, name = int(path.move[knot]), self.robot.joint_names[joint]
        label = label_of(segments, move)
        shown = f"{1e3 * amount:.3g} mm" if self.robot.joints[joint].prismatic else f"{np.degrees(amount):.3g} degrees"
        raise MotionError(
            f"{label}: {name} would go {shown} beyond its limit; move the point or choose another configuration",
            move,
            f"{name} position",
            amount / float(min(upper[joint] - lower[joint], 2.0 * np.pi)),
        )

    def _check_care(self, path: Path, segments: Sequence[Segment]) -> None:
        """What $CNFG_CARE, $TURN_CARE and $SING_CARE ask for."""
        for segment in segments:
            here = np.flatnonzero(path.move == segment.move)
            if len(here) == 0:
                continue
            wanted = segment.configuration if isinstance(segment, CartesianSegment) else ""
            found = segment.kinematics.configuration_text(path.q[here[-1]]) if wanted else ""
            if found:
                care, asked, has = segment.settings, parse_configuration(wanted), parse_configuration(found)
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
                distance = float(segment.kinematics.singularity(path.q[here]).min())
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
