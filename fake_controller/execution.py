"""Runs a program's statements: the controller's own interpolation, the plant in closed loop, settling and stops."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from agent.core import InputError
from agent.motion import (
    Delay,
    Interpolator,
    JointTarget,
    MotionError,
    Move,
    Pdl2Settings,
    Statement,
    Target,
    Termination,
    Trajectory,
)
from drivers.wire.reasons import EndReason
from fake_controller.plant import Plant

_RAMP = 0.2  # s, in which a joint goes astray


class Astray:
    """What is put onto the set-points of n joints; nothing until somebody says so."""

    def __init__(self, joints: int, period: float) -> None:
        self._period = period
        self._path = _Offset(joints)
        self._servo = _Offset(joints)
        self._scale = np.ones(joints)

    def leave_path(self, joint: int, by: float) -> None:
        """The set-points of a joint go off by so much [rad] from now on."""
        self._path.go(joint, by)

    def lose_servo(self, joint: int, by: float) -> None:
        """A joint goes off its set-points by so much [rad] from now on."""
        self._servo.go(joint, by)

    def change_way(self, joint: int, times: float) -> None:
        """A joint makes `times` the way that the program says, from where it starts."""
        self._scale[joint] = times

    def changed(self, position: np.ndarray, velocity: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Set-points (K, n) and their velocities in place of a program's that begins at `start` (n,)."""
        offset, rate = self._path.next(len(position), self._period)
        return start + self._scale * (position - start) + offset, self._scale * velocity + rate

    def followed(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the servos go to in place of set-points (K, n)."""
        offset, rate = self._servo.next(len(position), self._period)
        return position + offset, velocity + rate


class _Offset:
    """From zero to its value in a half cosine."""

    def __init__(self, joints: int) -> None:
        self._value = np.zeros(joints)
        self._passed = 0.0

    def go(self, joint: int, by: float) -> None:
        self._value[joint] = by
        self._passed = 0.0

    def next(self, count: int, period: float) -> tuple[np.ndarray, np.ndarray]:
        """(K, n) the offset at the next `count` samples, and its rate."""
        part = np.minimum((self._passed + period * np.arange(1, count + 1)) / _RAMP, 1.0)
        self._passed = _RAMP * float(part[-1]) if count else self._passed
        rate = np.pi / 2 / _RAMP * np.sin(np.pi * part)
        return np.outer(0.5 - 0.5 * np.cos(np.pi * part), self._value), np.outer(rate, self._value)


MAX_CHAIN = 2000  # moves without a stop in between
MAX_DELAY = 600.0  # s
_SETTLE_LIMIT = 1.0  # s; then the program goes on all the same
_SETTLE_SLICE = 10  # samples
_SHORTEST_STOP = 0.1  # s
_OVERRIDE_RAMP = 0.3  # s
_JOINT_TOLERANCE = {Termination.JNT_FINE: 5e-4, Termination.JNT_COARSE: 2e-3}  # rad
_SAME_START = 1e-9  # rad; starts nearer than this share a plan


@dataclass(frozen=True, eq=False)
class Slice:
    """K consecutive samples (K, n): the set-points, and what was measured while they were followed."""

    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    reference_position: np.ndarray
    reference_velocity: np.ndarray

    def __len__(self) -> int:
        return len(self.position)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """All five, in the order in which every wire has them."""
        return self.position, self.velocity, self.torque, self.reference_position, self.reference_velocity

    def part(self, chosen: slice) -> Slice:
        """Some of them (views, no copies)."""
        return Slice(*(column[chosen] for column in self.columns))


def _end_of(chain: Chain) -> np.ndarray:
    assert chain.trajectory is not None
    return chain.trajectory.q[-1]


class CannotMove(Exception):
    """A chain that the interpolator refuses; `line` of the program, 0 where it has none."""

    def __init__(self, message: str, line: int) -> None:
        super().__init__(message)
        self.line = line


class StopSwitch:
    """Asks a running motion to stop; the first reason counts, None as long as nobody asked.

    `speed` is the override it runs at.
    """

    def __init__(self, speed: float = 1.0) -> None:
        self.speed = speed
        self._lock = threading.Lock()
        self.reason: EndReason | None = None
        self.message = ""

    def request(self, reason: EndReason, message: str) -> None:
        """Ask for a stop."""
        with self._lock:
            if self.reason is None:
                self.message = message
                self.reason = reason


@dataclass(frozen=True, eq=False)
class Chain:
    """From rest to rest: what is planned together. A `hold` [s] instead of a trajectory is a DELAY."""

    trajectory: Trajectory | None
    termination: Termination
    tolerance: float
    hold: float = 0.0


class Planner:
    """Plans a program chain by chain and remembers the last few, so that a repeated cycle is planned once."""

    def __init__(self, interpolator: Interpolator, remembered: int = 8) -> None:
        self._interpolator = interpolator
        self._remembered = remembered
        self._plans: OrderedDict[tuple[object, ...], Trajectory] = OrderedDict()

    def chains(self, statements: Iterable[Statement], start: np.ndarray) -> Iterator[Chain]:
        """The chains of a program that starts at rest at `start` (n,), each planned when it is asked for.

        Raises:
            CannotMove: a move that cannot be carried out.
        """
        moves: list[Move] = []
        for statement in statements:
            if isinstance(statement, Delay):
                if moves:
                    yield (planned := self._plan(moves, start))
                    start, moves = _end_of(planned), []
                yield Chain(None, Termination.NOSETTLE, 0.0, min(statement.seconds, MAX_DELAY))
                continue
            moves.append(statement)
            if not statement.fly or len(moves) == MAX_CHAIN:
                yield (planned := self._plan(moves, start))
                start, moves = _end_of(planned), []
        if moves:
            yield self._plan(moves, start)

    def _plan(self, moves: list[Move], start: np.ndarray) -> Chain:
        key = (tuple(np.round(start / _SAME_START).astype(np.int64)), *(_key(move) for move in moves))
        trajectory = self._plans.get(key)
        if trajectory is None:
            try:
                trajectory = self._interpolator.plan(tuple(moves), start)
            except InputError as error:
                index = error.move if isinstance(error, MotionError) else 0
                raise CannotMove(str(error), moves[index].line) from None
            self._plans[key] = trajectory
            if len(self._plans) > self._remembered:
                self._plans.popitem(last=False)
        self._plans.move_to_end(key)
        settings = Pdl2Settings.of(moves[-1].settings)
        fine = settings.termination is Termination.FINE
        return Chain(trajectory, settings.termination, settings.tolerance_fine if fine else settings.tolerance_coarse)


class Execution:
    """Drives the plant along chains.

    Args:
        plant: the arm.
        forward: (S, n) joint positions to (S, 4, 4) TCP poses, for the Cartesian settling tolerances.
        max_acceleration: (n,) for the stop on the path [rad/s²].
        period: of the set-points [s].
        slice_samples: samples computed between two looks at the stop switch.
    """

    def __init__(
        self,
        plant: Plant,
        forward: Callable[[np.ndarray], np.ndarray],
        max_acceleration: np.ndarray,
        period: float,
        slice_samples: int,
    ) -> None:
        self._plant = plant
        self._forward = forward
        self._max_acceleration = max_acceleration
        self._period = period
        self._slice_samples = slice_samples
        self.astray = Astray(len(max_acceleration), period)
        self._start = np.zeros(len(max_acceleration))

    def run(self, chains: Iterable[Chain], start: np.ndarray, switch: StopSwitch) -> Iterator[Slice]:
        """Samples from rest at set-point `start` (n,) until the arm rests again; `switch` makes that earlier."""
        self._start = reference = start
        for chain in chains:
            if switch.reason is not None:
                return
            if chain.trajectory is None:
                yield from self._hold(reference, round(chain.hold / self._period), switch)
                continue
            position, velocity = self._plant.executed_path(chain.trajectory.q, chain.trajectory.qd)
            speed, given = 1.0, 0  # `given`: the set-point that was given last; the first is the rest before
            while given < len(position) - 1:
                if switch.speed != speed:
                    ratio, speed = switch.speed / speed, switch.speed
                    position, velocity = retimed(
                        position[given:], velocity[given:], ratio, self._max_acceleration, self._period
                    )
                    given = 0
                until = min(given + self._slice_samples, len(position) - 1)
                yield self._follow(position[given + 1 : until + 1], velocity[given + 1 : until + 1])
                given = until
                if switch.reason is not None and given < len(position) - 1:
                    stop = path_stop(position[given:], velocity[given:], self._max_acceleration, self._period)
                    for k in range(0, len(stop[0]), self._slice_samples):
                        yield self._follow(*(part[k : k + self._slice_samples] for part in stop))
                    yield from self._settle(stop[0][-1], Termination.COARSE, chain.tolerance)
                    return
            reference = position[-1]
            yield from self._settle(reference, chain.termination, chain.tolerance)

    def _follow(self, position: np.ndarray, velocity: np.ndarray) -> Slice:
        position, velocity = self.astray.changed(position, velocity, self._start)
        chunks = list(self._plant.run(*self.astray.followed(position, velocity)))
        q, qd, torque = (
            np.concatenate([getattr(c, name) for c in chunks]) for name in ("position", "velocity", "torque")
        )
        return Slice(q, qd, torque, position, velocity)

    def _rest(self, reference: np.ndarray, count: int) -> Slice:
        position = np.repeat(reference[None, :], count, axis=0)
        return self._follow(position, np.zeros_like(position))

    def _hold(self, reference: np.ndarray, count: int, switch: StopSwitch) -> Iterator[Slice]:
        while count > 0 and switch.reason is None:
            yield self._rest(reference, min(count, self._slice_samples))
            count -= self._slice_samples

    def _settle(self, reference: np.ndarray, termination: Termination, tolerance: float) -> Iterator[Slice]:
        if termination is Termination.NOSETTLE:
            return
        goal = self._forward(reference[None, :])[0, :3, 3]
        for _ in range(round(_SETTLE_LIMIT / self._period / _SETTLE_SLICE)):
            part = self._rest(reference, _SETTLE_SLICE)
            yield part
            if termination in _JOINT_TOLERANCE:
                off = np.abs(part.position - reference).max()
                near = off < _JOINT_TOLERANCE[termination]
            else:
                off = np.linalg.norm(self._forward(part.position)[:, :3, 3] - goal, axis=1).max()
                near = off < tolerance
            if near:
                return


def path_stop(
    position: np.ndarray, velocity: np.ndarray, max_acceleration: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Set-points that come to rest on the path of a trajectory.

    The path parameter s runs over the trajectory's own time, with ds/dt = ½ (1 + cos(π t / T)) from one to zero: the
    arm stays on its path and the rate has no step. T is long enough that slowing down, on top of what the path itself
    asks for, takes no joint beyond its acceleration (or beyond what the trajectory had anyway).

    Args:
        position, velocity: (S, n) what would follow; the first row is the last set-point given.
        max_acceleration: (n,).

    Returns:
        position and velocity, both (K, n), the set-points after that one.
    """
    own = np.abs(np.diff(velocity, axis=0)).max(axis=0, initial=0.0) / period
    allowed = 1.01 * np.maximum(max_acceleration, own)
    # Slowing down alone asks for π/(2T) · q̇ at most.
    duration = max(_SHORTEST_STOP, float(np.max(np.pi / 2 * np.abs(velocity[0]) / max_acceleration)))
    while True:
        q, qd = _slowed(position, velocity, duration, period)
        asked = np.abs(np.diff(np.vstack([velocity[:1], qd]), axis=0)).max(axis=0) / period
        if np.all(asked <= allowed) or duration > 4 * period * len(position):
            return q, qd
        duration *= 1.2


def retimed(
    position: np.ndarray, velocity: np.ndarray, ratio: float, max_acceleration: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """The same path at `ratio` times its speed, as after a turn of the override.

    ds/dt goes from one to `ratio` as a half cosine, so that speed has no step, and so slowly that no joint goes beyond
    its acceleration (or beyond what the path asks for anyway), even if the path ends before that.

    Args:
        position, velocity: (S, n); the first row is the last set-point given.
        max_acceleration: (n,).

    Returns:
        position and velocity, both (K, n); the first row stays.
    """
    length = period * (len(position) - 1)
    own = np.abs(np.diff(velocity, axis=0)).max(axis=0, initial=0.0) / period * max(1.0, ratio) ** 2
    allowed = 1.01 * np.maximum(max_acceleration, own)
    ramp = min(_OVERRIDE_RAMP, length)
    while True:
        q, qd = _ramped(position, velocity, ratio, ramp, period)
        if ramp > 10 * length or np.all(np.abs(np.diff(qd, axis=0)).max(axis=0) / period <= allowed):
            return q, qd
        ramp *= 1.2


def _ramped(
    position: np.ndarray, velocity: np.ndarray, ratio: float, ramp: float, period: float
) -> tuple[np.ndarray, np.ndarray]:
    length = period * (len(position) - 1)
    turned = ramp * (1 + ratio) / 2  # path time that the ramp takes
    duration = ramp + max(0.0, length - turned) / ratio
    t = period * np.arange(1, int(np.ceil(duration / period)) + 1)
    on = np.minimum(t, ramp)
    s = on + (ratio - 1) / 2 * (on - ramp / np.pi * np.sin(np.pi * on / ramp)) + ratio * (t - on)
    rate = 1 + (ratio - 1) / 2 * (1 - np.cos(np.pi * on / ramp))
    s[-1] = max(s[-1], length)
    needed = int(np.argmax(s >= length)) + 1
    q, qd = _along(position, velocity, s[:needed] / period, rate[:needed], period)
    return np.vstack([position[:1], q]), np.vstack([velocity[:1], qd])


def _slowed(
    position: np.ndarray, velocity: np.ndarray, duration: float, period: float
) -> tuple[np.ndarray, np.ndarray]:
    t = np.minimum(period * np.arange(1, int(np.ceil(duration / period)) + 1), duration)
    s = 0.5 * (t + duration / np.pi * np.sin(np.pi * t / duration)) / period
    rate = 0.5 * (1 + np.cos(np.pi * t / duration))
    return _along(position, velocity, s, rate, period)


def _along(
    position: np.ndarray, velocity: np.ndarray, s: np.ndarray, rate: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """Set-points at path parameters s (K,), in samples, that pass at `rate` (K,)."""
    last = len(position) - 1
    beyond = s >= last
    index = np.minimum(s.astype(int), max(last - 1, 0))
    after = np.minimum(index + 1, last)
    u = np.clip(s - index, 0.0, 1.0)[:, None]
    # Cubic Hermite between set-points, so that velocity stays the derivative of position.
    p0, p1 = position[index], position[after]
    v0, v1 = velocity[index] * period, velocity[after] * period
    q = p0 + u * (v0 + u * (3 * (p1 - p0) - 2 * v0 - v1 + u * (2 * (p0 - p1) + v0 + v1)))
    dq = v0 + u * (2 * (3 * (p1 - p0) - 2 * v0 - v1) + u * 3 * (2 * (p0 - p1) + v0 + v1))
    q[beyond], dq[beyond] = position[-1], 0.0
    return q, dq / period * rate[:, None]


def _key(move: Move) -> tuple[object, ...]:
    return move.type, move.settings, move.fly, _target_key(move.target), _target_key(move.via)


def _target_key(target: Target | None) -> tuple[object, ...]:
    if target is None:
        return ()
    if isinstance(target, JointTarget):
        return "joint", np.asarray(target.position).tobytes()
    return "pose", np.asarray(target.pose).tobytes(), target.configuration
