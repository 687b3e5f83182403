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
    MotionError,
    Move,
    Pdl2Settings,
    Statement,
    Termination,
    Trajectory,
    way_key,
)
from drivers.wire.reasons import EndReason
from fake_controller.faults import Fault
from fake_controller.plant import Plant

MAX_CHAIN = 2000  # moves without a stop in between
MAX_DELAY = 600.0  # s
_ASTRAY_RAMP = 0.2  # s, in which a joint goes astray
_SETTLE_LIMIT = 1.0  # s; then the program continues all the same
_SETTLE_SLICE = 10  # samples
_SHORTEST_STOP = 0.1  # s
_OVERRIDE_RAMP = 0.3  # s
_JOINT_TOLERANCE = {Termination.JNT_FINE: 5e-4, Termination.JNT_COARSE: 2e-3}  # rad
_SAME_START = 1e-9  # rad; starts nearer than this share a plan


class Astray:
    """Changes that faults make to the set-points of n joints."""

    def __init__(self, joints: int, period: float) -> None:
        self._path, self._servo = _Offset(joints, period), _Offset(joints, period)
        self._scale = np.ones(joints)

    def apply_fault(self, fault: Fault) -> None:
        """From now on a joint leaves its path, its servo, or its way; other faults change nothing here."""
        match fault.name:
            case "off_path":
                self._path.go(fault.joint - 1, fault.amount)
            case "servo_error":
                self._servo.go(fault.joint - 1, fault.amount)
            case "other_motion":
                self._scale[fault.joint - 1] = fault.amount

    def changed(self, position: np.ndarray, velocity: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Set-points (K, n) and their velocities that replace those of a program that begins at `start` (n,)."""
        offset, rate = self._path.next(len(position))
        return start + self._scale * (position - start) + offset, self._scale * velocity + rate

    def followed(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Targets of the servos that replace set-points (K, n)."""
        offset, rate = self._servo.next(len(position))
        return position + offset, velocity + rate


class _Offset:
    """From zero to its value in a half cosine."""

    def __init__(self, joints: int, period: float) -> None:
        self._value = np.zeros(joints)
        self._period, self._passed = period, 0.0

    def go(self, joint: int, by: float) -> None:
        self._value[joint] = by
        self._passed = 0.0

    def next(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """(K, n) the offset at the next `count` samples, and its rate."""
        part = np.minimum((self._passed + self._period * np.arange(1, count + 1)) / _ASTRAY_RAMP, 1.0)
        self._passed = _ASTRAY_RAMP * float(part[-1]) if count else self._passed
        rate = np.where(part < 1.0, np.pi / 2 / _ASTRAY_RAMP * np.sin(np.pi * part), 0.0)  # exactly, in the end
        return np.outer(0.5 - 0.5 * np.cos(np.pi * part), self._value), np.outer(rate, self._value)


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


def follow(plant: Plant, astray: Astray, position: np.ndarray, velocity: np.ndarray, start: np.ndarray) -> Slice:
    """What is measured while the plant follows set-points (K, n) of a program that begins at `start` (n,)."""
    position, velocity = astray.changed(position, velocity, start)
    chunks = list(plant.run(*astray.followed(position, velocity)))
    q, qd, torque = (np.concatenate([getattr(c, name) for c in chunks]) for name in ("position", "velocity", "torque"))
    return Slice(q, qd, torque, position, velocity)


class CannotMove(Exception):
    """A chain that the interpolator refuses; `line` of the program, 0 where it has none."""

    def __init__(self, message: str, line: int) -> None:
        super().__init__(message)
        self.line = line


class StopSwitch:
    """Asks a running motion to stop; the first reason counts. `speed` is the override it runs at."""

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
    """Motion from standstill to standstill, planned together. A `hold` [s] instead of a trajectory is a DELAY."""

    trajectory: Trajectory | None
    termination: Termination
    tolerance: float
    hold: float = 0.0


class Planner:
    """Plans a program chain by chain and remembers the last few, so that a repeated cycle is planned once."""

    def __init__(self, interpolator: Interpolator, remembered: int = 8) -> None:
        self._interpolator, self._remembered = interpolator, remembered
        self._plans: OrderedDict[tuple[object, ...], Trajectory] = OrderedDict()

    def chains(self, statements: Iterable[Statement], start: np.ndarray) -> Iterator[Chain]:
        """The chains of a program that starts from a standstill at `start` (n,), each planned on request.

        Raises:
            CannotMove: a move that cannot be carried out.
        """
        moves: list[Move] = []
        for statement in statements:
            if not isinstance(statement, Delay):
                moves.append(statement)
            if moves and (isinstance(statement, Delay) or not statement.fly or len(moves) == MAX_CHAIN):
                trajectory, chain = self._plan(moves, start)
                yield chain
                start, moves = trajectory.q[-1], []
            if isinstance(statement, Delay):
                yield Chain(None, Termination.NOSETTLE, 0.0, min(statement.seconds, MAX_DELAY))
        if moves:
            yield self._plan(moves, start)[1]

    def _plan(self, moves: list[Move], start: np.ndarray) -> tuple[Trajectory, Chain]:
        key = (*np.round(start / _SAME_START).astype(np.int64).tolist(), way_key(moves))
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
        tolerance = settings.tolerance_fine if fine else settings.tolerance_coarse
        return trajectory, Chain(trajectory, settings.termination, tolerance)


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
        self._plant, self._forward = plant, forward
        self._max_acceleration, self._period, self._slice_samples = max_acceleration, period, slice_samples
        self.astray = Astray(len(max_acceleration), period)
        self._start = np.zeros(len(max_acceleration))

    def run(self, chains: Iterable[Chain], start: np.ndarray, switch: StopSwitch) -> Iterator[Slice]:
        """Samples from rest at set-point `start` (n,) until the arm rests again; `switch` makes that earlier."""
        self._start = reference = start
        for chain in chains:
            if switch.reason is not None:
                return
            if chain.trajectory is None:
                remaining = round(chain.hold / self._period)
                while remaining > 0 and switch.reason is None:
                    yield self._rest(reference, min(remaining, self._slice_samples))
                    remaining -= self._slice_samples
                continue
            position, velocity = self._plant.executed_path(chain.trajectory.q, chain.trajectory.qd)
            speed, last_sent = 1.0, 0  # `last_sent`: number of a set-point; the first is the rest before
            while last_sent < len(position) - 1:
                if switch.reason is not None and last_sent:
                    position, velocity = self._retimed(position[last_sent:], velocity[last_sent:], 0.0)
                    for k in range(1, len(position), self._slice_samples):
                        yield self._follow(*(part[k : k + self._slice_samples] for part in (position, velocity)))
                    yield from self._settle(position[-1], Termination.COARSE, chain.tolerance)
                    return
                if switch.speed != speed:
                    ratio, speed = switch.speed / speed, switch.speed
                    position, velocity = self._retimed(position[last_sent:], velocity[last_sent:], ratio)
                    last_sent = 0
                until = min(last_sent + self._slice_samples, len(position) - 1)
                yield self._follow(position[last_sent + 1 : until + 1], velocity[last_sent + 1 : until + 1])
                last_sent = until
            reference = position[-1]
            yield from self._settle(reference, chain.termination, chain.tolerance)

    def _retimed(self, position: np.ndarray, velocity: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
        return retimed(position, velocity, ratio, self._max_acceleration, self._period)

    def _follow(self, position: np.ndarray, velocity: np.ndarray) -> Slice:
        return follow(self._plant, self.astray, position, velocity, self._start)

    def _rest(self, reference: np.ndarray, count: int) -> Slice:
        position = np.repeat(reference[None, :], count, axis=0)
        return self._follow(position, np.zeros_like(position))

    def _settle(self, reference: np.ndarray, termination: Termination, tolerance: float) -> Iterator[Slice]:
        if termination is Termination.NOSETTLE:
            return
        goal = self._forward(reference[None, :])[0, :3, 3]
        for _ in range(round(_SETTLE_LIMIT / self._period / _SETTLE_SLICE)):
            part = self._rest(reference, _SETTLE_SLICE)
            yield part
            if termination in _JOINT_TOLERANCE:
                arrived = np.abs(part.position - reference).max() < _JOINT_TOLERANCE[termination]
            else:
                arrived = np.linalg.norm(self._forward(part.position)[:, :3, 3] - goal, axis=1).max() < tolerance
            if arrived:
                return


def retimed(
    position: np.ndarray, velocity: np.ndarray, ratio: float, max_acceleration: np.ndarray, period: float
) -> tuple[np.ndarray, np.ndarray]:
    """The same path at `ratio` times its speed, as after a turn of the override, or to rest on it where that is 0.

    The path parameter s runs over the trajectory's own time. ds/dt goes from one to `ratio` as a half cosine, so that
    speed has no step, and so slowly that no joint goes beyond its acceleration (or beyond what the path asks for
    anyway), even if the path ends before that.

    Args:
        position, velocity: (S, n); the first row is the last set-point given.
        max_acceleration: (n,).

    Returns:
        position and velocity, both (K, n); the first row stays.
    """
    length = period * (len(position) - 1)
    own = np.abs(np.diff(velocity, axis=0)).max(axis=0, initial=0.0) / period * max(1.0, ratio) ** 2
    allowed = 1.01 * np.maximum(max_acceleration, own)
    # Slowing down to rest alone asks for π/(2 ramp) · q̇ at most.
    shortest_stop = max(_SHORTEST_STOP, float(np.max(np.pi / 2 * np.abs(velocity[0]) / max_acceleration)))
    ramp = min(_OVERRIDE_RAMP, length) if ratio else shortest_stop
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
    duration = ramp + (max(0.0, length - turned) / ratio if ratio else 0.0)
    t = period * np.arange(1, int(np.ceil(duration / period)) + 1)
    on = np.minimum(t, ramp)
    s = on + (ratio - 1) / 2 * (on - ramp / np.pi * np.sin(np.pi * on / ramp)) + ratio * (t - on)
    rate = 1 + (ratio - 1) / 2 * (1 - np.cos(np.pi * on / ramp))
    if ratio:
        s[-1] = max(s[-1], length)
        needed = int(np.argmax(s >= length)) + 1
        s, rate = s[:needed], rate[:needed]
    s, last = s / period, len(position) - 1
    q, qd = between(position, velocity, s, period)
    q[s >= last], qd[s >= last] = position[-1], 0.0
    return np.vstack([position[:1], q]), np.vstack([velocity[:1], qd * rate[:, None]])


def between(position: np.ndarray, velocity: np.ndarray, at: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Set-points (K, n) at `at` (K,), in samples, by a cubic between those that were planned, and their derivative."""
    last = len(position) - 1
    index = np.minimum(at.astype(int), max(last - 1, 0))
    after = np.minimum(index + 1, last)
    u = np.clip(at - index, 0.0, 1.0)[:, None]
    p0, p1 = position[index], position[after]
    v0, v1 = velocity[index] * period, velocity[after] * period
    bend, twist = 3 * (p1 - p0) - 2 * v0 - v1, 2 * (p0 - p1) + v0 + v1
    return p0 + u * (v0 + u * (bend + u * twist)), (v0 + u * (2 * bend + u * 3 * twist)) / period
