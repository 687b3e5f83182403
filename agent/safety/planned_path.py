"""What was planned, end to end, in a form that samples can be laid onto."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from agent.motion.trajectory import Trajectory
    from agent.robot.dynamics import Dynamics

#: Speed may be had from so long [s] before or after a place: ramps and blends of the controller are not ours.
AROUND = 0.1
#: Or from a place so many margins before or after it: where a blend of another family begins that passes its point as
#: near. On a circle it begins cot(turn/4) FLY distances before the point, on a parabola 2/sin(turn/2): 4 at 60 degrees.
BLEND = 4.0
#: Damping of the inverse Jacobian [m]: no joint goes farther than the margin over twice this.
DAMPING = 0.05
#: A joint moves something at this distance at least, whether the tool does or not [m].
SHORTEST_LEVER = 0.2
#: Between places that are as near, the one that time would have it at: a second off counts as these metres, or as
#: two margins where that is more, since a blend may be so far nearer to the way in than to the way out that it is on.
DRIFT = 0.01
#: Farther ahead [s] nobody looks for the other side of a turn that was cut: the pace would not be the plan's.
AWAY = 1.0
_EVERY = 10
_STEPS = 8  # of a span along the way


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """P places in order; each is a row of one of the different stretches, so that a cycle is held once.

    rows (P,) leads from places to rows; when (P,) [s] of motion up to a place, without rests. By row: q (S, n);
    tool (S, 3) [m]; reach (S, n), how far each joint goes where the tool goes by the margin, and on the path where a
    blend may turn the tool earlier or later; speed (S, n), the highest around. levers (n,) [m/rad, or 1]: how far a
    joint moves the tool at most. drift [m/s]: see `DRIFT`.
    """

    rows: np.ndarray
    when: np.ndarray
    q: np.ndarray
    tool: np.ndarray
    reach: np.ndarray
    speed: np.ndarray
    levers: np.ndarray
    drift: float = DRIFT

    @classmethod
    def of(cls, chains: Sequence[Trajectory], dynamics: Dynamics, margin: float) -> PlannedPath:
        """The path of `chains`, from stop to stop, for a tool that may be `margin` [m] from it."""
        different = {id(chain): chain for chain in chains}
        first_row = dict(zip(different, np.cumsum([0, *(len(chain.t) for chain in different.values())]), strict=False))
        rows, when, passed = [], [], 0.0
        for chain in chains:
            rows.append(first_row[id(chain)] + np.arange(len(chain.t)))
            when.append(passed + chain.t - chain.t[0])
            passed += chain.duration
        parts = [_along(chain, dynamics, margin) for chain in different.values()]
        q, tool, reach, speed = (np.concatenate(columns) for columns in zip(*(part[:4] for part in parts), strict=True))
        levers = np.max([part[4] for part in parts], axis=0)
        return cls(np.concatenate(rows), np.concatenate(when), q, tool, reach, speed, levers, max(DRIFT, 2 * margin))

    def around(self, place: int, margin: float) -> float:
        """[s] of the plan until its tool has gone `margin` [m] from a place, or `AWAY` at most."""
        last = int(np.searchsorted(self.when, self.when[place] + AWAY, side="right"))
        tool = self.tool[self.rows[place:last]]
        near = np.linalg.norm(tool - tool[0], axis=1) <= margin
        return float(self.when[last - 1 if near.all() else place + int(np.argmin(near))])

    def nearest(self, positions: np.ndarray, since: np.ndarray, until: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """(K,) the place nearest to each of `positions` (K, n) out of those between two moments (K,) [s] of the plan.

        `expected` (K,) [s] decides between places that are as near: where a path comes back on itself.
        """
        first = np.clip(np.searchsorted(self.when, since, side="left"), 0, len(self.when) - 1)
        last = np.clip(np.searchsorted(self.when, until, side="right"), first + 1, len(self.when))
        begin, end = int(first.min()), int(last.max())
        q = self.q[self.rows[begin:end]] * self.levers
        away = np.square(self.drift * (self.when[begin:end] - expected[:, None]))
        for joint, values in enumerate((positions * self.levers).T):
            away += np.square(values[:, None] - q[:, joint])
        places = np.arange(begin, end)
        away[(places < first[:, None]) | (places >= last[:, None])] = np.inf
        return begin + np.argmin(away, axis=1)


def _along(chain: Trajectory, dynamics: Dynamics, margin: float) -> tuple[np.ndarray, ...]:
    """q, tool, reach, speed of a stretch by sample, and its levers."""
    from scipy.ndimage import maximum_filter1d

    some = np.unique(np.append(np.arange(0, len(chain.t), _EVERY), len(chain.t) - 1))
    jacobian = dynamics.tcp_jacobian(chain.q[some])
    turned = np.swapaxes(jacobian, 1, 2)
    inverse = turned @ np.linalg.inv(jacobian @ turned + DAMPING**2 * np.eye(6))
    reach = margin * np.linalg.norm(inverse[:, :, :3], axis=2)
    point = dynamics.tcp_pose(chain.q)[:, :3, 3]
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(point, axis=0), axis=1))))
    nearest = np.minimum((np.arange(len(chain.t)) + _EVERY // 2) // _EVERY, len(some) - 1)
    period = chain.duration / max(1, len(chain.t) - 1)
    width = 1 + 2 * (round(AROUND / period) if period > 0 else 0)
    speed = maximum_filter1d(np.abs(chain.qd), min(width, 2 * len(chain.t) + 1), axis=0, mode="nearest")
    levers = np.maximum(np.linalg.norm(jacobian[:, :3], axis=1).max(axis=0), SHORTEST_LEVER)
    span = BLEND * margin
    speed = np.maximum(speed, _highest(np.abs(chain.qd), way, span))
    turned_by = np.maximum(_highest(chain.q, way, span) - chain.q, chain.q + _highest(-chain.q, way, span))
    return chain.q, point, reach[nearest] + turned_by, speed, levers


def _highest(values: np.ndarray, way: np.ndarray, span: float) -> np.ndarray:
    """(S, n) the highest of values (S, n) no farther along the way (S,) than `span` [m]."""
    from scipy.ndimage import maximum_filter1d

    step = span / _STEPS
    grid = np.append(np.arange(0.0, way[-1], step), way[-1])
    on_grid = np.stack([np.interp(grid, way, column) for column in values.T], axis=1)
    highest = maximum_filter1d(on_grid, 2 * _STEPS + 1, axis=0, mode="nearest")
    return np.maximum(values, highest[np.clip(np.rint(way / step).astype(int), 0, len(grid) - 1)])
