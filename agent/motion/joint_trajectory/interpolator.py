"""How an arm with a JointTrajectoryController moves: through the points of a trajectory, which is the plan itself.

The controller knows no lines of the tool. What a program says of the tool is planned here by the law of `fly`, sampled
20 times a second with velocity and acceleration, and slowed down until the quintics between the points keep the limits
of every joint: the controller checks none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from agent.motion.fly.interpolator import FlyInterpolator
from agent.motion.interpolator import BindingLimit, LazyTrajectory, MotionError, Trajectory
from agent.motion.joint_trajectory.settings import PaceSettings, PointSettings
from agent.motion.path_settings import FlyTrajectory, FlyType, PathSettings
from agent.motion.program import Delay, JointTarget, MotionSettings, Move, MoveType, Statement
from agent.robot import Dynamics, RobotDescription, Tool
from drivers.errors import RefusedError
from drivers.joint_trajectory import LONGEST, JointSpline, parts, rest_to_rest

#: Points of a trajectory a second.
POINTS = 20
#: Blends that keep within their distance of a via-point.
BLENDS = {"fly_type": FlyType.FLY_CART, "fly_trajectory": FlyTrajectory.FLY_TOL}
_PERIOD = 0.005  # s, of the plan that points are taken from
_ROUNDING = 1e-6  # of limits: points in a text have nine decimals


class JointTrajectoryLaw:
    """Plans programs at the controller's period (`agent.motion.Interpolator`).

    `tool` is the TCP of moves that name none; `period` [s].
    """

    def __init__(self, robot: RobotDescription, tool: Tool | None = None, period: float = 0.002):
        self.robot, self.period = robot, period
        self._fly = FlyInterpolator(robot, tool, _PERIOD)
        self._dynamics = Dynamics(robot, tool)

    def plan(self, statements: Sequence[Statement], start: np.ndarray) -> Trajectory:
        """Set-points of the program from rest at `start` (n,) [rad] to rest.

        Raises:
            MotionError: out of reach, beyond a limit of a joint, or too long without a stop.
        """
        q = np.asarray(start, dtype=float)
        rows = [_standing(q, 1)]
        moves, binding, began = [np.zeros(1, dtype=int)], [], 0.0
        pending: list[Move] = []
        for number, statement in enumerate(statements):
            if isinstance(statement, Delay):
                rows.append(_standing(q, max(0, round(statement.seconds / self.period))))
                moves.append(np.full(rows[-1].shape[1], number))
            else:
                pending.append(statement)
            if pending and not (pending[-1].fly and number + 1 < len(statements)):
                first = number + 1 - len(pending)
                for part in parted(pending, q):
                    spline, move_at, limits = self.spline(part, q, first)
                    count = np.ceil(spline.duration / self.period - 1e-6)
                    t = np.minimum(self.period * np.arange(1, count + 1), spline.duration)
                    rows.append(np.array(spline.at(t)))
                    moves.append(first + move_at(t))
                    binding.append((began, limits))
                    q = spline.q[-1]
                pending = []
            began = self.period * (sum(part.shape[1] for part in rows) - 1)
        q, qd, qdd = np.concatenate(rows, axis=1)
        late = {
            "tcp": lambda: self._dynamics.tcp_pose(q),
            "path_speed": lambda: np.linalg.norm(self._dynamics.tcp_jacobian(q)[:, :3] @ qd[..., None], axis=(1, 2)),
            "binding": lambda: tuple(
                BindingLimit(stretch.limit, began + stretch.start, began + stretch.end)
                for began, limits in binding
                for stretch in limits()
            ),
        }
        return LazyTrajectory(late, t=np.arange(len(q)) * self.period, q=q, qd=qd, qdd=qdd, move=np.concatenate(moves))

    def spline(
        self, moves: Sequence[Move], start: np.ndarray, first: int = 0
    ) -> tuple[JointSpline, Callable[[np.ndarray], np.ndarray], Callable[[], Sequence[BindingLimit]]]:
        """The points of moves from rest at `start` (n,) to rest; which of the moves a time (S,) [s] belongs to, and the
        limits that slow them down. `first` is the index of the first move in its program, for messages.

        Raises:
            MotionError: as in `plan`.
        """
        if all(isinstance(move.settings, PointSettings) for move in moves):
            spline = _of_points(moves, start)
            self._check(spline, first)
            return spline, lambda t: np.searchsorted(spline.t[1:-1], t, side="left"), tuple
        if (end := joint_move_to(moves)) is not None:
            spline = rest_to_rest(start, end, *self.pace(moves[0]))
            self._check(spline, first)
            return spline, lambda t: np.zeros(len(t), dtype=int), tuple
        plan = self._fly.plan([_with_path(move) for move in moves], start)
        count = max(1, int(np.ceil(plan.duration * POINTS - 1e-9)))
        at = np.unique(np.round(np.linspace(0, len(plan.t) - 1, count + 1)).astype(int))
        spline = JointSpline(plan.t[at], plan.q[at], plan.qd[at], plan.qdd[at])
        spline.qd[[0, -1]] = spline.qdd[[0, -1]] = 0.0
        factor = self._slower(spline)
        spline = spline.stretched(factor)
        self._check(spline, first)
        index = lambda t: plan.move[np.minimum(np.rint(t / (factor * _PERIOD)).astype(int), len(plan.move) - 1)]  # noqa: E731
        return spline, index, lambda: plan.binding

    def pace(self, move: Move) -> tuple[np.ndarray, np.ndarray]:
        """Limits (n,) of velocity and acceleration of a joint move."""
        part = move.settings.speed_override
        return _pace(move.settings) or (part * self.robot.max_velocity, part * self.robot.max_acceleration)

    def _slower(self, spline: JointSpline) -> float:
        """The factor of time with which the spline keeps the joints' limits."""
        _, qd, qdd = spline.at(np.arange(0.0, spline.duration, _PERIOD))
        speed = np.max(np.abs(qd) / self.robot.max_velocity, initial=0.0)
        acceleration = np.max(np.abs(qdd) / self.robot.max_acceleration, initial=0.0)
        return float(max(1.0, speed, np.sqrt(acceleration))) * (1.0 + _ROUNDING)

    def _check(self, spline: JointSpline, first: int) -> None:
        """Raises:
        MotionError: a limit of a joint is broken between the points, or the motion is too long.
        """
        t = np.append(np.arange(0.0, spline.duration, _PERIOD), spline.duration)
        q, qd, qdd = spline.at(t)
        lower, upper = self.robot.position_limits
        span = np.minimum(upper - lower, 2 * np.pi)
        excesses = {
            "position": np.maximum(q - upper, lower - q).max(axis=0) / span - _ROUNDING,
            "speed": np.abs(qd).max(axis=0) / self.robot.max_velocity - 1.0 - 3 * _ROUNDING,
            "acceleration": np.abs(qdd).max(axis=0) / self.robot.max_acceleration - 1.0 - 1e-4,
        }
        for what, excess in excesses.items():
            joint = int(np.argmax(excess))
            if not excess[joint] <= 0.0:
                name = self.robot.joint_names[joint]
                text = f"statement {first + 1}: {name} would break its {what} limit; move more slowly, or elsewhere"
                raise MotionError(text, first, f"{name} {what}", excess[joint])
        if spline.duration > LONGEST + 1e-6:
            text = (
                f"statement {first + 1}: {spline.duration:.1f} s of motion without a stop; {LONGEST:g} s are allowed, "
                "as the arm goes on to the end when nobody is there any more: move faster, or a shorter way"
            )
            raise MotionError(text, first, "duration", spline.duration / LONGEST - 1.0)


def _standing(q: np.ndarray, count: int) -> np.ndarray:
    """Position, velocity and acceleration (3, count, n) of an arm that stands at q (n,)."""
    return np.repeat([[q], [0.0 * q], [0.0 * q]], count, axis=1)


def joint_move_to(moves: Sequence[Move]) -> np.ndarray | None:
    """Where (n,) moves from stop to stop end that are a joint move, which knows no time; None of others."""
    move, target = moves[0], moves[0].target
    single = len(moves) == 1 and move.type is MoveType.JOINT and not isinstance(move.settings, PointSettings)
    return target.position if single and isinstance(target, JointTarget) else None


def _pace(settings: MotionSettings) -> tuple[np.ndarray, np.ndarray] | None:
    if not isinstance(settings, PaceSettings):
        return None
    return settings.speed_override * np.array(settings.velocity), settings.speed_override * np.array(
        settings.acceleration
    )


def parted(moves: Sequence[Move], start: np.ndarray) -> list[Sequence[Move]]:
    """Moves from stop to stop, from rest at `start` (n,), cut where a controller is given another goal on the way.

    Raises:
        MotionError: a move would take too many.
    """
    end, pace = joint_move_to(moves), _pace(moves[0].settings)
    if end is None or pace is None:
        return [moves]
    try:
        ends = parts(start, end, *pace)
    except RefusedError as error:
        raise MotionError(f"line {moves[0].line}: {error}", 0, "duration", 1.0) from None
    return [[replace(moves[0], target=JointTarget(each))] for each in ends]


def _of_points(moves: Sequence[Move], start: np.ndarray) -> JointSpline:
    seconds, rows = [0.0], [np.array([start, np.zeros_like(start), np.zeros_like(start)])]
    for move in moves:
        settings, target = move.settings, move.target
        assert isinstance(settings, PointSettings)
        assert isinstance(target, JointTarget)
        part = settings.speed_override
        seconds.append(settings.seconds / part)
        rows.append(
            np.array([target.position, part * np.array(settings.velocity), part**2 * np.array(settings.acceleration)])
        )
    q, qd, qdd = np.array(rows).transpose(1, 0, 2)
    return JointSpline(np.cumsum(seconds), q, qd, qdd)


def _with_path(move: Move) -> Move:
    """The move with a blend that keeps within its distance."""
    if isinstance(move.settings, PathSettings):
        return move
    return replace(move, settings=PathSettings.of(move.settings).changed(**BLENDS))
