"""Block by block: one speed and one acceleration for each move, one speed for each corner, ramps in between.

So most numerical controls run a path (Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots,
2008, ch. 3): a move has the lowest speed and acceleration that its limits leave anywhere on it, and speed changes on
moves only. A ramp is trapezoidal in speed, or its acceleration rises and falls at the jerk a/rise, with a the highest
acceleration of the run. `agent learn-interpolator` finds whether a controller does so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from agent.motion.fly import rules
from agent.motion.fly.fly_parameters import FlyParameters
from agent.motion.fly.move_geometry import Segment
from agent.motion.fly.profile import ArmLimits, PathShape, allowed_speed
from agent.motion.fly.setpoints import BlockLaw, Run, refuse_crawling, refuse_long, sampled, stretch_needed

_REPAIRS, _HALVINGS = 6, 50
_SMALL = 1e-12
_TOLERANCE = 5e-4


def plan_blocks(
    shape: PathShape, segments: Sequence[Segment], limits: ArmLimits, period: float, parameters: FlyParameters
) -> Run:
    """Samples along a path, block by block, within its rules and the arm's limits, from rest to rest.

    Where a ramp on a curve asks too much of a joint, its whole block is slowed down. Jerk limits are not looked at.

    Raises:
        MotionError: it would take too long, or the arm would all but stop near a singularity; names one of `segments`.
    """
    refuse_crawling(shape, segments, limits)
    path, blocks = shape.path, _Blocks.of(shape, limits, parameters)
    for _ in range(_REPAIRS):
        law = blocks.law(parameters.rise)
        refuse_long(path, law, segments)
        samples = sampled(shape, law, period)
        full = np.max(np.abs(samples.qdd) / (limits.acceleration / parameters.acceleration)[:, None], axis=0)
        over = np.array([full[of_block].max(initial=0.0) for of_block in blocks.split(samples.s)])
        if over.max() <= 1.0 + _TOLERANCE:
            break
        blocks = blocks.slower(np.where(over > 1.0, 0.99 / np.maximum(over, 1.0), 1.0))
    # Then it is stretched in time until it keeps the arm's limits.
    tcp = replace(limits.cartesian, linear_acceleration=np.inf, rotational_acceleration=np.inf)
    joints = limits.acceleration / parameters.acceleration
    whole = ArmLimits(limits.speed, joints, np.full(len(joints), np.inf), tcp)
    for _ in range(_REPAIRS):
        stretch = float(stretch_needed(path, samples, whole, period).max())
        if stretch <= 1.0 + 2.0 * _TOLERANCE:
            break
        law = replace(law, stretch=law.stretch * stretch)
        samples = sampled(shape, law, period)
    return Run(shape, samples)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """B blocks: the way `edges` (B + 1,), highest speed, acceleration and deceleration (B,), whether a corner (B,)."""

    edges: np.ndarray
    speed: np.ndarray
    up: np.ndarray
    down: np.ndarray
    corner: np.ndarray

    @classmethod
    def of(cls, shape: PathShape, limits: ArmLimits, parameters: FlyParameters) -> _Blocks:
        """Speed profile of a path, by the limits at its knots."""
        path, borders = shape.path, shape.path.borders
        corner = path.block[borders[1:]] % 2 == 1
        asked, ramp = allowed_speed(shape, limits), _ramp(shape, limits)
        in_cells = _bent_joints(shape, limits)
        share = parameters.curve_share / parameters.acceleration
        speed, up, down = np.empty((3, len(corner)))
        for k, (a, b) in enumerate(pairwise(borders)):
            # At a border there is the curvature of the cell before, and that of the cell after.
            bent = share * min(np.min(in_cells[a:b]), _bent_tool(shape, limits, parameters, a, b))
            whole = slice(a, b + 1)
            # A rule belongs to the cell that ends at its knot.
            own = path.rules[a + 1 : b + 1]
            speed[k] = min(np.min(asked[whole if corner[k] else slice(a + 1, b + 1)]), float(np.sqrt(bent)))
            up[k] = np.min(ramp[whole]) * np.min(own[:, rules.ACCELERATION])
            down[k] = np.min(ramp[whole]) * np.min(own[:, rules.DECELERATION])
        return cls(path.s[borders] - path.s[0], speed, up, down, corner)

    def split(self, s: np.ndarray) -> list[np.ndarray]:
        """Masks of the samples at s (S,), one for each block."""
        block = np.clip(np.searchsorted(self.edges, s, side="right") - 1, 0, len(self.speed) - 1)
        return [block == k for k in range(len(self.speed))]

    def slower(self, factor: np.ndarray) -> _Blocks:
        """With accelerations times `factor` (B,), and speeds by its root."""
        return replace(self, speed=self.speed * np.sqrt(factor), up=self.up * factor, down=self.down * factor)

    def law(self, rise: float) -> BlockLaw:
        """Speeds at the borders as high as all blocks allow, and the ramps between them."""
        top = float(max(self.up.max(), self.down.max()))
        jerk = top / rise if rise > 0.0 else np.inf
        length, count = np.diff(self.edges), len(self.speed)
        border = np.concatenate(([0.0], np.minimum(self.speed[:-1], self.speed[1:]), [0.0]))
        for order, rate in ((range(count), self.up), (reversed(range(count)), self.down)):
            for k in order:
                behind, ahead = (k, k + 1) if rate is self.up else (k + 1, k)
                if self.corner[k]:
                    border[ahead] = min(border[ahead], border[behind])
                else:
                    border[ahead] = self._reached(border[behind], border[ahead], length[k], rate[k], jerk)
        phases = [phase for k in range(count) for phase in self._phases(k, border[k], border[k + 1], length[k], jerk)]
        times, acceleration, jerks = np.array(phases).T
        gained = times * (acceleration + 0.5 * jerks * times)
        speed = np.cumsum(gained) - gained
        covered = times * (speed + times * (0.5 * acceleration + jerks * times / 6.0))
        s, ends = np.cumsum(covered) - covered, np.cumsum(times)
        # Removes the round-off of the ramps' lengths: the run ends where its path does.
        scale = self.edges[-1] / covered.sum() if covered.sum() > 0.0 else 1.0
        return BlockLaw(ends - times, s * scale, speed * scale, acceleration * scale, jerks * scale, float(ends[-1]))

    @staticmethod
    def _reached(start: float, wanted: float, length: float, acceleration: float, jerk: float) -> float:
        """The highest speed up to `wanted` that a ramp from `start` reaches within `length`."""
        if wanted <= start:
            return wanted
        return _largest(start, wanted, lambda speed: _length(start, speed, acceleration, jerk) <= length)

    def _phases(self, k: int, start: float, end: float, length: float, jerk: float) -> list[_Phase]:
        if self.corner[k]:
            return [(length / max(start, _SMALL), 0.0, 0.0)]
        up, down = self.up[k], self.down[k]

        def needs(peak: float) -> float:
            return _length(start, peak, up, jerk) + _length(peak, end, down, jerk)

        peak = _largest(max(start, end), max(self.speed[k], start, end), lambda peak: needs(peak) <= length)
        cruise = max(length - needs(peak), 0.0)
        flat = [(cruise / max(peak, _SMALL), 0.0, 0.0)] if cruise > _SMALL else []
        return [*_ramp_phases(start, peak, up, jerk), *flat, *_ramp_phases(peak, end, down, jerk)]


#: Duration [s], acceleration at the beginning, and jerk.
_Phase = tuple[float, float, float]


def _largest(low: float, high: float, fits: Callable[[float], bool]) -> float:
    """The largest number from `low` to `high` that fits, where all smaller ones do."""
    if fits(high):
        return high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _times(change: float, acceleration: float, jerk: float) -> tuple[float, float]:
    """Seconds in which a ramp's acceleration rises (and falls), and in which it is constant."""
    full, rise = acceleration / jerk, float(np.sqrt(change / jerk))
    return (full, max(change / acceleration - full, 0.0)) if full <= rise else (rise, 0.0)


def _length(start: float, end: float, acceleration: float, jerk: float) -> float:
    rise, flat = _times(abs(end - start), acceleration, jerk)
    return 0.5 * (start + end) * (2.0 * rise + flat)


def _ramp_phases(start: float, end: float, acceleration: float, jerk: float) -> list[_Phase]:
    change = abs(end - start)
    if change < _SMALL:
        return []
    rise, flat = _times(change, acceleration, jerk)
    peak = float(np.sign(end - start)) * change / (rise + flat)
    if rise == 0.0:
        return [(flat, peak, 0.0)]
    even = [(flat, peak, 0.0)] if flat > 0.0 else []
    return [(rise, 0.0, peak / rise), *even, (rise, peak, -peak / rise)]


def _bent_joints(shape: PathShape, limits: ArmLimits) -> np.ndarray:
    """(K - 1,) the largest z = ṡ² at which the curve alone takes no more than a joint's acceleration in a cell."""
    n = shape.path.q.shape[1]
    first = 2.0 * shape.coefficients[1, :n]
    last = first + 6.0 * shape.coefficients[0, :n] * np.diff(shape.path.s)
    return np.min(limits.acceleration[:, None] / np.maximum(np.maximum(np.abs(first), np.abs(last)), _SMALL), axis=0)


def _bent_tool(shape: PathShape, limits: ArmLimits, parameters: FlyParameters, a: int, b: int) -> float:
    """The same of the tool's acceleration between knots a and b. Rotation counts as going with the way, as in ramps."""
    tcp, limited = limits.cartesian, float(shape.path.rules[b, rules.CARTESIAN])
    allowed = tcp.linear_acceleration
    if parameters.curve_turns:
        allowed = min(allowed, tcp.rotational_acceleration / max(shape.turn[a], shape.turn[b], _SMALL))
    bend = float(np.max(shape.bend[a + 1 : b], initial=0.0))
    return limited * allowed / max(bend, _SMALL)


def _ramp(shape: PathShape, limits: ArmLimits) -> np.ndarray:
    """(K,) acceleration along the path that each knot allows."""
    joint = np.min(limits.acceleration[:, None] / np.maximum(np.abs(shape.q1), _SMALL), axis=0)
    limited, tcp = shape.path.rules[:, rules.CARTESIAN], limits.cartesian
    linear = limited * tcp.linear_acceleration / np.maximum(shape.travel, _SMALL)
    return np.minimum(joint, np.minimum(linear, limited * tcp.rotational_acceleration / np.maximum(shape.turn, _SMALL)))
