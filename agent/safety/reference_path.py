"""The path that the guard holds a motion to: the set-points of a whole program, for matching samples to them."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.distance import cdist

if TYPE_CHECKING:
    from agent.motion import Trajectory
    from agent.robot import Dynamics

#: The planned speed within this time [s] of a point counts: the controller has other ramps and blends.
AROUND = 0.1
#: So does the speed within this many margins of it: there a blend of another family begins that passes its point as
#: near. On a circle it begins cot(turn/4) FLY distances before the point, on a parabola 2/sin(turn/2): 4 at 60 degrees.
BLEND = 4.0
#: Damping of the inverse Jacobian [m]: no joint goes farther than the margin over twice this.
DAMPING = 0.05
#: A joint moves something at this distance at least, whether the tool does or not [m].
SHORTEST_LEVER = 0.2
_EVERY = 10
_STEPS = 8  # of a span along the way


@dataclass(frozen=True, eq=False)
class ReferencePath:
    """P points of the path in order. Each is a row of one of the different stretches, so that a cycle is stored once.

    rows (P,) and plan_time (P,): row of each point, and motion time up to it, without pauses [s].
    q (S, n) and tool (S, 3) [m]: joint positions and tool position per row.
    reach (S, n): joint motion if the tool leaves the path by the margin, or a blend turns the tool earlier or later.
    speed (S, n): highest speed around the row.
    turning (S, n): speed at which each joint alone would move something as fast as the tool moves around the row.
    slowest (S,): lowest speed around the row of the joint that is fastest, as a part of its limit.
    stops: the points at which the plan stands, in order.
    levers (n,) and step: largest tool motion per joint motion [m/rad, or 1], largest time between points [s].
    """

    rows: np.ndarray
    plan_time: np.ndarray
    q: np.ndarray
    tool: np.ndarray
    reach: np.ndarray
    speed: np.ndarray
    turning: np.ndarray
    slowest: np.ndarray
    stops: np.ndarray
    levers: np.ndarray
    step: float

    @classmethod
    def of(cls, chains: Sequence[Trajectory], dynamics: Dynamics, margin: float, limits: np.ndarray) -> ReferencePath:
        """The path of `chains`, from stop to stop, for a tool that may be `margin` [m] away from it.

        `limits` (n,) are the speed limits of the joints.
        """
        different = {id(chain): chain for chain in chains}
        first_row = dict(zip(different, np.cumsum([0, *(len(chain.t) for chain in different.values())]), strict=False))
        rows, plan_times, passed = [], [], 0.0
        for chain in chains:
            rows.append(first_row[id(chain)] + np.arange(len(chain.t)))
            plan_times.append(passed + chain.t - chain.t[0])
            passed += chain.duration
        parts = [_sample_stretch(chain, dynamics, margin, limits) for chain in different.values()]
        q, tool, reach, speed, pace, slowest = (
            np.concatenate(columns) for columns in zip(*(part[:6] for part in parts), strict=True)
        )
        levers = np.max([part[6] for part in parts], axis=0)
        ends = np.cumsum([len(chain.t) for chain in chains])
        stops = np.unique([0, *(ends - 1), *ends[:-1]])
        plan_time = np.concatenate(plan_times)
        step = float(np.max(np.diff(plan_time), initial=0.0))
        return cls(np.concatenate(rows), plan_time, q, tool, reach, speed, pace / levers, slowest, stops, levers, step)

    def moving(self, slowest: np.ndarray) -> np.ndarray:
        """(P,) motion time up to each point [s] in which a joint is planned to be faster than `slowest` (n,)."""
        lasts = np.diff(self.plan_time, prepend=0.0)
        steps = np.abs(np.diff(self.q[self.rows], axis=0, prepend=self.q[self.rows[:1]]))
        faster: np.ndarray = ~(steps <= slowest * lasts[:, None])
        return np.cumsum(lasts * faster.any(axis=1))

    def index_at(self, time: Any) -> Any:
        """Index, in the shape of `time`, of the last point that is no later than a time [s] of the plan."""
        return np.clip(np.searchsorted(self.plan_time, time, side="right") - 1, 0, len(self.plan_time) - 1)

    def match_samples(
        self,
        fits: np.ndarray,
        reached: np.ndarray,
        first: int,
        passed: np.ndarray,
        ahead: np.ndarray,
        gap: float,
        within: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Match samples, one after the other, to the W points from `first` on that each of them `fits` (K, W).

        Each sample goes `onward` by its `ahead` [s] from the points that the one before `reached` (W,). If more than
        `gap` [s] has `passed`, only `runs_near` its pace count. Returns the first and last point of each sample, up to
        one that fits nowhere, and the points (W,) that the last sample reached, or that the misfit could have reached.
        """
        firsts, lasts = np.zeros((2, len(fits)), dtype=int)
        times: list[float] = self.plan_time[first : first + len(reached)].tolist()
        begin, end = _ends(fits)
        one_run = fits.sum(axis=1) == end - begin
        (low,), (high,) = (edge.tolist() for edge in _ends(reached[None]))
        whole = bool(reached[low:high].all())
        for k in range(len(fits)):
            if whole and one_run[k]:  # nearly always; then the edges say everything
                beyond = bisect.bisect_right(times, times[high - 1] + ahead[k] + self.step)
                window = slice(max(low, int(begin[k])), min(beyond, int(end[k])))
                if not window.start < window.stop:
                    return firsts[:k], lasts[:k], _run(low, beyond, len(reached))
                low, high = window.start, window.stop
            else:
                reached = _run(low, high, len(reached)) if whole else reached
                onward = self.onward(reached, first, ahead[k])
                reached = onward & fits[k]
                if not reached.any():
                    return firsts[:k], lasts[:k], onward
                if passed[k] > gap:  # in this cycle or in a later one: where it would be at its pace
                    reached = self.runs_near(reached, first, passed[k] + times[high - 1], within)
                (low,), (high,) = (edge.tolist() for edge in _ends(reached[None]))
                whole = bool(reached[low:high].all())
            firsts[k], lasts[k] = first + low, first + high - 1
        return firsts, lasts, _run(low, high, len(reached)) if whole else reached

    def onward(self, reached: np.ndarray, first: int, ahead: float) -> np.ndarray:
        """Mask (W,), from point `first` on, of points up to a step and `ahead` [s] after a `reached` (W,) point."""
        times = self.plan_time[first : first + len(reached)]
        latest = np.maximum.accumulate(np.where(reached, times, -np.inf))
        return times <= latest + ahead + self.step

    def runs_near(self, reached: np.ndarray, first: int, expected: float, within: float) -> np.ndarray:
        """Mask (W,), from point `first` on, of the run of `reached` (W,) points that is nearest to `expected` [s].

        Runs that are at most `within` [s] farther away are included.
        """
        indices = np.flatnonzero(reached)
        runs = np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)
        distances = [float(np.min(np.abs(self.plan_time[first + run] - expected))) for run in runs]
        chosen = np.zeros_like(reached)
        for run, distance in zip(runs, distances, strict=True):
            chosen[run] = distance <= min(distances) + within
        return chosen

    def distance(self, tool: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Distances (K, W) [m] from tool positions (K, 3) to those of rows (W,)."""
        return cdist(tool, self.tool[rows])

    def distances(self, position: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Distances (W,) [m] from a joint position (n,) to each of the points, all joints together."""
        return np.linalg.norm((self.q[self.rows[points]] - position) * self.levers, axis=1)


def _ends(masks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index (K,) of the first true value of each of the masks (K, W), and index (K,) one past the last."""
    return masks.argmax(axis=1), masks.shape[1] - masks[:, ::-1].argmax(axis=1)


def _run(low: int, high: int, count: int) -> np.ndarray:
    run = np.zeros(count, dtype=bool)
    run[low:high] = True
    return run


def _sample_stretch(chain: Trajectory, dynamics: Dynamics, margin: float, limits: np.ndarray) -> tuple[np.ndarray, ...]:
    """q, tool, reach, speed, highest speed of the tool around and slowest by sample of a stretch, and its levers."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    sampled = np.unique(np.append(np.arange(0, len(chain.t), _EVERY), len(chain.t) - 1))
    jacobian = dynamics.tcp_jacobian(chain.q[sampled])
    turned = np.swapaxes(jacobian, 1, 2)
    inverse = turned @ np.linalg.inv(jacobian @ turned + DAMPING**2 * np.eye(6))
    reach = margin * np.linalg.norm(inverse[:, :, :3], axis=2)
    point = dynamics.tcp_pose(chain.q)[:, :3, 3]
    travelled = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(point, axis=0), axis=1))))
    nearest = np.minimum((np.arange(len(chain.t)) + _EVERY // 2) // _EVERY, len(sampled) - 1)
    period = chain.duration / max(1, len(chain.t) - 1)
    width = 1 + 2 * (round(AROUND / period) if period > 0 else 0)
    speed = maximum_filter1d(np.abs(chain.qd), min(width, 2 * len(chain.t) + 1), axis=0, mode="nearest")
    levers = np.maximum(np.linalg.norm(jacobian[:, :3], axis=1).max(axis=0), SHORTEST_LEVER)
    span = BLEND * margin
    speed = np.maximum(speed, _highest(np.abs(chain.qd), travelled, span))
    turned_by = np.maximum(_highest(chain.q, travelled, span) - chain.q, chain.q + _highest(-chain.q, travelled, span))
    pace = _highest(np.gradient(travelled, period)[:, None], travelled, span) if period > 0 else np.zeros((1, 1))
    fastest = np.max(np.abs(chain.qd) / limits, axis=1)
    slowest = minimum_filter1d(fastest, min(width, 2 * len(chain.t) + 1), mode="nearest")
    return chain.q, point, reach[nearest] + turned_by, speed, pace, slowest, levers


def _highest(values: np.ndarray, travelled: np.ndarray, span: float) -> np.ndarray:
    """Highest of values (S, n) within `span` [m] along the path (S,)."""
    from scipy.ndimage import maximum_filter1d

    step = span / _STEPS
    grid = np.append(np.arange(0.0, travelled[-1], step), travelled[-1])
    on_grid = np.stack([np.interp(grid, travelled, column) for column in values.T], axis=1)
    highest = maximum_filter1d(on_grid, 2 * _STEPS + 1, axis=0, mode="nearest")
    return np.maximum(values, highest[np.clip(np.rint(travelled / step).astype(int), 0, len(grid) - 1)])
