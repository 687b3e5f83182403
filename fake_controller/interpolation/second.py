"""A second interpolator: constant speed along a move and through a corner, trapezoidal or S-curve ramps in between.

It shares no path, no time law and no rule of a limit with the planner's. Each move has one speed and one acceleration,
the lowest that the joints allow anywhere on it; each corner is taken at one speed. Joint moves go the same way in
joints divided by their speed limits, so that all of them arrive together. It stops where a Cartesian move meets a joint
move or another tool, at the ends of CIRCULAR moves, and at points of FLY_PASS, which the arm passes exactly.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from agent.core import InputError
from agent.motion import Delay, MotionError, SpeedOption, Statement, Trajectory
from agent.robot import KinematicsError, RobotDescription, kinematics_for
from fake_controller.interpolation.curves import arc, corner
from fake_controller.interpolation.parts import InterpolationLaw, Part, PartMaker
from fake_controller.interpolation.ramps import RampedMove, reachable

_SMALLEST_CUT = 1e-4  # m, or s
_KNOTS = 0.004  # m, rad or s of path between two inverse kinematics
_LONGEST = 3600.0  # s
_REPAIRS = 6  # times that moves are slowed down whose joints would accelerate beyond their limits


@dataclass(frozen=True, eq=False)
class _Piece:
    """A leg or a corner: way (K,) from its beginning, and joints as found later. `parts` are one or two moves."""

    way: np.ndarray
    places: np.ndarray
    turns: Rotation | None
    parts: tuple[Part, ...]


class SecondInterpolator:
    """Plans the moves of one robot at `period` [s] by `law`."""

    def __init__(self, robot: RobotDescription, law: InterpolationLaw, period: float) -> None:
        self.robot, self.law, self.period = robot, law, period
        self._maker, self._kinematics = PartMaker(robot, law), kinematics_for(robot)

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points from rest at `start` (n,) to rest.

        Raises:
            MotionError: out of reach, beyond a joint limit, or what this controller has not.
        """
        q = np.asarray(start, dtype=float)
        if q.shape != (self.robot.dof,) or not np.isfinite(q).all():
            raise InputError(f"start of the motion: {self.robot.dof} finite joint positions are needed, not {start}")
        samples, owners = [np.stack((q, 0 * q, 0 * q))[None]], [np.zeros(1, dtype=int)]
        run: list[Part] = []

        def go() -> None:
            nonlocal q, run
            for several in self._without_stops(run):
                rows, owner = self._run(several, q)
                samples.append(rows[1:])
                owners.append(owner[1:])
                q = rows[-1, 0]
            run = []

        for index, statement in enumerate(statements):
            if isinstance(statement, Delay):
                go()
                count = round(min(statement.seconds, _LONGEST) / self.period)
                samples.append(np.tile(np.stack((q, 0 * q, 0 * q)), (count, 1, 1)))
                owners.append(np.full(count, index))
                continue
            if run and not self._maker.flies_on(run[-1], statement):
                go()
            part = self._maker.part(index, statement, run[-1] if run else None, q)
            if part is not None:
                run.append(part)
            if not statement.fly:
                go()
        go()
        rows, owner = np.concatenate(samples), np.concatenate(owners)
        tcp = self._kinematics.forward(rows[:, 0])
        speed = (
            np.linalg.norm(np.gradient(tcp[:, :3, 3], axis=0), axis=1) / self.period if len(rows) > 1 else rows[:, 0, 0]
        )
        return Trajectory(np.arange(len(rows)) * self.period, rows[:, 0], rows[:, 1], rows[:, 2], tcp, speed, owner)

    def _without_stops(self, run: Sequence[Part]) -> list[list[Part]]:
        """The moves of a run from one stop on the way to the next."""
        groups: list[list[Part]] = []
        for part in run:
            if groups and self._maker.cut(groups[-1][-1], part) >= _SMALLEST_CUT:
                groups[-1].append(part)
            else:
                groups.append([part])
        return groups

    def _pieces(self, parts: Sequence[Part]) -> list[_Piece]:
        cuts = [0.0, *(self._maker.cut(a, b) for a, b in itertools.pairwise(parts)), 0.0]
        pieces = []
        for k, part in enumerate(parts):
            leg = part.leg
            if part.via is not None or part.turns_only:
                turned = float(np.linalg.norm(leg.by))
                count = int(np.clip(np.ceil(max(turned, 2 * leg.length) / _KNOTS), 8, 2000))
                sigma = np.linspace(0.0, 1.0, count + 1)
                places, turns = leg.at(sigma)
                length = turned
                if part.via is not None:
                    circle = arc(leg.start, part.via, leg.end, sigma)
                    assert circle is not None
                    length, places = circle
                pieces.append(_Piece(sigma * length, places, turns, (part,)))
                continue
            begin, end = cuts[k] / leg.length, 1.0 - cuts[k + 1] / leg.length
            if end - begin > 1e-9:
                count = int(np.clip(np.ceil((end - begin) * leg.length / _KNOTS), 4, 2000))
                sigma = np.linspace(begin, end, count + 1)
                pieces.append(_Piece((sigma - begin) * leg.length, *leg.at(sigma), (part,)))
            if k + 1 < len(parts):
                neighbours = (part, parts[k + 1])
                pieces.append(_Piece(*corner(leg, parts[k + 1].leg, cuts[k + 1], self.law.blend), neighbours))
        return pieces

    def _run(self, parts: Sequence[Part], q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(S, 3, n) joints, velocities and accelerations from rest to rest, and (S,) the moves they belong to."""
        pieces = self._pieces(parts)
        ways, at = [], 0.0
        for piece in pieces:
            ways.append(piece.way + at)
            at += piece.way[-1]
        joints = self._solved(pieces, q)
        # One spline over all pieces would carry the curvature of a corner into the adjacent legs, and slow them down.
        splines = [CubicSpline(distance, part) for distance, part in zip(ways, joints, strict=True)]
        limits = np.array([self._limits(*each) for each in zip(pieces, ways, splines, strict=True)]).T
        slower = np.ones(len(pieces))
        for _ in range(_REPAIRS):
            stretches = self._timed(pieces, limits, slower)
            rows, which = self._sampled(stretches, ways, splines, parts[0].index)
            full = np.abs(rows[:, 2]) / self.robot.max_acceleration
            over = np.array([full[which == k].max(initial=0.0) for k in range(len(pieces))])
            slower *= np.where(over > 1.0, 0.99 / np.maximum(over, 1.0), 1.0)
            if over.max() <= 1.0:
                break
        rows[-1] = np.stack((joints[-1][-1], 0 * q, 0 * q))
        owner = np.array([piece.parts[-1 if len(piece.parts) == 1 else 0].index for piece in pieces])[which]
        return rows, owner

    def _sampled(
        self, stretches: Sequence[RampedMove], ways: Sequence[np.ndarray], splines: Sequence[CubicSpline], index: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """(S, 3, n) joints, velocities and accelerations from rest to rest, and (S,) the pieces they belong to."""
        begins = np.concatenate(([0.0], np.cumsum([stretch.duration for stretch in stretches])))
        if begins[-1] > _LONGEST:
            raise MotionError(f"the motion would take {begins[-1]:.0f} s", index, "duration", 1.0)
        t = np.minimum(np.arange(int(np.ceil(begins[-1] / self.period - 1e-9)) + 1) * self.period, begins[-1])
        which = np.clip(np.searchsorted(begins, t, side="right") - 1, 0, len(stretches) - 1)
        rows = np.empty((len(t), 3, self.robot.dof))
        for k, (stretch, spline) in enumerate(zip(stretches, splines, strict=True)):
            of_stretch = which == k
            s, v, a = stretch.at(t[of_stretch] - begins[k])[..., None]
            q, first, second = (spline(s[:, 0] + ways[k][0], order) for order in range(3))
            rows[of_stretch] = np.stack((q, first * v, second * v**2 + first * a), axis=1)
        return rows, which

    def _solved(self, pieces: Sequence[_Piece], q: np.ndarray) -> list[np.ndarray]:
        """Joints (K, n) at the knots of each piece."""
        out = []
        for piece in pieces:
            kinematics = piece.parts[0].kinematics
            if kinematics is None:
                places = piece.places * self.robot.max_velocity
            else:
                assert piece.turns is not None
                poses = np.tile(np.eye(4), (len(piece.places), 1, 1))
                poses[:, :3, :3], poses[:, :3, 3] = piece.turns.as_matrix(), piece.places
                try:
                    places = kinematics.follow(poses, q)
                except KinematicsError as error:
                    raise MotionError(str(error), piece.parts[0].index, error.reason, error.excess) from None
            out.append(places)
            q = places[-1]
        return out

    def _timed(self, pieces: Sequence[_Piece], limits: np.ndarray, slower: np.ndarray) -> list[RampedMove]:
        """Speed and acceleration of each piece, with corners as slow as the ways between them make it."""
        speed, up, down = limits
        speed, up, down = speed * np.sqrt(slower), up * slower, down * slower
        length = np.array([piece.way[-1] for piece in pieces])
        jerk = np.inf if self.law.jerk_time == 0 else max(up.max(), down.max()) / self.law.jerk_time
        corners = np.array([len(piece.parts) == 2 for piece in pieces])
        # Speed at the borders: that of the corner, or of the slower of two; at both ends the arm rests.
        border = np.concatenate(([0.0], np.minimum(speed[:-1], speed[1:]), [0.0]))
        for k in range(len(pieces)):
            most = border[k] if corners[k] else reachable(border[k], length[k], up[k], jerk, border[k + 1])
            border[k + 1] = min(border[k + 1], most)
        for k in reversed(range(len(pieces))):
            most = border[k + 1] if corners[k] else reachable(border[k + 1], length[k], down[k], jerk, border[k])
            border[k] = min(border[k], most)
        speed = np.where(corners, border[:-1], speed)
        return [
            RampedMove(length[k], border[k], border[k + 1], speed[k], up[k], down[k], jerk) for k in range(len(pieces))
        ]

    def _limits(self, piece: _Piece, distance: np.ndarray, spline: CubicSpline) -> tuple[float, float, float]:
        """Speed, acceleration and deceleration along a piece, by the joints on it alone."""
        law, robot, round_corner = self.law, self.robot, len(piece.parts) == 2
        first, second = np.abs(spline(distance, 1)).max(axis=0), np.abs(spline(distance, 2)).max(axis=0)
        with np.errstate(divide="ignore"):
            joints = float(np.min(robot.max_velocity / first))
            speed = min(joints, float(np.sqrt(np.min(law.curve * robot.max_acceleration / second))))
            ramp = law.acceleration * float(np.min(robot.max_acceleration / first))
        up = down = ramp
        for part in piece.parts:
            settings = part.settings
            speed = min(speed, self._maker.programmed(part))
            if settings.speed_option is SpeedOption.SPD_JNT and part.kinematics is not None:
                speed = min(speed, joints * settings.speed_override * settings.arm_override)
            if part.kinematics is not None:
                angle = float(np.linalg.norm(part.leg.by))
                turning = 1.0 if part.turns_only else angle / part.leg.length
                tcp = robot.cartesian_limits
                most = law.linear if tcp is None else tcp.linear_acceleration
                if turning > 0:
                    most = min(most, (law.turning if tcp is None else tcp.rotational_acceleration) / turning)
                if round_corner:
                    bend = np.linalg.norm(CubicSpline(piece.way, piece.places)(piece.way, 2), axis=1).max()
                    speed = min(speed, float(np.sqrt(law.curve * most / max(bend, 1e-9))))
                up, down = min(up, law.acceleration * most), min(down, law.acceleration * most)
            scale = settings.arm_override
            up = min(up, ramp) * settings.acceleration_override * scale
            down = min(down, ramp) * settings.deceleration_override * scale
        return speed, up, down
