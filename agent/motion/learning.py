"""A controller's interpolation law from its set-points: its blends, its ramps, and their parameters.

The path comes first, regardless of speed: the blend whose path lies nearest to the recorded path. Then come the ramps
that pass the same points at the same times. Polynomial blends go with ramps averaged over a window, as in
`FlyParameters()`. Parabolas and circles go with one speed for each move and corner, as in most numerical controls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from agent.motion.fly.fly_parameters import FlyParameters
from agent.motion.fly.interpolator import FlyInterpolator
from agent.motion.interpolator import MotionError
from agent.motion.path_settings import FlyTrajectory, FlyType, PathSettings
from agent.motion.program import Move
from agent.robot import RobotDescription, kinematics_for

#: Parts of the travel at which motions are compared. Both ends are left out: set-points hardly move there.
_PARTS = np.linspace(0.002, 0.998, 250)
#: Part of the path before and after a point that is searched for its counterpart, and the grid of that search.
_AROUND, _FINE = 0.03, np.linspace(0.0, 1.0, 1001)
#: A family replaces a simpler one if its error is below this part of the simpler one's.
_BETTER = 0.9
#: A simplex ends when the cost changes by less than this part, or after this number of plans.
_ENOUGH, _PLANS = 1e-3, 40
#: Widths of simplices, in parts of what is unknown: of a family on trial, and one after the other of the best one. In a
#: valley, as of ramps that are later and stronger at once, a simplex shrinks before it is at the bottom.
_TRIAL, _FINER = 0.15, (0.05, 0.05, 0.05, 0.02, 0.02)
#: [m/rad] A move that travels at all is measured by its travel alone.
_NO_LEVER = 1e-3


@dataclass(frozen=True, eq=False)
class RecordedMove:
    """Moves from one standstill to the next, with the recorded times (S,) [s] and set-points (S, n)."""

    moves: tuple[Move, ...]
    t: np.ndarray
    q: np.ndarray


@dataclass(frozen=True)
class Errors:
    """Errors of a law on stretches.

    `path` [mm] is the tool's largest distance from the planned path. `time` [%] is the largest difference of the times
    at which the same point is passed, relative to the stretch's duration.
    """

    path: float
    time: float


class Learner:
    """Compares laws with stretches of one robot; `period` [s] of its set-points."""

    def __init__(self, robot: RobotDescription, stretches: Sequence[RecordedMove], period: float):
        self._robot, self._period = robot, period
        self._forward = kinematics_for(robot).forward
        self._all = [(stretch, _JointPath.of(stretch.t, stretch.q)) for stretch in stretches]
        # A lone move from stop to stop adds nothing where others fly; it still counts in the errors.
        self._taught = [pair for pair in self._all if any(move.fly for move in pair[0].moves)] or self._all

    def errors(self, parameters: FlyParameters) -> Errors:
        """Errors of a law.

        Raises:
            MotionError: it cannot run one of the stretches.
        """
        errors = []
        for recorded, planned in self._pairs(parameters, self._all):
            distances = self._distances(recorded, planned, lambda q: self._forward(q)[:, :3, 3])
            duration = float(recorded.t[-1] - recorded.t[0])
            errors.append((1e3 * distances.max(), 100.0 * np.max(np.abs(_late(recorded, planned))) / duration))
        path, time = np.max(errors, axis=0)
        return Errors(float(path), float(time))

    def _off_path(self, parameters: FlyParameters) -> float:
        """Root mean square distance from the planned path, in joints [rad]: of the tool's turn too."""
        distances = [self._distances(*pair, lambda q: q) for pair in self._pairs(parameters, self._taught)]
        return float(np.sqrt(np.mean(np.square(distances))))

    def _off_time(self, parameters: FlyParameters) -> float:
        """Root mean square difference [s] of the times at which the same point is passed."""
        late = [_late(*pair) for pair in self._pairs(parameters, self._taught)]
        return float(np.sqrt(np.mean(np.square(late))))

    def _pairs(
        self, parameters: FlyParameters, stretches: Sequence[tuple[RecordedMove, _JointPath]]
    ) -> Iterator[tuple[_JointPath, _JointPath]]:
        interpolator = FlyInterpolator(self._robot, period=self._period, parameters=parameters)
        for stretch, recorded in stretches:
            planned = interpolator.plan(stretch.moves, stretch.q[0])
            yield recorded, _JointPath.of(planned.t, planned.q)

    def _distances(
        self, recorded: _JointPath, planned: _JointPath, points_of: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Distance (K,) of recorded points from the planned path."""
        q = recorded.joints(_PARTS)
        # Samples are dense at a corner where the arm stops, and include its tip.
        parts = np.union1d(_FINE, planned.part)
        # The counterpart of a point is searched near the same part of the travel.
        return _nearest(
            points_of(planned.joints(parts)), points_of(q), np.abs(parts[None] - _PARTS[:, None]) <= _AROUND
        )

    def learn(self, progress: Callable[[str], None] = lambda text: None) -> FlyParameters:
        """The law that is nearest to the stretches.

        Raises:
            MotionError: no law can run them.
        """
        progress("path: blends")
        path = self._path()
        progress("time: ramps")
        return self._time(path)

    def _path(self) -> FlyParameters:
        flying = [PathSettings.of(move.settings) for stretch, _ in self._taught for move in stretch.moves if move.fly]
        if not flying:
            return FlyParameters()
        free = []
        if any(settings.fly_trajectory is FlyTrajectory.FLY_AUTO for settings in flying):
            free.append(("auto_tightness", 0.0, 1.0))
        if any(settings.fly_type is FlyType.FLY_NORM for settings in flying):
            free.append(("norm_acceleration", 0.3, 20.0))
        # A parabola or a circle touches both moves where it takes equal parts of the tool's travel.
        curves = [
            FlyParameters(blend=blend, blend_turn="slerp", turn_lever=_NO_LEVER) for blend in ("parabola", "circle")
        ]
        families = [(FlyParameters(), [("blend_shape", 0.0, 1.0), *free]), *((curve, free) for curve in curves)]
        return self._best(families, self._off_path)

    def _time(self, path: FlyParameters) -> FlyParameters:
        shares = [("acceleration", 0.2, 1.0), ("curve_share", 0.1, 1.0)]
        if path.blend == "polynomial":
            return self._best([(path, [*shares, ("ramp", 0.1, 6.0), ("stress_floor", 0.05, 1.0)])], self._off_time)
        blocks = replace(path, ramps="blocks", acceleration=0.95, curve_share=0.9)
        families = [(replace(blocks, rise=0.0), shares), (blocks, [*shares, ("rise", 0.0, 0.6)])]
        return self._best(families, self._off_time)

    def _best(
        self,
        families: Iterable[tuple[FlyParameters, list[tuple[str, float, float]]]],
        cost: Callable[[FlyParameters], float],
    ) -> FlyParameters:
        """The family of the lowest cost; of two that are about as good, the earlier one."""
        best, least, best_free = None, np.inf, []
        refused: MotionError | None = None
        for start, free in families:
            try:
                fitted, trial_cost = _fitted(start, free, cost, _TRIAL)
            except MotionError as error:
                refused = error
                continue
            if best is None or trial_cost < _BETTER * least:
                best, least, best_free = fitted, trial_cost, free
        if best is None:
            assert refused is not None
            raise refused
        for width in _FINER:
            best, _ = _fitted(best, best_free, cost, width)
        return best


def _fitted(
    start: FlyParameters,
    free: list[tuple[str, float, float]],
    cost: Callable[[FlyParameters], float],
    width: float,
) -> tuple[FlyParameters, float]:
    """The best law that a simplex `width` wide finds from `start` on, and its cost.

    Raises:
        MotionError: `start` cannot run the stretches.
    """
    from scipy.optimize import minimize

    first = cost(start)
    if not free:
        return start, first
    names, low, high = [name for name, _, _ in free], *np.array([bounds for _, *bounds in free]).T

    def law(x: np.ndarray) -> FlyParameters:
        return replace(start, **dict(zip(names, (low + np.clip(x, 0, 1) * (high - low)).tolist(), strict=True)))

    def value(x: np.ndarray) -> float:
        try:
            return cost(law(x))
        except MotionError:
            return 10.0 * first

    at = (np.array([getattr(start, name) for name in names]) - low) / (high - low)
    # Points away from a bound that the start may lie on.
    simplex = np.vstack([at, at + np.diag(np.where(at > 0.5, -width, width))])
    options = {"initial_simplex": simplex, "maxfev": _PLANS, "xatol": _ENOUGH, "fatol": _ENOUGH * first}
    minimum = minimize(value, at, method="Nelder-Mead", bounds=[(0.0, 1.0)] * len(at), options=options)
    return law(minimum.x), float(minimum.fun)


@dataclass(frozen=True, eq=False)
class _JointPath:
    """Times (S,) and joints (S, n) by the part (S,) of the joint travel that is done."""

    t: np.ndarray
    q: np.ndarray
    part: np.ndarray

    @classmethod
    def of(cls, t: np.ndarray, q: np.ndarray) -> _JointPath:
        travelled = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))))
        return cls(t, q, travelled / max(travelled[-1], 1e-12))

    def joints(self, part: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(part, self.part, column) for column in self.q.T], axis=1)

    def times(self, part: np.ndarray) -> np.ndarray:
        return np.interp(part, self.part, self.t)


def _late(recorded: _JointPath, planned: _JointPath) -> np.ndarray:
    """Delay (K,) [s] of the planned motion at the same points, counted from the first of them."""
    late = planned.times(_PARTS) - recorded.times(_PARTS)
    return late - late[0]


def _nearest(path: np.ndarray, points: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """(K,) distance of points (K, d) from the polyline path (P, d), of the corners that are allowed (K, P)."""
    start, step = path[:-1], np.diff(path, axis=0)
    size = np.maximum(np.einsum("pd,pd->p", step, step), 1e-24)
    along = np.clip((points @ step.T - np.einsum("pd,pd->p", start, step)) / size, 0.0, 1.0)
    squares = (
        np.einsum("kd,kd->k", points, points)[:, None]
        - 2.0 * points @ start.T
        + np.einsum("pd,pd->p", start, start)
        - 2.0 * along * (points @ step.T - np.einsum("pd,pd->p", start, step))
        + along**2 * size
    )
    squares[~allowed[:, :-1]] = np.inf
    best = np.argmin(squares, axis=1)
    rows = np.arange(len(points))
    foot = start[best] + along[rows, best][:, None] * step[best]
    return np.linalg.norm(points - foot, axis=1)
